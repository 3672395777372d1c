"""The paper's Fig. 6: regions found in a drawing and in a scene with a phone. Both pictures are simulated.

The phone: a dark plate with camera lenses, a flash, keys, a logo, letters and a cable beside it, seen under tilt with
uneven light, and four light rings on it. What is counted: ellipses that belong to a circle of the scene, others, rings
(both circles measured, concentric) and the markers that the pose estimation knows by their ratio of radii.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import find_shapes
from torchpose.geometry import conics, rotations
from torchpose.io.rows import Row
from torchpose.io.shape_rows import shape_rows
from torchpose.pipeline import PoseEstimator
from torchpose.report.detection_overlay import draw_shapes
from torchpose.report.figures import frames
from torchpose.results import Status
from torchpose.rings import measure_rings
from torchpose.rings.inner_circles import find_inner
from torchpose.sim import add_noise, render, shapes
from torchpose.sim.sensor import Lighting
from torchpose.studies import table02_detection
from torchpose.studies.study import Picture, Progress, StudyResult, Table, ignore_progress
from torchpose.target import Target

NAME = "fig06_regions"
TITLE = "Fig. 6: regions found in a drawing and on a phone"
MARKERS = ((-26.0, -52.0, 2.4), (26.0, -52.0, 3.2), (26.0, 52.0, 4.0), (-26.0, 52.0, 4.8))  # x, y, inner radius, mm
OUTER_RADIUS = 8.0
LENSES = ((-16.0, -24.0, 6.0), (0.0, -24.0, 6.0), (12.0, -30.0, 1.8))  # x, y, radius, mm
NOISE = 2.0
FOCAL_PX = 1400.0


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Detects in both pictures and counts; ``full`` changes nothing."""
    drawn, circles = table02_detection.scene(table02_detection.reference())
    drawing = add_noise(drawn[None], NOISE, seed=seed)
    circles = torch.cat([circles, circles[:, 2:], torch.zeros(len(circles), 1)], 1).double()
    phone, phone_circles = phone_scene(seed)
    rows: list[Row] = []
    pictures = []
    for letters, name, images, truth in (
        ("a, b", "drawing", drawing, circles),
        ("c, d", "phone", phone, phone_circles),
    ):
        row, overlay = _counted(name, images, truth)
        rows.append(row)
        height, width = overlay.shape[:2]
        first, second = letters.split(", ")
        titles = f"({first}) the frame", f"({second}) what was found in it"
        sheet = frames(
            list(zip(titles, (images[0].numpy(), overlay), strict=True)), 1, (13, 6.8 * height / width + 0.3)
        )
        title = f"Fig. 6 ({letters}): the {name} and what was found in it"
        pictures.append(Picture(f"fig06_{name}", title, sheet))
        progress(len(rows) / 2)
    poses = PoseEstimator(_camera(*phone.shape[1:]), phone_target())(phone)
    return StudyResult(
        tables=[Table("fig06", "Ellipses, rings and straight edges found", rows)],
        pictures=pictures,
        statements=[
            *(
                f"{row['scene'].capitalize()}: {row['found']} of {row['circles']} circles found and "
                f"{row['other_ellipses']} other ellipses (of letters and rounded corners); {row['rings']} rings."
                for row in rows
            ),
            f"Of the phone's rings {int(poses.markers[0])} are known as markers; the pose is "
            f"{Status(int(poses.status[0])).name.lower()}. The lenses are rings too, of a ratio that no marker has.",
        ],
        settings={"noise": NOISE},
    )


def _counted(name: str, images: Tensor, truth: Tensor) -> tuple[Row, np.ndarray]:
    """What was found in a frame (1, H, W) with circles (C, 5): its row, and the picture of it, red-green-blue."""
    found = find_shapes(images)
    inner = find_inner(images, found.ellipses)
    hit = _same(found.ellipses.ellipse, truth)
    row = {
        "scene": name,
        "circles": len(truth),
        "found": int(hit.any(0).sum()),
        "other_ellipses": int((~hit.any(1)).sum()),
        "rings": len(measure_rings(images, found.ellipses, _camera(*images.shape[1:]))),
        "segments": int((found.segments.chain < 0).sum()),
        "polygons": len(found.segments.chain[found.segments.chain >= 0].unique()),
    }
    shapes_found = shape_rows(found, torch.where(inner.found, inner.ratio, torch.nan), [name])
    return row, cv2.cvtColor(draw_shapes(images[0].numpy(), shapes_found), cv2.COLOR_BGR2RGB)


def phone_target() -> Target:
    """The four light rings on the phone."""
    centers = torch.tensor([[x, y, 0.0] for x, y, _ in MARKERS], dtype=torch.float64)
    radii = torch.tensor([[OUTER_RADIUS, inner] for _, _, inner in MARKERS], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, 1]], dtype=torch.float64).expand(len(MARKERS), 3)
    return Target("phone", "dark", torch.arange(len(MARKERS)), centers, normals, radii)


def _camera(height: int, width: int) -> Camera:
    return Camera.ideal(width, height, FOCAL_PX)


def phone_scene(seed: int) -> tuple[Tensor, Tensor]:
    """Frames (1, H, W) uint8 and the ellipses (C, 5) of its circles, px: of each marker both, the lenses, the logo."""
    camera = _camera(1024, 1536)
    R = rotations.exp(torch.tensor([[0.30, -0.22, 0.0]], dtype=torch.float64))
    R = R @ rotations.exp(torch.tensor([[0.0, 0, 1.35]], dtype=torch.float64))
    t = torch.tensor([[4.0, -2, 210]], dtype=torch.float64)
    ground = [
        shapes.polygon([_rounded(39.0, 76.0, 9.0)], 42.0),
        shapes.rectangle((60.0, 10.0), 5.0, 120.0, 0.12, 70.0),
        shapes.rectangle((39.5, -10.0), 1.6, 14.0, 0.0, 110.0),
    ]
    marks = [shapes.ring((x, y), OUTER_RADIUS, inner, 215.0) for x, y, inner in MARKERS]
    lenses = [shapes.ring((x, y), radius, 0.0, 150.0) for x, y, radius in LENSES]
    logo = shapes.ring((0.0, 12.0), 7.0, 0.0, 95.0)
    words = [shapes.text("8060 OBQ", (0.0, 30.0), 5.0, 0.0, 170.0), shapes.text("REV 0", (4.0, 62.0), 3.0, 0.0, 150.0)]
    glass = [shapes.ring((x, y), 0.7 * radius, 0.0, 12.0) for x, y, radius in LENSES[:2]]
    frame = render(
        camera,
        shapes.cat([*marks, *lenses, logo, *words]),
        R,
        t,
        light=128.0,
        clutter=shapes.cat(ground),
        covers=shapes.cat(glass),
        lighting=Lighting(gradient=(0.3, -0.2)),
    )
    circles = [(x, y, radius) for x, y, inner in MARKERS for radius in (OUTER_RADIUS, inner)]
    circles += [*LENSES, *((x, y, 0.7 * radius) for x, y, radius in LENSES[:2]), (0.0, 12.0, 7.0)]
    return add_noise(frame, NOISE, seed=seed), _images(camera, R[0], t[0], circles)


def _rounded(half_width: float, half_height: float, radius: float) -> np.ndarray:
    """Outline (n, 2) of a rectangle with rounded corners, mm."""
    turn = np.linspace(0, np.pi / 2, 12)
    corner = radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    middle = np.array([half_width - radius, half_height - radius])
    parts = []
    for quarter, sign in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        c, s = math.cos(quarter * math.pi / 2), math.sin(quarter * math.pi / 2)
        parts.append(corner @ np.array([[c, s], [-s, c]]) + middle * sign)
    return np.concatenate(parts)


def _images(camera: Camera, R: Tensor, t: Tensor, circles: list[tuple[float, float, float]]) -> Tensor:
    """Ellipses (C, 5) px of circles x, y, radius (mm) in the plane z = 0."""
    known = torch.tensor(circles, dtype=torch.float64)
    centers = torch.nn.functional.pad(known[:, :2], (0, 1)) @ R.mT + t
    count = len(known)
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(count, 3)
    return conics.circle_ellipse(camera.matrix, R.expand(count, 3, 3), centers, normal, known[:, 2])


def _same(found: Tensor, truth: Tensor) -> Tensor:
    """(M, C) bool: ellipses (M, 5) within 3 % of the size of those of the truth (C, 5)."""
    size = truth[:, 3]
    near = torch.cdist(found[:, :2], truth[:, :2]) < 0.05 * size + 1.0
    return near & ((found[:, None, 2:4] - truth[:, 2:4]).abs().amax(-1) < 0.03 * size + 1.0)

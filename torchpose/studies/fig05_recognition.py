"""Second part of Fig. 5: marks among clutter, missed and false, and the codes that each shape can carry."""

import math
from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.analysis import localisers
from torchpose.analysis.marks import RING_RATIO, Mark, circles, cross, marks, square
from torchpose.camera import Camera
from torchpose.detect import find_candidates
from torchpose.io.rows import Row
from torchpose.rings import measure_rings
from torchpose.sim import add_noise, render, shapes
from torchpose.sim.shapes import Shapes
from torchpose.studies.views import turned
from torchpose.target import Target

WIDTH, HEIGHT, FOCAL_PX, DISTANCE_MM, RADIUS_MM = 720, 600, 640.0, 160.0, 5.0
AREA_MM2 = math.pi * RADIUS_MM**2
# things on the cells of a lattice between and around the marks, and how often each: a board with its parts and print
THINGS = {"rectangle": 0.35, "disc": 0.2, "washer": 0.1, "cross": 0.1, "word": 0.25}
WORDS = ("0815", "REV B", "LOT 42", "M3x8", "OK", "PN 7731", "+24V", "QC")
NEAR_PX = 5.0  # of a mark's centre, for one that was recognised
TILT = math.radians(30)
NOISE = 3.0
AREA_RANGE = (0.45, 1.5)  # of the area of a mark face on
CODE_NOISE = (2.0, 8.0)
CODE_BLUR = (0.7, 1.0, 1.5)
SPREAD = 6.0  # standard deviations between two codes
RANGES = {"concentric rings": (0.15, 0.9), "cross": (0.1, 0.8), "rectangle": (1.0, 3.0)}  # of the codes


def recognition(frames: int, seed: int) -> list[Row]:
    """Part of the marks missed, and false recognitions a frame, for every shape; the same clutter for all.

    Every shape has its look-alikes in the clutter, but for the vertex: `THINGS`.
    """
    camera = frame_camera()
    target = Target.load("quad40")
    R, t = _poses(frames, seed)
    truth = camera.project(target.centers @ R.mT + t[:, None])
    things = clutter(target, frames, seed)
    rows = []
    for mark in marks(AREA_MM2):
        drawn = shapes.cat([mark.draw(30.0, (x, y)) for x, y, _ in target.centers.tolist()])
        drawn = drawn.in_frames(torch.arange(frames))
        images = add_noise(render(camera, drawn, R, t, clutter=things), NOISE, seed)
        seen = wrong = 0
        for centers, found in zip(truth, RECOGNISERS[mark.name](images, camera), strict=True):
            near = torch.cdist(centers, found) < NEAR_PX
            seen += int(near.any(1).sum())
            wrong += int((~near.any(0)).sum())
        rows.append({"mark": mark.name, "missed": 1 - seen / truth[..., 0].numel(), "false_per_frame": wrong / frames})
    return rows


def frame_camera() -> Camera:
    """Camera of the frames with clutter."""
    return Camera.ideal(WIDTH, HEIGHT, FOCAL_PX)


def clutter(target: Target, frames: int, seed: int) -> Shapes:
    """Rectangles (sides 1 to 2), discs, washers (holes of 0.3 to 0.8), crosses and words of any dark grey and turn.

    From 0.6 to 1.1 times the size of the marks, each within its cell of the lattice; two cells in three are full.
    """
    rng = np.random.default_rng([seed, 5])
    cell = 2.8 * RADIUS_MM
    axis = np.arange(-4, 5) * cell
    lattice = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    apart = np.linalg.norm(lattice[:, None] - target.centers[:, :2].numpy(), axis=2)
    free = lattice[(apart > 2.2 * RADIUS_MM).all(1)]
    out = []
    for frame in range(frames):
        for x, y in free[rng.random(len(free)) < 2 / 3]:
            kind = rng.choice(list(THINGS), p=list(THINGS.values()))
            r, turn, level = RADIUS_MM * rng.uniform(0.6, 1.1), rng.uniform(0, 2 * math.pi), rng.uniform(20, 100)
            at = (float(x), float(y))
            if kind == "rectangle":
                side = 1.2 * r
                out.append(shapes.rectangle(at, side * rng.uniform(1, 2), side, turn, level, frame))
            elif kind == "disc":
                out.append(shapes.ring(at, r, 0.0, level, frame))
            elif kind == "washer":
                out.append(shapes.ring(at, r, r * rng.uniform(0.3, 0.8), level, frame))
            elif kind == "cross":
                out.append(shapes.cross(at, 1.7 * r, 1.7 * r * rng.uniform(0.2, 0.7), turn, level, frame))
            else:
                out.append(shapes.text(str(rng.choice(WORDS)), at, 0.35 * r, turn, level, frame))
    return shapes.cat(out)


def find_rings(images: Tensor, camera: Camera) -> list[Tensor]:
    """Centres (n, 2) px of dark rings with the code of the mark, for each frame."""
    candidates = find_candidates(images)
    rings = measure_rings(images, candidates[candidates.polarity > 0], camera)
    ratio = (rings.inner_raw[:, 2:4].prod(1) / rings.outer_raw[:, 2:4].prod(1)).sqrt()
    good = ((ratio - RING_RATIO).abs() < 0.03) & _sized(math.pi * rings.outer_raw[:, 2:4].prod(1))
    return [rings.outer_raw[good & (rings.frame == k), :2] for k in range(len(images))]


def find_discs(images: Tensor, camera: Camera) -> list[Tensor]:
    """Centres of dark ellipses of the right size with nothing concentric inside, for each frame."""
    found = find_candidates(images)
    large = found[_sized(math.pi * found.ellipse[:, 2:4].prod(1)) & (found.polarity > 0)]
    apart = torch.cdist(large.ellipse[:, :2], found.ellipse[:, :2]) + 1e6 * (large.frame[:, None] != found.frame)
    inner = (apart < 0.3 * large.ellipse[:, 3:4]) & (found.ellipse[:, 2] < 0.9 * large.ellipse[:, 2:3])
    plain = large[~inner.any(1)]
    return [plain.ellipse[plain.frame == k, :2] for k in range(len(images))]


def find_polygons(image: np.ndarray, corners: int) -> Tensor:
    """Centres (n, 2) px of dark outlines with 4 or 12 corners and the size and compactness of the mark."""
    _, binary = cv2.threshold(cv2.GaussianBlur(image, (3, 3), 0), 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    outlines, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    solidity = 1.0 if corners == 4 else 0.75 / 0.875  # of the cross with bars of half its extent
    found = []
    for outline in outlines:
        shape = cv2.approxPolyDP(outline, 0.03 * cv2.arcLength(outline, True) * (4 / corners) ** 0.5, True)
        area, hull = cv2.contourArea(outline), cv2.contourArea(cv2.convexHull(outline))
        if len(shape) != corners or not bool(_sized(torch.tensor(hull))):
            continue
        sides = np.sort(cv2.minAreaRect(outline)[1])
        # a square tilted by 30 degrees is up to 1.35 times as long as wide, turned any way
        if abs(area / hull - solidity) < 0.08 and sides[1] < 1.35 * sides[0]:
            moments = cv2.moments(outline)
            found.append((moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]))
    return torch.tensor(found, dtype=torch.float64).reshape(-1, 2)


def find_vertices(images: Tensor, camera: Camera) -> list[Tensor]:
    """Saddles of the grey values, for each frame: maxima of -det of the Hessian above a part of that of a vertex."""
    found = []
    for image in images.numpy():
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0)
        dxx, dyy, dxy = (cv2.Sobel(smooth, cv2.CV_32F, *o, ksize=3, scale=0.25) for o in ((2, 0), (0, 2), (1, 1)))
        response = dxy * dxy - dxx * dyy
        # of an ideal vertex of this contrast under the smoothing: (contrast / (pi sigma^2))^2; part of it, for the tilt
        least = 0.3 * (190 / (math.pi * (4.0 + 0.6))) ** 2
        peak = (response == cv2.dilate(response, np.ones((9, 9), np.uint8))) & (response > least)
        found.append(torch.from_numpy(np.argwhere(peak)[:, ::-1].astype(float)))
    return found


# frames (B, H, W) uint8 and their camera to the centres of the marks recognised in each
RECOGNISERS: dict[str, Callable[[Tensor, Camera], list[Tensor]]] = {
    "chessboard vertex": find_vertices,
    "filled circle": find_discs,
    "concentric rings": find_rings,
    "rectangle": lambda images, camera: [find_polygons(image, 4) for image in images.numpy()],
    "cross": lambda images, camera: [find_polygons(image, 12) for image in images.numpy()],
}


def capacities(count: int, seed: int) -> list[Row]:
    """Codes of the shapes that carry one: spread of the value read over noise, blur and tilt, and how many fit."""
    rows: list[Row] = []
    for noise in CODE_NOISE:
        for name, (low, high) in RANGES.items():
            # rectangles are read as they are: one square stands for all
            square_like = name == "rectangle"
            codes = (1.0,) if square_like else tuple(low + (high - low) * x for x in (0.2, 0.4, 0.6, 0.8))
            errors = []
            for k, blur in enumerate(CODE_BLUR):
                for code in codes:
                    value = _read(name, code, blur, noise, _poses(count, seed + k), seed)
                    errors.append(value.log() if square_like else value - code)
            rms = float(torch.cat(errors).square().nanmean().sqrt())
            span = math.log(high / low) if square_like else high - low
            fit = 1 + int(span / (SPREAD * rms))
            rows.append({"mark": name, "noise": noise, "rms": rms, "range": f"{low:g} to {high:g}", "codes": fit})
        rows += [
            {"mark": name, "noise": noise, "rms": None, "range": "", "codes": 1}
            for name in ("filled circle", "chessboard vertex")
        ]
    return rows


def _read(name: str, code: float, blur: float, noise: float, poses: tuple[Tensor, Tensor], seed: int) -> Tensor:
    """(B,) codes read from frames of marks that carry one."""
    build, read = CODED[name]
    mark, camera, (R, t) = build(code), Camera.ideal(161, 161, 2 * FOCAL_PX), poses
    t = t * torch.tensor([0.001, 0.001, 1.0])
    drawn = mark.draw(30.0, (0.0, 0.0)).in_frames(torch.arange(len(t)))
    images = add_noise(render(camera, drawn, R, t, psf_sigma=blur), noise, seed)
    points = torch.nn.functional.pad(mark.edges, (0, 1)).flatten(0, 1)
    outline = camera.project(points @ R.mT + t[:, None]).unflatten(1, mark.edges.shape[:2])
    return read(localisers.edge_points(images, outline, blur), outline)


def read_rings(edges: localisers.EdgePoints, outline: Tensor) -> Tensor:
    """(B,) inner over outer radius."""
    area = localisers.fit_circles(edges, outline)[..., 2:4].prod(-1)
    return (area[:, 1] / area[:, 0]).sqrt()


def read_cross(edges: localisers.EdgePoints, outline: Tensor) -> Tensor:
    """(B,) bar over extent: square root of the ratio of the areas of both squares."""
    inner, outer = (_corners(lines) for lines in localisers.fit_lines(edges)[0].unflatten(0, (-1, 2, 4)).unbind(1))
    return (_area(inner) / _area(outer)).sqrt()


def read_rectangle(edges: localisers.EdgePoints, outline: Tensor) -> Tensor:
    """(B,) first side over second, as they look."""
    corner = _corners(localisers.fit_lines(edges)[0].unflatten(0, (-1, 4)))
    side = (corner.roll(-1, 1) - corner).norm(dim=-1)
    return (side[:, 0] + side[:, 2]) / (side[:, 1] + side[:, 3])


# the mark that carries a code, and what reads it from edges and outlines
CODED: dict[str, tuple[Callable[[float], Mark], Callable[[localisers.EdgePoints, Tensor], Tensor]]] = {
    "concentric rings": (lambda code: circles("rings", (RADIUS_MM, code * RADIUS_MM), 150), read_rings),
    "cross": (lambda code: cross(AREA_MM2, code, 150), read_cross),
    "rectangle": (lambda code: square(math.sqrt(AREA_MM2), 150), read_rectangle),
}


def _corners(lines: Tensor) -> Tensor:
    return localisers.meet(lines, lines.roll(-1, -2))


def _area(corner: Tensor) -> Tensor:
    following = corner.roll(-1, 1)
    cross_product = corner[..., 0] * following[..., 1] - corner[..., 1] * following[..., 0]
    return cross_product.sum(-1).abs() / 2


def _sized(area: Tensor) -> Tensor:
    """Whether areas in px^2 are those of a mark, near enough."""
    expected = AREA_MM2 * (FOCAL_PX / DISTANCE_MM) ** 2
    return (area > AREA_RANGE[0] * expected) & (area < AREA_RANGE[1] * expected)


def _poses(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """R (count, 3, 3), t (count, 3): any roll, tilt to 30 degrees about any axis."""
    roll, azimuth, tilt, x, y = torch.rand(5, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    t = torch.stack([10 * (x - 0.5), 10 * (y - 0.5), torch.full_like(x, DISTANCE_MM)], -1)
    return turned(TILT * tilt, azimuth, roll), t

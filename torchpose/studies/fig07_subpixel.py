"""The paper's Figs. 7 and 8: from a ring in the frame to sub-pixel edges and fitted ellipses, step by step.

One ring, tilted by 20 degrees, PSF 0.7 px, noise of 2 grey levels: the region, Canny's edge pixels, the response of the
Zernike moment A_11, the sub-pixel edges, and the ellipses fitted to them with their residuals.
"""

import math

import cv2
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.detect import find_candidates
from torchpose.geometry import conics, rotations
from torchpose.io.rows import Row
from torchpose.report.figures import COLOURS, legend_below, subplots
from torchpose.rings import measure_rings, zernike
from torchpose.rings.edges import RingEdges, ring_edges
from torchpose.sim import add_noise, render, shapes
from torchpose.studies.study import Picture, Progress, StudyResult, Table, ignore_progress, load_data

NAME = "fig07_subpixel"
TITLE = "Figs. 7 and 8: from the region to sub-pixel edges and ellipses"
OUTER, INNER, DISTANCE, FOCAL, SIZE = 5.0, 2.5, 160.0, 1111.11, 121  # mm, mm, mm, px, px
NOISE = 2.0
_REACH = 3.0  # px


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Every step on one ring; ``full`` changes nothing."""
    matrix = torch.tensor([[FOCAL, 0, 60.3], [0, FOCAL, 59.6], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(SIZE, SIZE, matrix, torch.zeros(5, dtype=torch.float64))
    R = rotations.exp(torch.tensor([[math.radians(20), 0, 0]], dtype=torch.float64))
    t = torch.tensor([[0.0, 0, DISTANCE]], dtype=torch.float64)
    clean = render(camera, shapes.ring((0.0, 0.0), OUTER, INNER), R, t)
    frames = add_noise(clean, NOISE, seed=seed)
    rings = measure_rings(frames, find_candidates(frames), camera)
    raw = torch.cat([rings.outer_raw, rings.inner_raw])
    outward = torch.tensor([1.0, -1.0], dtype=torch.float64)
    edges = ring_edges(frames, torch.zeros(2, dtype=torch.int64), raw, outward, torch.full((2,), _REACH).double())
    progress(0.5)
    fits = ellipse.fit(edges.points, edges.ring, 2)
    off = ellipse.distance(edges.points, edges.ring, fits)
    truth = _truth(camera, R[0], t[0])
    rows: list[Row] = []
    for i, name in enumerate(("outer", "inner")):
        mine = off[edges.ring == i]
        rows.append(
            {
                "circle": name,
                "edge_points": len(mine),
                "residual_rms_px": float(mine.square().mean().sqrt()),
                "center_error_as_read_px": float((fits[i, :2] - truth[i, :2]).norm()),
                "center_error_corrected_px": float((raw[i, :2] - truth[i, :2]).norm()),
                "axes_error_as_read_px": float((fits[i, 2:4] - truth[i, 2:4]).abs().max()),
                "axes_error_corrected_px": float((raw[i, 2:4] - truth[i, 2:4]).abs().max()),
            }
        )
    progress(1.0)
    return StudyResult(
        tables=[Table("fig07", "Edges and ellipses of one ring", rows, load_data("notes.yaml")[NAME]["fig07"])],
        pictures=[
            Picture("fig07", "Fig. 7: region, Canny, Zernike response, sub-pixel edges", _steps(frames[0], edges)),
            Picture("fig08", "Fig. 8: fitted ellipses, and how far the edges lie from them", _fitted(edges, fits, off)),
        ],
        settings={"noise": NOISE, "tilt_deg": 20, "psf_sigma_px": 0.7},
    )


def _truth(camera: Camera, R: Tensor, t: Tensor) -> Tensor:
    """(2, 5) exact ellipses of both circles, px."""
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(2, 3)
    radii = torch.tensor([OUTER, INNER], dtype=torch.float64)
    return conics.circle_ellipse(camera.matrix, R.expand(2, 3, 3), t.expand(2, 3), normal, radii)


def _steps(frame: Tensor, edges: RingEdges) -> Figure:
    canny = torch.from_numpy(cv2.Canny(frame.numpy(), 60, 120))
    response = zernike.ZernikeMoments(orders=((1, 1),))(frame[None, None]).norm(dim=1)[0]
    half = zernike.MASK // 2  # which the response lacks on every side
    figure, (panels,) = subplots(1, 4, (16, 4.3))
    for panel, picture, title, margin in zip(
        panels,
        (frame, canny, response, frame),
        ("(a) region", "(b) Canny", "(c) Zernike |A11|", "(d) sub-pixel edges"),
        (0, 0, half, 0),
        strict=True,
    ):
        low, high = margin - 0.5, SIZE - 0.5 - margin
        panel.imshow(picture.numpy(), cmap="gray", extent=(low, high, high, low), interpolation="nearest")
        panel.set_title(title)
        panel.set_xlabel("u, px")
        panel.grid(False)
    panels[0].set_ylabel("v, px")
    panels[3].plot(*edges.points.T, ".", ms=4, color=COLOURS[1])
    panels[3].set(xlim=(60, 105), ylim=(80, 35))
    return figure


def _fitted(edges: RingEdges, fits: Tensor, off: Tensor) -> Figure:
    figure, ((whole, residual),) = subplots(1, 2, (13, 4.8))
    angle = torch.linspace(0, 2 * math.pi, 300, dtype=torch.float64)
    for i, name in enumerate(("outer", "inner")):
        mine = edges.ring == i
        xy, curve = edges.points[mine], conics.points_on(fits[i : i + 1], angle[None])[0]
        whole.plot(*curve.T, color=COLOURS[i], lw=1, label=f"{name} circle")
        whole.plot(*xy.T, ".", ms=2, color="black")
        direction = torch.atan2(xy[:, 1] - fits[i, 1], xy[:, 0] - fits[i, 0]).rad2deg()
        residual.plot(direction, off[mine], ".", ms=4, color=COLOURS[i], label=f"{name} circle")
    whole.set_aspect("equal")
    whole.invert_yaxis()
    whole.set(xlabel="u, px", ylabel="v, px")
    residual.set(xlabel="direction from the centre, degrees", ylabel="edge - ellipse, px")
    whole.set_title("fitted ellipses, and edges as dots", fontsize=10)
    legend_below(figure, [whole], 2)
    return figure

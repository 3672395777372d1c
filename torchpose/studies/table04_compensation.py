"""The paper's Table IV and Fig. 9: the centre of a tilted ring, uncompensated, by eq. (7) and exact.

A ring of diameters 10 and 5 mm on the optical axis at 160 mm, focal length 3333.33 px: the paper gives no focal length,
nor says which of its sizes are diameters. ``formula``: from the exact conics, that is the error of the formula alone.
``measured``: from simulated 8-bit frames (point-spread function 0.7 px), each with the axis of tilt and the part of a
pixel by which the ring is off the axis drawn at random; RMS length of the error over the frames.
"""

import math

import torch
from matplotlib.figure import Figure
from torch import Tensor

import torchpose as tp
from torchpose.analysis import rms
from torchpose.detect import find_candidates
from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics, rotations
from torchpose.io.rows import Row
from torchpose.pose import common_center, compensate
from torchpose.report.figures import COLOURS, GREY, curve, legend_below, subplots
from torchpose.rings import measure_rings
from torchpose.sim import add_noise, render
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress, load_data

NAME = "table04_compensation"
TITLE = "Table IV: the centre of a tilted ring, compensated"
F64 = torch.float64
FOCAL, DISTANCE, SIZE = 3333.33, 160.0, 301
RADII = torch.tensor([[5.0, 2.5]], dtype=F64)
TILTS_DEG = (0, 5, 10, 20, 30, 40, 50, 60, 70)
PAPER_PX: dict[int, list[float]] = load_data("paper.yaml")["table04"]  # uncompensated, eq. (7)
NAMES = ("ellipse", "eq7", "exact")
NOISE = (0.0, 2.0)


def run(
    *, full: bool = False, seed: int = 0, progress: Progress = ignore_progress, seeds: int | None = None
) -> StudyResult:
    """Centre errors over tilt without and with compensation, from exact conics and measured in frames.

    Args:
        seeds: frames for each tilt and noise; by default 50, or 6 for a quick run.
    """
    count = seeds or (50 if full else 6)
    rows: list[Row] = []
    for done, tilt in enumerate(TILTS_DEG):
        g = torch.Generator().manual_seed(1000 * seed + tilt)
        draws = torch.rand(count, 3, dtype=F64, generator=g)
        axes = torch.stack([(2 * math.pi * draws[:, 0]).cos(), (2 * math.pi * draws[:, 0]).sin()], -1)
        lean = rotations.exp(torch.nn.functional.pad(axes * math.radians(tilt), (0, 1)))
        formula = errors(*projected(lean[0]))[0].tolist()
        paper = dict(zip(("paper_ellipse_px", "paper_eq7_px"), PAPER_PX.get(tilt, (None, None)), strict=True))
        for noise in NOISE:
            shift = draws[:, 1:] - 0.5
            found = errors(*measured(lean, shift, noise, seed))
            as_read = errors(*measured(lean, shift, noise, seed, correct=False))[:, 1:2]
            measured_px = rms(torch.cat([found, as_read], 1)).tolist()
            row: Row = {"tilt_deg": tilt, "noise": noise}
            row |= {f"formula_{name}_px": value for name, value in zip(NAMES, formula, strict=True)}
            row |= {f"measured_{n}_px": v for n, v in zip((*NAMES, "eq7_paper_edges"), measured_px, strict=True)}
            rows.append(row | paper)
        progress((done + 1) / len(TILTS_DEG))
    clean = {row["tilt_deg"]: row for row in rows if row["noise"] == 0}
    steep = max(tilt for tilt in TILTS_DEG if tilt <= 60)
    title = "Distance of the centre from the truth: of the formula alone, and measured (RMS)"
    return StudyResult(
        tables=[Table("table04", title, rows)],
        pictures=[
            Picture("table04", "Error of the centre over the tilt", _plot(rows)),
            Picture("fig09", "Fig. 9: a ring tilted by 45 degrees, its ellipses' centres and its own", _ring_picture()),
        ],
        comparisons=[
            Comparison(f"{tilt} degrees, {words}", "px", paper, clean[tilt][f"measured_{name}_px"])
            for tilt, (raw, eq7) in PAPER_PX.items()
            for words, paper, name in (
                ("not compensated", raw, "ellipse"),
                ("eq. (7)", eq7, "eq7"),
                ("exact", eq7, "exact"),
            )
        ],
        statements=[
            f"Eq. (7) itself leaves {clean[steep]['formula_eq7_px']:.4f} px at {steep} degrees, on exact "
            f"ellipses; the common pole of both conics is exact. Measured, noise-free: "
            f"{clean[steep]['measured_eq7_px']:.4f} and {clean[steep]['measured_exact_px']:.4f} px.",
        ],
        settings={"frames_per_row": count, "psf_sigma_px": 0.7},
    )


def _plot(rows: list[Row]) -> Figure:
    figure, (panels,) = subplots(1, len(NOISE), (6 * len(NOISE), 4.5), sharey=True)
    lines = (
        ("measured_ellipse_px", "centre of the ellipse"),
        ("measured_eq7_px", "eq. (7)"),
        ("measured_exact_px", "exact"),
        ("measured_eq7_paper_edges_px", "eq. (7), edges as read"),
    )
    for panel, noise in zip(panels, NOISE, strict=True):
        part = [row for row in rows if row["noise"] == noise]
        for (key, label), colour in zip(lines, COLOURS, strict=False):
            curve(panel, part, "tilt_deg", key, ms=4, color=colour, label=label)
        for which, (marker, label) in enumerate((("+", "paper, not compensated"), ("x", "paper, compensated"))):
            panel.plot(list(PAPER_PX), [p[which] for p in PAPER_PX.values()], marker, color=GREY, ms=9, label=label)
        panel.set(title=f"noise {noise:g}", xlabel="tilt, degrees", yscale="log")
    panels[0].set_ylabel("error of the centre, RMS, px")
    legend_below(figure, panels, 3)
    return figure


def _ring_picture() -> Figure:
    rotation = rotations.exp(torch.tensor([0.0, math.radians(45), 0], dtype=F64))
    outer, inner = projected(rotation)
    figure, ((whole, near),) = subplots(1, 2, (11, 5))
    angle = torch.linspace(0, 2 * math.pi, 400, dtype=F64)
    points = (
        ("centre of the outer ellipse", outer.params[0, :2], "+"),
        ("centre of the inner ellipse", inner.params[0, :2], "x"),
        ("eq. (7)", compensate(outer, inner, RADII)[0][0], "s"),
        ("image of the ring's centre", torch.zeros(2, dtype=F64), "o"),
    )
    for panel in (whole, near):
        for fit in (outer, inner):
            panel.plot(*conics.points_on(fit.params, angle[None])[0].T, color="black", lw=1)
        for (label, place, marker), colour in zip(points, COLOURS, strict=False):
            panel.plot(*place.tolist(), marker, color=colour, ms=9, mfc="none", label=label)
        panel.set_aspect("equal")
        panel.invert_yaxis()
        panel.set_xlabel("u, px")
    reach = 1.6 * max(float(place.abs().max()) for _, place, _ in points)
    near.set(xlim=(-reach, reach), ylim=(reach, -reach))
    whole.set_ylabel("v, px")
    legend_below(figure, [near], 4)
    return figure


def projected(rotation: Tensor) -> tuple[EllipseFit, EllipseFit]:
    """Exact ellipses of both circles, with the optical axis at pixel (0, 0)."""
    center, normal = torch.tensor([0.0, 0, DISTANCE], dtype=F64), torch.tensor([0.0, 0, 1], dtype=F64)
    matrix = torch.diag(torch.tensor([FOCAL, FOCAL, 1], dtype=F64))
    ellipse = conics.circle_ellipse(matrix, rotation, center, normal, RADII[0])
    one = torch.ones(1, dtype=F64)
    outer, inner = (EllipseFit(e[None], torch.eye(5, dtype=F64)[None], one, one) for e in ellipse)
    return outer, inner


def measured(
    rotation: Tensor, shift: Tensor, noise: float, seed: int, correct: bool = True
) -> tuple[EllipseFit, EllipseFit]:
    """Ellipses of both circles in simulated frames, relative to the image of their centre.

    Args:
        rotation: (B, 3, 3) of the ring.
        shift: (B, 2) px of its centre from the optical axis.
        noise: grey levels.
        seed: of the noise.
        correct: free the edges from blur and curvature.
    """
    camera = tp.Camera.ideal(SIZE, SIZE, FOCAL)
    # a target has three markers at least: the others lie outside of the frame
    centers = torch.tensor([[0.0, 0, 0], [60, 0, 0], [0, 60, 0]], dtype=F64)
    radii = torch.cat([RADII, torch.tensor([[5.0, 2.0], [5, 1.5]], dtype=F64)])
    normals = torch.tensor([[0.0, 0, 1]], dtype=F64).expand(3, 3)
    target = tp.Target("table4", "light", torch.arange(3), centers, normals, radii)
    position = torch.nn.functional.pad(shift * (DISTANCE / FOCAL), (0, 1), value=DISTANCE)
    frames = add_noise(render(camera, target, rotation, position), noise, seed=seed)
    rings = measure_rings(frames, find_candidates(frames), camera, correct=correct)
    if rings.frame.sort().values.tolist() != list(range(len(frames))):
        raise RuntimeError(f"{len(rings)} rings found in {len(frames)} frames of one")
    order = rings.frame.argsort()
    outer, inner = rings.outer[order], rings.inner[order]
    for fit in (outer, inner):
        fit.params[:, :2] -= camera.matrix[:2, 2] + shift
    return outer, inner


def errors(outer: EllipseFit, inner: EllipseFit) -> Tensor:
    """(B, 3) px from the origin: outer ellipse, eq. (7), exact."""
    radii = RADII.expand(len(outer.params), 2)
    centers = (outer.params[:, :2], compensate(outer, inner, radii)[0], common_center(outer, inner, radii)[0])
    return torch.stack([center.norm(dim=-1) for center in centers], -1)

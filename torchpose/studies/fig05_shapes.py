"""The paper's Fig. 5 and section III-A: which shape of mark to choose, by measurement.

Chessboard vertex, filled circle, concentric rings, rectangle and cross on the same area of the plate (of their convex
hull: a circle of 30 px radius), the same blur, noise and start of the search. The vertex by `cv2.cornerSubPix`, the
others on the same Zernike edges: ellipse, two ellipses and eq. (7), diagonals of four fitted lines, both squares of the
cross. Grey 30 on 220, 8 bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpose.analysis import edge_noise, localisers
from torchpose.analysis.marks import Mark, cross, cross_extent, ink, marks
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.report.figures import COLOURS, subplots
from torchpose.rings import ideal_pixels
from torchpose.sim import add_noise, render
from torchpose.sim.shapes import rectangle
from torchpose.studies.fig05_recognition import capacities, recognition
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "fig05_shapes"
TITLE = "Fig. 5: shapes of marks"
SIZE, FOCAL_PX, DISTANCE_MM, RADIUS_PX = 129, 1111.11, 160.0, 30.0
AREA_MM2 = math.pi * (RADIUS_PX * DISTANCE_MM / FOCAL_PX) ** 2
DARK, LIGHT, PSF_PX, NOISE = 30.0, 220.0, 0.7, 2.0
OFF_AXIS_PX = (700.0, 450.0)  # of the principal point from the frame's middle, for the lens distortion
START_PX = 1.0  # most that the search starts off the mark, in u and v
PASSES = 3  # each from the centre that the one before found
LOST_PX = 0.5  # a larger error counts as a mark that was lost
BARS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True)
class Condition:
    """Of the frames of one point of a curve; degrees, px, grey levels. distortion: k1. cover: of the diameter."""

    noise: float = NOISE
    blur: float = PSF_PX
    tilt: float = 0.0
    distortion: float = 0.0
    corrected: bool = True
    cover: float = 0.0


CURVES: dict[str, dict[float, Condition]] = {
    "noise": {v: Condition(noise=v) for v in (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)},
    "blur_px": {v: Condition(blur=v) for v in (0.5, 0.7, 1.0, 1.5, 2.0)},
    "tilt_deg": {v: Condition(tilt=v) for v in (0.0, 15.0, 30.0, 45.0, 60.0)},
    "distortion_k1_uncorrected": {v: Condition(distortion=v, corrected=False) for v in (0.0, -0.05, -0.1, -0.15, -0.2)},
    "distortion_k1_corrected": {v: Condition(distortion=v) for v in (0.0, -0.05, -0.1, -0.15, -0.2)},
    "cover": {v: Condition(cover=v) for v in (0.0, 0.1, 0.2, 0.3, 0.4)},
}


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Accuracy against noise, blur, tilt, distortion, cover and the cross's area; recognition; codes."""
    count = 200 if full else 12
    rows: list[dict[str, Any]] = []
    for k, (curve, points) in enumerate(CURVES.items()):
        for value, condition in points.items():
            for mark in marks(AREA_MM2):
                rows.append(
                    {"curve": curve, "value": value, "mark": mark.name, **accuracy(mark, condition, count, seed)}
                )
        progress(0.7 * (k + 1) / len(CURVES))
    bars = [bar_row(bar, count, seed) for bar in BARS]
    progress(0.8)
    found = recognition(60 if full else 4, seed)
    progress(0.9)
    codes = capacities(60 if full else 4, seed)
    progress(1.0)
    return StudyResult(
        tables=[
            Table("accuracy", "Error of the centre by shape and condition", rows, _ACCURACY_NOTE),
            Table("cross", "Cross by the width of its bars", bars, _CROSS_NOTE),
            Table("recognition", "Marks missed and false among clutter", found, _CLUTTER_NOTE),
            Table("codes", "Codes that can be told apart", codes, _CODE_NOTE),
        ],
        pictures=[
            Picture("accuracy", "Error of the centre against the conditions", plot(rows)),
            Picture("cross", "Error of the cross against its ink", plot_bars(bars)),
            Picture("marks", "The marks", plot_marks()),
        ],
        comparisons=_comparisons(rows, bars, found, codes),
        statements=_statements(rows, bars, found),
        settings={"frames": count, "radius_px": RADIUS_PX, "noise": NOISE, "psf_px": PSF_PX},
    )


def view(condition: Condition, count: int, seed: int) -> tuple[Camera, Tensor, Tensor]:
    """Camera and poses R (count, 3, 3), t (count, 3): any roll, tilt about any axis, centre anywhere in a pixel."""
    g = torch.Generator().manual_seed(seed)
    roll, azimuth, u, v = torch.rand(4, count, dtype=torch.float64, generator=g)
    zero, tilt = torch.zeros(count, dtype=torch.float64), math.radians(condition.tilt)
    azimuth = 2 * math.pi * azimuth
    lean = rotations.exp(tilt * torch.stack([azimuth.cos(), azimuth.sin(), zero], -1))
    R = lean @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * roll], -1))
    middle = (SIZE - 1) / 2
    shift = OFF_AXIS_PX if condition.distortion else (0.0, 0.0)
    matrix = [[FOCAL_PX, 0, middle - shift[0]], [0, FOCAL_PX, middle - shift[1]], [0, 0, 1]]
    k1 = [condition.distortion, 0.0, 0.0, 0.0]
    camera = Camera(SIZE, SIZE, torch.tensor(matrix, dtype=torch.float64), torch.tensor(k1, dtype=torch.float64))
    ray = camera.undistort_points(torch.stack([middle + u - 0.5, middle + v - 0.5], -1))
    return camera, R, DISTANCE_MM * torch.cat([ray, torch.ones_like(ray[:, :1])], -1)


def pictures(mark: Mark, condition: Condition, camera: Camera, R: Tensor, t: Tensor, seed: int) -> Tensor:
    """(B, SIZE, SIZE) uint8."""
    covers = None
    if condition.cover:
        # from one side; the mark's own roll makes it any side
        reach = math.sqrt(AREA_MM2 / math.pi)
        at = reach * (2 - 2 * condition.cover)
        covers = rectangle((at, 0.0), 2 * reach, 6 * reach, 0.0, 128.0).in_frames(torch.arange(len(t)))
    drawn = mark.draw(DARK, (0.0, 0.0)).in_frames(torch.arange(len(t)))
    frames = render(camera, drawn, R, t, psf_sigma=condition.blur, light=LIGHT, covers=covers)
    return add_noise(frames, condition.noise, seed)


def outlines(mark: Mark, camera: Camera, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Raw pixels of the edges (B, E, S, 2) and of the centre (B, 2)."""
    points = torch.nn.functional.pad(mark.edges, (0, 1)).flatten(0, 1)
    pixels = camera.project(points @ R.mT + t[:, None]).unflatten(1, mark.edges.shape[:2])
    return pixels, camera.project(t)


def accuracy(mark: Mark, condition: Condition, count: int, seed: int) -> dict[str, Any]:
    """Error of the centre, root mean square per axis of those found, and how many were lost."""
    camera, R, t = view(condition, count, seed)
    frames = pictures(mark, condition, camera, R, t, seed)
    outline, truth = outlines(mark, camera, R, t)
    g = torch.Generator().manual_seed(seed + 1)
    start = START_PX * (2 * torch.rand(count, 2, dtype=torch.float64, generator=g) - 1)
    known = camera if condition.distortion and condition.corrected else None
    center = truth if known is None else ideal_pixels(camera, truth)
    found = center
    for _ in range(PASSES):
        found = mark.locate(frames, outline + start[:, None, None], truth + start, condition.blur, known)
        # edges are looked for in a band around the outline: where it lies off the mark, blurred edges are cut off
        start = (found - center).nan_to_num(nan=0.0).clamp(-2 * START_PX, 2 * START_PX)
    error = (found - center).norm(dim=-1)
    good = error < LOST_PX
    bound = localisers.centre_bound(
        outline, edge_noise(math.hypot(condition.noise, 12**-0.5), LIGHT - DARK, condition.blur)
    )
    return {
        "rms_px": float((error[good].square().mean() / 2).sqrt()),
        "bound_px": float(bound.square().mean().sqrt()) if not condition.cover else None,
        "lost": float(1 - good.double().mean()),
    }


def bar_row(bar: float, count: int, seed: int) -> dict[str, Any]:
    """Errors of a cross by its edges and by the centroid of its darkness."""
    mark = cross(AREA_MM2, bar, 150)
    by_edges = accuracy(mark, Condition(), count, seed)
    camera, R, t = view(Condition(), count, seed)
    frames = pictures(mark, Condition(), camera, R, t, seed)
    truth = outlines(mark, camera, R, t)[1]
    extent = cross_extent(AREA_MM2, bar) * FOCAL_PX / DISTANCE_MM
    # the farthest corners of the bars, and the blur
    half = 0.5 * extent * math.hypot(1, bar) + 3
    error = localisers.by_centroid(frames, truth + 0.5, half, DARK, LIGHT) - truth
    return {
        "bar_over_extent": bar,
        "ink_over_square": ink(bar),
        "edges_rms_px": by_edges["rms_px"],
        "centroid_rms_px": float((error.square().sum(-1).mean() / 2).sqrt()),
        "bound_px": by_edges["bound_px"],
        "lost": by_edges["lost"],
    }


_ACCURACY_NOTE = (
    "Root mean square per axis of the centres within 0.5 px; lost: the others. The bound takes all edges of a known "
    "shape, but for the vertex those that meet in it. The tilted filled circle errs by its eccentricity, which one "
    "circle does not tell."
)
_CROSS_NOTE = (
    "Ink over square: of the bounding square, the paper's area ratio; the convex hull is the same for all. Edges: "
    "lines fitted to all twelve edges. Centroid: mean of the darkness in a round window just around the cross."
)
_CLUTTER_NOTE = (
    "Some fifty things a frame: rectangles (35 %), words (25 %), discs (20 %), washers and crosses (10 % each). Rings "
    "are accepted by their code, all others by size and form; nothing in the clutter looks like a vertex."
)
_CODE_NOTE = (
    "Number of values that lie six standard deviations apart, by the spread of the measured value over tilts to 30 "
    "degrees and blur of 0.7 to 1.5 px. Ring: inner over outer radius. Cross: bar over extent. Rectangle: ratio of its "
    "sides, which tilt changes. Circle and vertex have no such value. The rings' spread is mostly that of their edges "
    "by curvature and blur, which this simple fit does not take off."
)


def _rms(rows: list[dict[str, Any]], curve: str, value: float) -> dict[str, float]:
    return {row["mark"]: row["rms_px"] for row in rows if row["curve"] == curve and row["value"] == value}


def _comparisons(
    rows: list[dict[str, Any]], bars: list[dict[str, Any]], found: list[dict[str, Any]], codes: list[dict[str, Any]]
) -> list[Comparison]:
    low, high = bars[1], bars[4]
    false = {row["mark"]: row["false_per_frame"] for row in found}
    by_code = {row["mark"]: row["codes"] for row in codes if row["noise"] == NOISE}
    tilted = _rms(rows, "tilt_deg", 30.0)
    wide, narrow = (f"{100 * row['ink_over_square']:.0f} %" for row in (high, low))
    ratio = {key: high[key] / low[key] for key in ("edges_rms_px", "centroid_rms_px")}
    rings = "concentric rings"
    return [
        Comparison("rings: error at 30 degrees of tilt, compensated", "px", "high accuracy", tilted[rings]),
        Comparison("rectangle: error at 30 degrees of tilt", "px", "high accuracy", tilted["rectangle"]),
        Comparison("rectangle: false recognitions a frame", "", "not robust", false["rectangle"]),
        Comparison("rings: false recognitions a frame", "", "robust", false[rings]),
        Comparison(f"cross, {wide} of ink over {narrow}: error by edges", "", "below 1", ratio["edges_rms_px"]),
        Comparison(f"cross, {wide} of ink over {narrow}: error by centroid", "", "below 1", ratio["centroid_rms_px"]),
        Comparison(f"rings: codes at noise {NOISE:g}", "", "enough", by_code[rings]),
        Comparison(f"cross: codes at noise {NOISE:g}", "", "insufficient", by_code["cross"]),
    ]


def _statements(rows: list[dict[str, Any]], bars: list[dict[str, Any]], found: list[dict[str, Any]]) -> list[str]:
    face, tilted = _rms(rows, "noise", NOISE), _rms(rows, "tilt_deg", 45.0)
    best = min(face, key=lambda name: face[name])
    cover = {row["mark"]: row for row in rows if row["curve"] == "cover" and row["value"] == 0.2}
    false = {row["mark"]: (row["missed"], row["false_per_frame"]) for row in found}
    least = min(bars, key=lambda row: row["edges_rms_px"])
    winners = {
        text: min(part := _rms(rows, curve, value), key=part.__getitem__)
        for text, curve, value in (
            ("noise 16", "noise", 16.0),
            ("blur 1.5 px", "blur_px", 1.5),
            ("30 degrees of tilt", "tilt_deg", 30.0),
            ("distortion taken off", "distortion_k1_corrected", -0.15),
            ("distortion left", "distortion_k1_uncorrected", -0.15),
        )
    }
    ring_places = sorted(face.values()).index(face["concentric rings"]) + 1
    return [
        f"Face on at noise {NOISE:g} the best is the {best} with {face[best]:.4f} px; the concentric rings have "
        f"{face['concentric rings']:.4f} px (place {ring_places} of {len(face)}): eq. (7) extrapolates, which costs "
        "noise.",
        f"At 45 degrees of tilt: {', '.join(f'{name} {value:.4f} px' for name, value in tilted.items())}.",
        "With 20 % of the diameter covered (part lost, error of the others): "
        + ", ".join(
            f"{name} {100 * row['lost']:.0f} %" + (f", {row['rms_px']:.3f} px" if row["lost"] < 1 else "")
            for name, row in cover.items()
        )
        + ".",
        "In clutter (part missed, false a frame): "
        + ", ".join(f"{name} {100 * missed:.0f} %, {wrong:.1f}" for name, (missed, wrong) in false.items())
        + ".",
        f"The cross is best by its edges at {100 * least['ink_over_square']:.0f} % of ink.",
        "The least error has, by condition: " + ", ".join(f"{text} the {name}" for text, name in winners.items()) + "; "
        f"fewest false recognitions: {min(false, key=lambda name: false[name][1])}.",
    ]


def plot(rows: list[dict[str, Any]]) -> Figure:
    """One panel a condition; dotted: the bound. Lost marks as the second line of panels."""
    figure, axes = subplots(2, len(CURVES), (21, 8))
    for column, curve in enumerate(CURVES):
        for k, mark in enumerate(dict.fromkeys(row["mark"] for row in rows)):
            part = [row for row in rows if row["curve"] == curve and row["mark"] == mark]
            x = [abs(row["value"]) for row in part]
            axes[0, column].semilogy(x, [row["rms_px"] for row in part], "o-", ms=3, color=COLOURS[k], label=mark)
            bounds = [(a, row["bound_px"]) for a, row in zip(x, part, strict=True) if row["bound_px"] is not None]
            axes[0, column].semilogy(*zip(*bounds, strict=True), ":", color=COLOURS[k]) if bounds else None
            axes[1, column].plot(x, [100 * row["lost"] for row in part], "o-", ms=3, color=COLOURS[k])
        axes[0, column].set_xlabel(curve)
        axes[1, column].set_xlabel(curve)
        axes[1, column].set_ylim(-3, 103)
    axes[0, 0].set_ylabel("error of the centre, rms per axis [px]")
    axes[1, 0].set_ylabel("lost [%]")
    axes[0, 0].legend(fontsize=8)
    return figure


def plot_bars(bars: list[dict[str, Any]]) -> Figure:
    """Error of the cross by edges and by centroid against its ink."""
    figure, axes = subplots(1, 1, (6, 4.5))
    x = [100 * row["ink_over_square"] for row in bars]
    for k, (key, label) in enumerate(
        (("edges_rms_px", "edges"), ("centroid_rms_px", "centroid"), ("bound_px", "bound"))
    ):
        axes[0, 0].semilogy(x, [row[key] for row in bars], "o-" if k < 2 else ":", color=COLOURS[k], label=label)
    axes[0, 0].axvline(50, color="k", lw=0.8, ls="--", label="the paper's 50 %")
    axes[0, 0].set_xlabel("ink over bounding square [%]")
    axes[0, 0].set_ylabel("error of the centre, rms per axis [px]")
    axes[0, 0].legend()
    return figure


def plot_marks() -> Figure:
    """One frame of each mark, plain and covered."""
    shown = (Condition(), Condition(tilt=45.0), Condition(cover=0.3, noise=8.0))
    all_marks = marks(AREA_MM2)
    figure, axes = subplots(len(shown), len(all_marks), (11, 7))
    for i, condition in enumerate(shown):
        for j, mark in enumerate(all_marks):
            frame = pictures(mark, condition, *view(condition, 1, 3), 3)[0]
            axes[i, j].imshow(frame.numpy(), cmap="gray", vmin=0, vmax=255)
            axes[i, j].axis("off")
            if i == 0:
                axes[i, j].set_title(mark.name, fontsize=9)
    return figure

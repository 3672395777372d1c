"""The paper's Fig. 5 and section III-A: which shape of mark to choose, by measurement.

Chessboard vertex, filled circle, concentric rings, rectangle and cross on the same area of the plate (of their convex
hull: a circle of 30 px radius), the same blur, noise and start of the search. The vertex by `cv2.cornerSubPix`, the
others on the same Zernike edges: ellipse, two ellipses and eq. (7), diagonals of four fitted lines, both squares of the
cross. Grey 30 on 220, 8 bit.
"""

import math
from dataclasses import dataclass

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.analysis import edge_noise, localisers
from torchpose.analysis.marks import Mark, cross, cross_extent, ink, marks
from torchpose.camera import Camera
from torchpose.io.rows import Row
from torchpose.report.figures import COLOURS, curve, frames, legend_below, subplots
from torchpose.rings import ideal_pixels
from torchpose.sim import add_noise, render
from torchpose.sim.shapes import rectangle
from torchpose.studies.fig05_recognition import capacities, recognition
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress, load_data
from torchpose.studies.views import turned

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


View = tuple[Camera, Tensor, Tensor]  # camera, and poses R (N, 3, 3), t (N, 3)
CURVES: dict[str, dict[float, Condition]] = {
    "noise": {v: Condition(noise=v) for v in (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)},
    "blur_px": {v: Condition(blur=v) for v in (0.5, 0.7, 1.0, 1.5, 2.0)},
    "tilt_deg": {v: Condition(tilt=v) for v in (0.0, 15.0, 30.0, 45.0, 60.0)},
    "distortion_k1_uncorrected": {v: Condition(distortion=v, corrected=False) for v in (0.0, -0.05, -0.1, -0.15, -0.2)},
    "distortion_k1_corrected": {v: Condition(distortion=v) for v in (0.0, -0.05, -0.1, -0.15, -0.2)},
    "cover": {v: Condition(cover=v) for v in (0.0, 0.1, 0.2, 0.3, 0.4)},
}

AXES = {  # what stands below a panel
    "noise": "noise [grey levels]",
    "blur_px": "blur [px]",
    "tilt_deg": "tilt [degrees]",
    "distortion_k1_uncorrected": "distortion k1, not corrected",
    "distortion_k1_corrected": "distortion k1, corrected",
    "cover": "share that is covered",
}


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Accuracy against noise, blur, tilt, distortion, cover and the cross's area; recognition; codes."""
    count = 200 if full else 12
    rows: list[Row] = []
    for k, (name, points) in enumerate(CURVES.items()):
        rows += [
            {"curve": name, "value": value, "mark": mark.name, **accuracy(mark, condition, count, seed)}
            for value, condition in points.items()
            for mark in marks(AREA_MM2)
        ]
        progress(0.7 * (k + 1) / len(CURVES))
    bars = [bar_row(bar, count, seed) for bar in BARS]
    progress(0.8)
    found = recognition(60 if full else 4, seed)
    progress(0.9)
    codes = capacities(60 if full else 4, seed)
    progress(1.0)
    notes = load_data("notes.yaml")[NAME]
    return StudyResult(
        tables=[
            Table("accuracy", "Error of the centre by shape and condition", rows, notes["accuracy"]),
            Table("cross", "Cross by the width of its bars", bars, notes["cross"]),
            Table("recognition", "Marks missed and false among clutter", found, notes["recognition"]),
            Table("codes", "Codes that can be told apart", codes, notes["codes"]),
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


def view(condition: Condition, count: int, seed: int) -> View:
    """Camera and ``count`` poses: any roll, tilt about any axis, centre anywhere in a pixel."""
    g = torch.Generator().manual_seed(seed)
    roll, azimuth, u, v = torch.rand(4, count, dtype=torch.float64, generator=g)
    R = turned(math.radians(condition.tilt), azimuth, roll)
    middle = (SIZE - 1) / 2
    shift = OFF_AXIS_PX if condition.distortion else (0.0, 0.0)
    matrix = [[FOCAL_PX, 0, middle - shift[0]], [0, FOCAL_PX, middle - shift[1]], [0, 0, 1]]
    k1 = [condition.distortion, 0.0, 0.0, 0.0]
    camera = Camera(SIZE, SIZE, torch.tensor(matrix, dtype=torch.float64), torch.tensor(k1, dtype=torch.float64))
    ray = camera.undistort_points(torch.stack([middle + u - 0.5, middle + v - 0.5], -1))
    return camera, R, DISTANCE_MM * torch.cat([ray, torch.ones_like(ray[:, :1])], -1)


def pictures(mark: Mark, condition: Condition, seen: View, seed: int) -> Tensor:
    """(B, SIZE, SIZE) uint8."""
    camera, R, t = seen
    covers = None
    if condition.cover:
        # from one side; the mark's own roll makes it any side
        reach = math.sqrt(AREA_MM2 / math.pi)
        at = reach * (2 - 2 * condition.cover)
        covers = rectangle((at, 0.0), 2 * reach, 6 * reach, 0.0, 128.0).in_frames(torch.arange(len(t)))
    drawn = mark.draw(DARK, (0.0, 0.0)).in_frames(torch.arange(len(t)))
    clean = render(camera, drawn, R, t, psf_sigma=condition.blur, light=LIGHT, covers=covers)
    return add_noise(clean, condition.noise, seed)


def outlines(mark: Mark, seen: View) -> tuple[Tensor, Tensor]:
    """Raw pixels of the edges (B, E, S, 2) and of the centre (B, 2)."""
    camera, R, t = seen
    points = torch.nn.functional.pad(mark.edges, (0, 1)).flatten(0, 1)
    pixels = camera.project(points @ R.mT + t[:, None]).unflatten(1, mark.edges.shape[:2])
    return pixels, camera.project(t)


def accuracy(mark: Mark, condition: Condition, count: int, seed: int) -> Row:
    """Error of the centre, root mean square per axis of those found, and how many were lost."""
    seen = view(condition, count, seed)
    images = pictures(mark, condition, seen, seed)
    outline, truth = outlines(mark, seen)
    g = torch.Generator().manual_seed(seed + 1)
    start = START_PX * (2 * torch.rand(count, 2, dtype=torch.float64, generator=g) - 1)
    known = seen[0] if condition.distortion and condition.corrected else None
    center = truth if known is None else ideal_pixels(known, truth)
    found = center
    for _ in range(PASSES):
        found = mark.locate(images, outline + start[:, None, None], truth + start, condition.blur, known)
        # edges are looked for in a band around the outline: where it lies off the mark, blurred edges are cut off
        start = (found - center).nan_to_num(nan=0.0).clamp(-2 * START_PX, 2 * START_PX)
    error = (found - center).norm(dim=-1)
    good = error < LOST_PX
    noise = edge_noise(math.hypot(condition.noise, 12**-0.5), LIGHT - DARK, condition.blur)
    bound = localisers.centre_bound(outline, noise)
    return {
        "rms_px": float((error[good].square().mean() / 2).sqrt()),
        "bound_px": float(bound.square().mean().sqrt()) if not condition.cover else None,
        "lost": float(1 - good.double().mean()),
    }


def bar_row(bar: float, count: int, seed: int) -> Row:
    """Errors of a cross by its edges and by the centroid of its darkness."""
    mark = cross(AREA_MM2, bar, 150)
    by_edges = accuracy(mark, Condition(), count, seed)
    seen = view(Condition(), count, seed)
    images, truth = pictures(mark, Condition(), seen, seed), outlines(mark, seen)[1]
    extent = cross_extent(AREA_MM2, bar) * FOCAL_PX / DISTANCE_MM
    # the farthest corners of the bars, and the blur
    half = 0.5 * extent * math.hypot(1, bar) + 3
    error = localisers.by_centroid(images, truth + 0.5, half, DARK, LIGHT) - truth
    return {
        "bar_over_extent": bar,
        "ink_over_square": ink(bar),
        "edges_rms_px": by_edges["rms_px"],
        "centroid_rms_px": float((error.square().sum(-1).mean() / 2).sqrt()),
        "bound_px": by_edges["bound_px"],
        "lost": by_edges["lost"],
    }


def _rms(rows: list[Row], name: str, value: float) -> dict[str, float]:
    return {row["mark"]: row["rms_px"] for row in rows if row["curve"] == name and row["value"] == value}


def _comparisons(rows: list[Row], bars: list[Row], found: list[Row], codes: list[Row]) -> list[Comparison]:
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


def _statements(rows: list[Row], bars: list[Row], found: list[Row]) -> list[str]:
    face, tilted = _rms(rows, "noise", NOISE), _rms(rows, "tilt_deg", 45.0)
    best = min(face, key=face.__getitem__)
    rings = face["concentric rings"]
    cover = [row for row in rows if row["curve"] == "cover" and row["value"] == 0.2]
    least = min(bars, key=lambda row: row["edges_rms_px"])
    winners = []
    for text, name, value in (
        ("noise 16", "noise", 16.0),
        ("blur 1.5 px", "blur_px", 1.5),
        ("30 degrees of tilt", "tilt_deg", 30.0),
        ("distortion taken off", "distortion_k1_corrected", -0.15),
        ("distortion left", "distortion_k1_uncorrected", -0.15),
    ):
        errors = _rms(rows, name, value)
        winners.append(f"{text} the {min(errors, key=errors.__getitem__)}")
    return [
        f"Face on at noise {NOISE:g} the best is the {best} with {face[best]:.4f} px; the concentric rings have "
        f"{rings:.4f} px (place {sorted(face.values()).index(rings) + 1} of {len(face)}): eq. (7) extrapolates, which "
        "costs noise.",
        f"At 45 degrees of tilt: {', '.join(f'{name} {value:.4f} px' for name, value in tilted.items())}.",
        "With 20 % of the diameter covered (part lost, error of the others): "
        + ", ".join(
            f"{row['mark']} {100 * row['lost']:.0f} %" + (f", {row['rms_px']:.3f} px" if row["lost"] < 1 else "")
            for row in cover
        )
        + ".",
        "In clutter (part missed, false a frame): "
        + ", ".join(f"{row['mark']} {100 * row['missed']:.0f} %, {row['false_per_frame']:.1f}" for row in found)
        + ".",
        f"The cross is best by its edges at {100 * least['ink_over_square']:.0f} % of ink.",
        f"The least error has, by condition: {', '.join(winners)}; fewest false recognitions: "
        f"{min(found, key=lambda row: row['false_per_frame'])['mark']}.",
    ]


def plot(rows: list[Row]) -> Figure:
    """One panel a condition; dotted: the bound. Lost marks as the second line of panels."""
    figure, axes = subplots(2, len(CURVES), (21, 8), sharex="col")
    for (error, lost), name in zip(axes.T, CURVES, strict=True):
        for k, mark in enumerate(dict.fromkeys(row["mark"] for row in rows)):
            part = [
                row | {"size": abs(row["value"]), "lost_percent": 100 * row["lost"]}
                for row in rows
                if row["curve"] == name and row["mark"] == mark
            ]
            curve(error, part, "size", "rms_px", ms=3, color=COLOURS[k], label=mark)
            curve(error, [row for row in part if row["bound_px"]], "size", "bound_px", ":", color=COLOURS[k])
            curve(lost, part, "size", "lost_percent", ms=3, color=COLOURS[k])
        error.set(yscale="log")
        lost.set(xlabel=AXES[name], ylim=(-3, 103))
    axes[0, 0].set_ylabel("error of the centre, RMS per axis [px]")
    axes[1, 0].set_ylabel("lost [%]")
    legend_below(figure, axes[0, :1], 6, {"Cramer-Rao bound": ":"})
    return figure


def plot_bars(bars: list[Row]) -> Figure:
    """Error of the cross by edges and by centroid against its ink."""
    figure, ((panel,),) = subplots(1, 1, (6, 4.5))
    part = [row | {"ink_percent": 100 * row["ink_over_square"]} for row in bars]
    for k, (name, style) in enumerate((("edges_rms", "o-"), ("centroid_rms", "o-"), ("bound", ":"))):
        curve(panel, part, "ink_percent", f"{name}_px", style, color=COLOURS[k], label=name.split("_")[0])
    panel.axvline(50, color="k", lw=0.8, ls="--", label="the paper's 50 %")
    panel.set(xlabel="ink over bounding square [%]", ylabel="error of the centre, RMS per axis [px]", yscale="log")
    legend_below(figure, [panel], 4, fontsize=8)
    return figure


def plot_marks() -> Figure:
    """One frame of each mark, plain and covered."""
    sheet = []
    for condition in (Condition(), Condition(tilt=45.0), Condition(cover=0.3, noise=8.0)):
        for mark in marks(AREA_MM2):
            title = mark.name if condition == Condition() else ""
            sheet.append((title, pictures(mark, condition, view(condition, 1, 3), 3)[0].numpy()))
    return frames(sheet, 3, (11, 7), fontsize=9)

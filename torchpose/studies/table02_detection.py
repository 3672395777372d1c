"""The paper's Table II: centre errors of the coarse detection on its scene, beside ELSDc, and where 4.95 px come from.

Four fronto-parallel rings, 2600 x 3648 px, 220/30 grey, PSF 0.7 px, white noise, 8 bit. Every circle counts: found
within 6 px of its centre and 5 % of its radius, everything else is false. ELSDc's outputs are those of its authors'
program, one run for each noise (data/elsdc_table2_scene.json).
"""

import math

import torch
from torch import Tensor

from torchpose.detect import find_candidates
from torchpose.io.rows import Row
from torchpose.studies.study import Comparison, Progress, StudyResult, Table, ignore_progress, load_data

NAME = "table02_detection"
TITLE = "Table II: circles found by the coarse detection"
PAPER_PX: dict[int, float] = load_data("paper.yaml")["table02"]  # mean over its four markers
NOISE = tuple(PAPER_PX)
ELSDC_OFFSET = 0.5  # its gradient's stencil is centred at (+0.5, +0.5), which its ellipses lack
REDUCTION = 4


def run(
    *, full: bool = False, seed: int = 0, progress: Progress = ignore_progress, seeds: int | None = None
) -> StudyResult:
    """Circles found, false ones and centre errors at every noise; the same with the paper's two mistakes made.

    Args:
        seeds: noisy frames for each noise; by default 20, or 3 for a quick run.
    """
    count = seeds or (20 if full else 3)
    data = reference()
    clean, circles = scene(data)
    elsdc = {run["noise_sigma"]: run["ellipses"] for run in data["runs"]}
    rows: list[Row] = []
    explained: list[Row] = []
    for done, noise in enumerate(NOISE):
        frames = count if noise else 1
        worst, false = len(circles), 0
        errors: list[float] = []
        shifted: list[float] = []
        for number in range(frames):
            g = torch.Generator().manual_seed(seed + 1000 * noise + number)
            frame = (clean + noise * torch.randn(clean.shape, generator=g)).round().clamp(0, 255).to(torch.uint8)
            found = find_candidates(frame[None], REDUCTION).ellipse
            hits, wrong, some = compare(found, circles)
            worst, false, errors = min(worst, hits), false + wrong, errors + some
            shifted += compare(mistaken(found), circles)[2]
            progress((done + (number + 1) / frames) / len(NOISE))
        theirs = torch.tensor([[e[k] for k in ("x", "y", "a", "b", "theta")] for e in elsdc[noise]]).double()
        theirs[:, :2] += ELSDC_OFFSET
        rows.append(
            {"noise": noise, "frames": frames}
            | _columns("", worst, false, errors)
            | _columns("elsdc_", *compare(theirs, circles))
        )
        mean = sum(shifted) / len(shifted) if shifted else None
        explained.append({"noise": noise, "mean_with_both_mistakes_px": mean, "paper_mean_px": PAPER_PX[noise]})
    axis = (REDUCTION - 1) / 2 + REDUCTION * ELSDC_OFFSET
    title = "Circles found of 8 (the worst frame), false ones and centre errors"
    return StudyResult(
        tables=[
            Table("table02", title, rows, load_data("notes.yaml")[NAME]["table02"]),
            Table("offset", "The same detections with both mistakes of convention made", explained),
        ],
        comparisons=[
            Comparison(f"coarse centre error, noise {row['noise']}", "px", PAPER_PX[row["noise"]], row["rms_px"])
            for row in rows
        ],
        statements=[
            f"The paper's 4.95 px: a frame reduced by {REDUCTION} has its pixel x at u = {REDUCTION} x + "
            f"{(REDUCTION - 1) / 2}. Whoever multiplies by {REDUCTION} alone, and takes ELSDc's ellipses without the "
            f"{ELSDC_OFFSET} px of its stencil, is off by {axis} px per axis, {math.sqrt(2) * axis:.3f} px in all, "
            "whatever the noise.",
        ],
        settings={"frames_per_noise": count},
    )


def _columns(who: str, hits: int, wrong: int, errors: list[float]) -> Row:
    rms = math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else None
    numbers = {"found_of_8": hits, "false": wrong, "rms_px": rms, "largest_px": max(errors, default=None)}
    return {f"{who}{name}": number for name, number in numbers.items()}


def reference() -> Row:
    """Scene and outputs of ELSDc."""
    found: Row = load_data("elsdc_table2_scene.json")
    return found


def scene(data: Row) -> tuple[Tensor, Tensor]:
    """Noise-free frame (H, W) and its circles (C, 3): u, v, radius, outer and inner of each marker in turn."""
    about = data["scene"]
    circles = []
    sigma = math.sqrt(about["psf_sigma_px"] ** 2 + 1 / 12)  # blur and pixel
    v, u = torch.meshgrid(torch.arange(about["height"]), torch.arange(about["width"]), indexing="ij")
    frame = torch.full(u.shape, float(about["background"]))
    contrast = float(about["ring"] - about["background"])
    for marker in about["markers"]:
        r = torch.hypot(u - float(marker["center"][0]), v - float(marker["center"][1]))
        for radius, sign in ((about["outer_radius_px"], 1.0), (marker["inner_radius_px"], -1.0)):
            frame += sign * contrast * torch.special.ndtr((radius - r) / sigma)
            circles.append([*marker["center"], radius])
    return frame, torch.tensor(circles, dtype=torch.float64)


def compare(found: Tensor, circles: Tensor) -> tuple[int, int, list[float]]:
    """Circles found, false ones, and centre errors (px) of ellipses (M, 5)."""
    miss = torch.linalg.vector_norm(found[:, None, :2] - circles[:, :2], dim=-1)
    size = (found[:, None, 2:4] / circles[:, 2, None] - 1).abs().amax(-1)
    hit = (miss < 6) & (size < 0.05)
    errors = torch.where(hit, miss, torch.inf).amin(0) if len(found) else torch.full((len(circles),), torch.inf)
    repeated = int((hit.sum(0) - 1).clamp_min(0).sum())
    return int(errors.isfinite().sum()), int((~hit.any(1)).sum()) + repeated, errors[errors.isfinite()].tolist()


def mistaken(found: Tensor) -> Tensor:
    """Ellipses with both conventions missed: half a reduced pixel of the stencil and the reduction's own offset."""
    reduced = (found[:, :2] - (REDUCTION - 1) / 2) / REDUCTION
    return torch.cat([REDUCTION * (reduced - ELSDC_OFFSET), found[:, 2:]], -1)

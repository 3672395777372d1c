"""The paper's Table III: centre errors of a ring that faces the camera, with the Cramer-Rao bound.

Scene: rings of grey 30 on 220, outer radius 200 px, inner 80, 100, 120, 140 px, near the four centres of the paper in
a frame of 2600 x 3648, point-spread function 0.7 px, 8 bit. Every seed moves every centre by a random part of a pixel:
at whole pixels the errors of an edge operator cancel by symmetry. RMS per axis over seeds and rings. ``paper`` and
``corrected``: outer ellipse alone, as the paper measures it, edges as read and freed from blur and curvature.
``edges`` and ``photometric``: pose refinement with the rotation held, so that only the centre is free. ``worst``: the
longest error of all, ``bias``: the longest mean error of a ring. The bound counts rounding as noise of 1/12.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

import torchpose as tp
from torchpose.detect import find_candidates
from torchpose.io.rows import Row
from torchpose.refine import Sight, refine_edges, refine_photometric
from torchpose.rings import Rings, measure_rings
from torchpose.sim import add_noise, render
from torchpose.studies.study import Comparison, Progress, StudyResult, Table, ignore_progress, load_data

NAME = "table03_centers"
TITLE = "Table III: centres of rings that face the camera"
F64 = torch.float64
WIDTH, HEIGHT, FOCAL = 2600, 3648, 40_000.0
CENTERS = torch.tensor([[1057.0, 513], [2153, 601], [2097, 2041], [881, 3409]], dtype=F64)
RADII_PX = torch.tensor([[200.0, 80], [200, 100], [200, 120], [200, 140]], dtype=F64)
PAPER_PX: dict[int, list[float]] = load_data("paper.yaml")["table03"]  # of its four centres
NOISE = (0, 1, 2, 4, 8, 16)
PSF = 0.7
METHODS = ("paper", "corrected", "edges", "photometric")
HELD = 1e12  # information about rotation and depth: as good as known


def run(
    *, full: bool = False, seed: int = 0, progress: Progress = ignore_progress, seeds: int | None = None
) -> StudyResult:
    """Centre errors by every method at every noise, beside the bound.

    Args:
        seeds: frames for each noise; by default 100, or 4 for a quick run. A frame has four rings.
    """
    count = seeds or (100 if full else 4)
    cam = camera()
    rows: list[Row] = []
    comparisons = []
    for done, noise in enumerate(NOISE):
        trials = []
        for number in range(count):
            trials.append(errors(noise, 1000 * (seed * len(NOISE) + done) + number, cam))
            progress((done + (number + 1) / count) / len(NOISE))
        limit = math.sqrt(sum(bound(ring, noise) ** 2 for ring in range(4)) / len(RADII_PX))
        paper_px = max(PAPER_PX[noise]) if noise in PAPER_PX else None
        row: Row = {"noise": noise, "frames": count, "bound_px": limit, "paper_largest_px": paper_px}
        for method in METHODS:
            every = torch.stack([trial[method] for trial in trials])
            rms = float(every.square().mean().sqrt())
            # the paper's figure is the length of one error
            worst, bias = (float(error.norm(dim=-1).max()) for error in (every, every.mean(0)))
            row |= {f"{method}_px": rms, f"{method}_over_bound": rms / limit}
            row |= {f"{method}_worst_px": worst, f"{method}_bias_px": bias}
        rows.append(row)
        what = f"centre error per axis, noise {noise}"
        comparisons.append(Comparison(what, "px", paper_px, row["photometric_px"], limit))
    most = max(row["paper_worst_px"] for row in rows if row["paper_largest_px"])
    return StudyResult(
        tables=[Table("table03", "RMS centre error per axis over frames and rings, and its ratio to the bound", rows)],
        comparisons=comparisons,
        statements=[
            f"The paper's own chain (Zernike edges as read, outer ellipse) errs by at most {most:.4f} px up to "
            f"noise 8; the paper publishes up to {max(map(max, PAPER_PX.values()))} px.",
        ],
        settings={"frames_per_noise": count, "psf_sigma_px": PSF},
    )


def camera() -> tp.Camera:
    return tp.Camera.ideal(WIDTH, HEIGHT, FOCAL)


def scene(shift: Tensor, cam: tp.Camera) -> tuple[tp.Target, Tensor, Tensor]:
    """Target whose rings fall on the centres moved by ``shift`` (4, 2) px from distance 1 m, and its pose."""
    scale = 1000.0 / FOCAL  # mm a pixel
    at = (CENTERS + shift - cam.matrix[:2, 2]) * scale
    centers = torch.nn.functional.pad(at, (0, 1))
    normals = torch.tensor([[0.0, 0, 1]], dtype=F64).expand(4, 3)
    target = tp.Target("table3", "light", torch.arange(4), centers, normals, RADII_PX * scale)
    return target, torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 1000.0]], dtype=F64)


def nearest(rings: Rings) -> Tensor:
    """(4,) index of the ring nearest to each centre."""
    return torch.cdist(CENTERS, rings.outer_raw[:, :2]).argmin(1)


def errors(noise: float, seed: int, cam: tp.Camera) -> dict[str, Tensor]:
    """Errors (4, 2) px of the centres by each method."""
    g = torch.Generator().manual_seed(seed)
    shift = torch.rand(4, 2, dtype=F64, generator=g) - 0.5
    target, r, t = scene(shift, cam)
    frame = add_noise(render(cam, target, r, t, psf_sigma=PSF), noise, seed=seed)
    truth = CENTERS + shift
    candidates = find_candidates(frame)
    plain = measure_rings(frame, candidates, cam, correct=False)
    better = measure_rings(frame, candidates, cam)
    at = nearest(better)
    out = {"paper": plain.outer.params[nearest(plain), :2] - truth, "corrected": better.outer.params[at, :2] - truth}

    # every ring a target of its own, at rest at its own origin, its start off by what the ellipse says
    one = torch.zeros(4, dtype=torch.int64)
    scale = 1000.0 / FOCAL
    start = torch.nn.functional.pad((better.outer.params[at, :2] - cam.matrix[:2, 2]) * scale, (0, 1), value=1000.0)
    shapes = torch.stack([better.outer_raw[at], better.inner_raw[at]], 1)[:, None]
    mask, polarity = torch.ones(4, 1, dtype=torch.bool), torch.ones(4, 1, dtype=F64)
    model = (torch.zeros(4, 1, 3, dtype=F64), target.normals[:, None], target.radii[:, None])
    sight = Sight(one, mask, shapes, polarity, *model, frame, cam)
    prior = torch.diag(torch.tensor([0.0, 0, HELD, HELD, HELD, HELD], dtype=F64)).expand(4, 6, 6)
    rotation = torch.eye(3, dtype=F64).expand(4, 3, 3)
    for name, refine in (("edges", refine_edges), ("photometric", refine_photometric)):
        refined = refine(sight, rotation, start, prior=prior)
        out[name] = FOCAL * refined.t[:, :2] / refined.t[:, 2:] + cam.matrix[:2, 2] - truth
    return out


def bound(ring: int, noise: float) -> float:
    """Cramer-Rao bound, px per axis, of the centre of a ring; its radii, blur and two grey levels unknown as well.

    Fisher information from central differences of the renderer, over all pixels of a box around the ring.
    """
    size, step, scale = 441, 0.05, 1000.0 / FOCAL
    target, *pose = scene(torch.zeros(4, 2, dtype=F64), camera())
    principal = (size - 1) / 2 - target.centers[ring, :2] / scale

    def picture(change: Tensor) -> Tensor:
        """Pixels with the centre, the radii and the blur changed, px."""
        matrix = camera().matrix
        matrix[:2, 2] = principal + change[:2]
        box = tp.Camera(width=size, height=size, matrix=matrix, distortion=torch.zeros(4, dtype=F64))
        radii = target.radii.clone()
        radii[ring] += change[2:4] * scale
        return render(box, replace(target, radii=radii), *pose, psf_sigma=PSF + float(change[4])).double().flatten()

    columns = [(picture(change) - picture(-change)) / (2 * step) for change in step * torch.eye(5, dtype=F64)]
    fraction = (picture(torch.zeros(5, dtype=F64)) - 30) / 190
    jacobian = torch.stack([*columns, fraction, 1 - fraction], 1)
    information = jacobian.T @ jacobian / (noise**2 + 1 / 12)
    return math.sqrt(torch.linalg.inv(information).diagonal()[:2].mean())

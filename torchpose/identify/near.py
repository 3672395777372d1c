"""Stage: where the rings of a sequence are by its last poses, without a search: candidates that are measured at once.

Edges are looked for within a few pixels, and targets move by more. So each marker is drawn as the last pose shows it,
and found again by correlation within what it may have moved; the shifts of a target's markers correct its pose by one
step. Where every marker has a ring of its place and code alone, nothing else need be asked; all others are named by
their codes as any ring is.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.detect import Candidates
from torchpose.geometry import conics, rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import solve_scaled
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.rows import replace
from torchpose.geometry.segments import segment_sum, values_at
from torchpose.identify.by_codes import by_codes
from torchpose.identify.markers import Identified
from torchpose.identify.scene import Scene
from torchpose.identify.second_look import near_place, predicted
from torchpose.rings import Rings

MOST_MOVE = 20.0  # px between two frames (convention): 0.1 m/s at 1 m, 50 frames/s and a 12 mm lens
_AROUND = 1.25  # of the outer circle: the ground that belongs to its picture (convention)
_ACROSS = 3  # cells across the ring, or its hole, at which it is still told from a disc (convention)
_TURN = 0.1  # rad between two frames, as a deviation: what shifts of centres hardly tell stays as it was (convention)


class Places(NamedTuple):
    """P markers in view: row and number (P,), ellipses (P, 2, 5), outer and inner one, in pixels of the frame and in
    ideal ones; under poses R (N, 3, 3), t (N, 3) of all rows."""

    row: Tensor
    marker: Tensor
    raw: Tensor
    ideal: Tensor
    R: Tensor
    t: Tensor


@checked
def find_near(scene: Scene, R: Tensor, t: Tensor) -> Places | None:
    """Where the markers must be; None where no pose is known.

    Args:
        scene: a row for every frame and target.
        R: (N, 3, 3), the last pose of each row, NaN where it is not known.
        t: (N, 3), the same, mm.
    """
    last = _places(scene, R, t, rough=True)
    if last.row.numel() == 0:
        return None
    shift = _shifts(scene, last)
    if shift is None:
        return None
    return _places(scene, *_corrected(scene, R, t, last, shift))


@checked
def outlines(scene: Scene, there: Places) -> tuple[Candidates, Tensor]:
    """Places as candidates, and their inner ellipses (P, 5)."""
    polarity = scene.table.polarity[scene.target][there.row]
    return Candidates.unscored(scene.frame[there.row], there.raw[:, 0], polarity), there.raw[:, 1]


@checked
def confirmed(scene: Scene, there: Places, rings: Rings, of: Tensor) -> Identified | None:
    """The rings by marker where every marker of every row has the one that lies in its place, None otherwise.

    Args:
        scene: a row for every frame and target.
        there: where the markers must be.
        rings: K, measured there.
        of: (K,), the place of each.
    """
    named = by_codes(scene, rings)
    if named is None:
        return None
    wanted = there.ideal[of, 0]
    miss = torch.linalg.vector_norm(rings.outer.params[:, :2] - wanted[:, :2], dim=-1)
    own = named.ring[there.row[of], there.marker[of]] == torch.arange(len(of), device=of.device)
    if not bool((own & (miss < near_place(wanted))).all()):
        return None
    return replace(named, R=there.R, t=there.t)


def _places(scene: Scene, R: Tensor, t: Tensor, *, rough: bool = False) -> Places:
    """``rough``: circles have the shapes that a camera without distortion would see."""
    markers, camera = scene.table[scene.target], scene.camera
    row, marker = (markers.valid & t.isfinite().all(1)[:, None]).nonzero().unbind(-1)
    ideal, raw, depth = predicted(markers, camera, R[row], t[row], (row, marker), rough=rough)
    outer, limit = raw[:, 0], raw.new_tensor([camera.width - 1, camera.height - 1])
    seen = ((outer[:, :2] > 0) & (outer[:, :2] < limit)).all(-1) & (outer[:, 2] < limit.amin()) & (depth > 0)
    seen &= raw.isfinite().flatten(1).all(1)
    if bool(seen.all()):
        return Places(row, marker, raw, ideal, R, t)
    return Places(row[seen], marker[seen], raw[seen], ideal[seen], R, t)


def _shifts(scene: Scene, at: Places) -> Tensor | None:
    """By how many px (P, 2) each marker has moved; None where the frame is too small to look so far."""
    frames = scene.frames
    height, width = frames.shape[-2:]
    outer, inner = at.raw.unbind(1)
    cell = max(1, int(float(torch.minimum(outer[:, 3] - inner[:, 3], inner[:, 3]).amin()) / _ACROSS))
    reach, span = math.ceil(_AROUND * float(outer[:, 2].amax()) / cell), math.ceil(MOST_MOVE / cell)
    side = (2 * (reach + span) + 1) * cell
    if side > min(height, width):
        return None
    limit = torch.tensor([width - side, height - side], device=frames.device)
    corner = (outer[:, :2] - 0.5 * (side - 1)).round().long().clamp_min(0).minimum(limit)
    along = torch.arange(side, device=frames.device)
    first = (scene.frame[at.row] * height + corner[:, 1]) * width + corner[:, 0]
    windows = values_at(frames, first[:, None, None] + along[:, None] * width + along)
    cells = torch.nn.functional.avg_pool2d(windows[None].nan_to_num(nan=0.0), cell)
    drawn = _drawn(at.raw, cell, reach) * scene.table.polarity[scene.target][at.row][:, None, None]
    size, count = cells.shape[-2:], cells.shape[-1] - drawn.shape[-1] + 1
    here, wanted = (torch.fft.rfft2(part, s=size) for part in (cells[0], drawn.to(cells)))
    score = torch.fft.irfft2(here * wanted.conj(), s=size)[:, :count, :count]  # further shifts go round the edges
    best = score.flatten(1).argmax(1)
    found = torch.stack([best % count, best // count], -1)
    return corner + (found + reach) * cell + 0.5 * (cell - 1) - outer[:, :2]


def _drawn(raw: Tensor, cell: int, reach: int) -> Tensor:
    """Pictures (P, k, k) of dark rings: the mean grey around and inside of the ring less that on it, as weights."""
    along = torch.arange(-reach, reach + 1, dtype=raw.dtype, device=raw.device) * cell
    xy = torch.stack(torch.meshgrid(along, along, indexing="xy")).flatten(1)
    offset = (raw[:, :, :2] - raw[:, :1, :2])[..., None]
    u, v = (conics.inverse_shape(raw) @ (xy - offset)).unbind(2)  # (P, 2, k k)
    rho = torch.addcmul(u * u, v, v).sqrt_()
    # cells on a rim belong to both sides
    steep = raw[:, :, 3:4] / cell
    inside, hole = ((1 - rho) * steep + 0.5).clamp(0, 1).unbind(1)
    around = ((_AROUND - rho[:, 0]) * steep[:, 0] + 0.5).clamp(0, 1) - inside
    parts = torch.stack([0.5 * around, 0.5 * hole, hole - inside], 1)
    share = parts / parts.sum(-1, keepdim=True).abs().clamp_min(1e-9) * parts.new_tensor([0.5, 0.5, 1.0])[:, None]
    return share.sum(1).unflatten(1, (2 * reach + 1, -1))


def _corrected(scene: Scene, R: Tensor, t: Tensor, at: Places, shift: Tensor) -> tuple[Tensor, Tensor]:
    """The poses after one step to where their markers have moved."""
    row, focal = at.row, scene.camera.matrix.diagonal()[:2]
    arm = (R[row] @ scene.table.centers[scene.target[row], at.marker][..., None]).squeeze(-1)
    x = arm + t[row]
    jacobian = by_pose(focal[:, None] * image_by_point(x[:, :2] / x[:, 2:], x[:, 2]), arm)
    # shifts are good to a pixel; what they do not tell of is within what a target moves and turns by
    move = (focal.mean() / (MOST_MOVE * t[:, 2:])).square().expand(-1, 3)
    prior = torch.cat([move, torch.full_like(move, _TURN**-2)], 1)
    information = segment_sum(jacobian.mT @ jacobian, row, len(R)) + torch.diag_embed(prior)
    step = solve_scaled(information, segment_sum((jacobian.mT @ shift[..., None]).squeeze(-1), row, len(R)))
    return rotations.exp(step[:, 3:]) @ R, t + step[:, :3]

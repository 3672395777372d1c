"""The circle inside each candidate, from the mean radial profile of grey: ratio of the radii, and where it shows."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics, sectors
from torchpose.geometry.blurred_edge import MOST
from torchpose.geometry.constants import constant, either, finite, numbers
from torchpose.geometry.grey import full_scale
from torchpose.geometry.least_squares import solve_scaled
from torchpose.geometry.robust import RATIO_RANGE
from torchpose.geometry.rows import Rows
from torchpose.geometry.sectors import SECTORS
from torchpose.geometry.segments import values_at

_RADII = 72
_INNERMOST, _OUTERMOST = 0.08, 1.12  # of the outer ellipse, the range of the radial profile
# of the outer edge's slope in the mean radial profile: a blur of the inner circle's size leaves as much (convention)
_LEAST_PEAK = 0.25
# of the radii that have a rise, the first that is farther out than an inner circle
_FAR = math.floor((RATIO_RANGE[1] - _INNERMOST) / (_OUTERMOST - _INNERMOST) * (_RADII - 1))
_EIGHTHS = 8  # parts of the perimeter in which the blur is looked at
# of the semi-minor axis: from which shift of the centres on perspective smears the profile (convention: a sample of it)
_PARTED = 0.02


@dataclass(frozen=True, eq=False)
class InnerCircles(Rows):
    """What is inside each of M candidates.

    Attributes:
        ratio: of the radii.
        found: whether there is a circle.
        ellipse: the inner circle, about.
        seen: the sectors in which its own edge shows, see `geometry.sectors`.
        blur: of the outer edge, px^2, about; see `geometry.blur`.
        clipped: whether most of the paper, or of a light ring, is at the grey value at which the frame is clipped.
    """

    ratio: Float[Tensor, " M"]
    found: Bool[Tensor, " M"]
    ellipse: Float[Tensor, "M 5"]
    seen: Bool[Tensor, "M 48"]
    blur: Float[Tensor, "M 3"]
    clipped: Bool[Tensor, " M"]


def find_inner(
    frames: Tensor, candidates: Candidates, camera: Camera | None = None, known: Tensor | None = None
) -> InnerCircles:
    """The circle inside each candidate, from the mean radial profile of grey.

    The profile is taken along radii scaled by the candidate's own ellipse, so it averages over the whole ring: an inner
    circle of two pixels that no region growing would hold together still stands out. Perspective parts the centres of
    concentric circles: the one scaled by q is shifted by (1 - q^2) d, where d is where the centre of the outer circle
    is seen, relative to the centre of its ellipse. Both planes that the ellipse may lie in are tried, and the profile
    with the steeper edge counts.

    Args:
        camera: for d; without one the centres are taken to coincide.
        known: (M, 5), the inner circles, about, where they are known.
    """
    height, width = frames.shape[-2:]
    device = frames.device
    rho, circle, shifted = _grid(device)
    own, apart = _planes(candidates, camera) if known is None else _plane(candidates, known)
    outer = candidates.ellipse.index_select(0, own)
    shape = conics.shape_matrix(outer)
    shift = shifted * apart[..., None]  # (P, 2, R)
    u, v = ((shape @ circle)[:, :, None, :] * rho[:, None] + (outer[:, :2, None] + shift)[..., None]).round_().unbind(1)
    u, v = u.clamp_(0, width - 1), v.clamp_(0, height - 1)
    cell = v.add_(height * candidates.frame[own, None, None]).mul_(width).add_(u).long()
    grey = values_at(frames, cell)
    at, polarity = rho[1:-1], candidates.polarity[own]
    # what covers the outer circle on one side hides the inner one there too: only directions that show the outer count
    far = _FAR
    edge = ((grey[:, far + 2 :] - grey[:, far:-2]) * polarity[:, None, None].float()).amax(1)
    seen = edge > 0.5 * edge.nanmedian(-1, keepdim=True).values
    if known is not None:
        ratio = _ratio(known, outer)
        blur, some = _edge_blur(grey, seen, outer, ratio, at), torch.ones_like(candidates.frame, dtype=torch.bool)
        return InnerCircles(ratio, some, known, seen, blur, _clipped(grey, seen, candidates.frame))
    profile = _mean_profile(grey, seen, frames.is_floating_point())
    rise = (profile[:, 2:] - profile[:, :-2]) * polarity[:, None]
    outermost = rise.masked_fill(at < RATIO_RANGE[1], -torch.inf).amax(-1)
    fall = (-rise).masked_fill((at < RATIO_RANGE[0]) | (at > RATIO_RANGE[1]), -torch.inf)
    peak, best = fall.nan_to_num(nan=-torch.inf).max(-1)
    # of both planes the one with the steeper edge
    count = len(candidates)
    steepest = torch.full((count,), -torch.inf, dtype=peak.dtype, device=device).scatter_reduce_(0, own, peak, "amax")
    number = torch.arange(own.numel(), device=device)
    first = torch.full_like(candidates.frame, own.numel())
    first.scatter_reduce_(0, own, torch.where(peak == steepest[own], number, own.numel()), "amin")
    ratio = at[best[first]]
    center = candidates.ellipse[:, :2] + (1 - ratio.square())[:, None] * apart[first]
    inner = torch.cat([center, candidates.ellipse[:, 2:4] * ratio[:, None], candidates.ellipse[:, 4:]], -1)
    found = (outermost[first] > 0) & (steepest > _LEAST_PEAK * outermost[first])
    blur = _edge_blur(grey[first], seen[first], candidates.ellipse, ratio, at)
    clipped = _clipped(grey, seen, candidates.frame[own])[first]
    return InnerCircles(ratio, found, inner, seen[first], blur, clipped)


@cache
def _grid(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Radii (R,) of the profile, directions (2, 48), and how far a circle of each radius is shifted (R,)."""
    with torch.inference_mode(False):
        rho = torch.linspace(_INNERMOST, _OUTERMOST, _RADII, dtype=torch.float64, device=device)
        angle = sectors.middles(device)
        return rho, torch.stack([angle.cos(), angle.sin()]), (1 - rho.square()).clamp_min(0)


def _clipped(grey: Tensor, seen: Tensor, frame: Tensor) -> Tensor:
    """Profiles (P,) bool of grey (P, R, A) that at some radius are clipped in most of the directions (P, A) seen."""
    brightest = grey.nan_to_num(nan=-torch.inf).flatten(1).amax(1)
    frames = int(frame.max()) + 1 if len(frame) else 0
    of_frame = brightest.new_full((frames,), -torch.inf).scatter_reduce_(0, frame, brightest, "amax")
    limit = full_scale(of_frame)[frame]
    some = (brightest >= limit).nonzero()[:, 0]
    if some.numel() == 0:
        return torch.zeros_like(brightest, dtype=torch.bool)
    at_limit = (grey[some] >= limit[some, None, None]) & seen[some, None]
    most = at_limit.sum(-1).amax(1) > 0.5 * seen[some].sum(-1)
    return torch.zeros_like(brightest, dtype=torch.bool).index_copy_(0, some, most)


def _edge_blur(grey: Tensor, seen: Tensor, outer: Tensor, ratio: Tensor, at: Tensor) -> Tensor:
    """Blurs (M, 3) of outer edges, from the steepest rise of the mean profile of every eighth of the directions.

    A Gaussian's step has the slope step / (sqrt(2 pi) sigma). The two samples between which it is taken, and their
    rounding to whole pixels, add their own.

    Args:
        grey: (M, R, A). seen: (M, A). outer: (M, 5). ratio: (M,). at: (R - 2,), radii that have a rise.
    """
    eighth = (-1, _EIGHTHS, SECTORS // _EIGHTHS)
    weight = seen.unflatten(1, eighth[1:]).to(grey)
    mean = (grey.nan_to_num(nan=0.0).unflatten(2, eighth[1:]) * weight[:, None]).sum(-1)
    profile = (mean / weight.sum(-1)[:, None]).double()  # NaN where it is not seen
    outside = (at > 0.5 * (1 + ratio)[:, None])[..., None]
    rise = (profile[:, 2:] - profile[:, :-2]).abs()
    step = either(outside, (profile[:, -1:] - profile[:, 1:-1]).abs(), -torch.inf).amax(1)
    steepest = either(outside, rise, -torch.inf).amax(1)
    middles = [(k + 0.5) * 2 * math.pi / _EIGHTHS for k in range(_EIGHTHS)]
    around = constant((tuple(map(math.cos, middles)), tuple(map(math.sin, middles))), outer)
    normal = conics.inverse_shape(outer) @ around  # (M, 2, 8)
    length = torch.linalg.vector_norm(normal, dim=1)
    spacing = 2 * (_OUTERMOST - _INNERMOST) / (_RADII - 1) / length  # px, between the two samples, across the edge
    variance = (step / steepest * spacing).square() / (2 * torch.pi) - (spacing.square() + 1) / 12
    known = numbers(variance)
    rows = blurs.columns(*(normal / length[:, None]).unbind(1)).mT * known[:, None]
    right = torch.bmm(rows, either(known, variance, 0.0)[..., None])
    found = solve_scaled(torch.bmm(rows, rows.mT), right).squeeze(-1)
    return blurs.limited(found.nan_to_num(nan=0.0), 0.0, MOST**2)


def _mean_profile(grey: Tensor, seen: Tensor, gaps: bool) -> Tensor:
    """Means (P, R) float64 of grey (P, R, A) over directions (P, A) that are seen; with ``gaps`` some may be NaN."""
    if gaps:
        return either(seen[:, None], grey, torch.nan).nanmean(-1).double()
    return torch.bmm(grey, seen[..., None].float()).squeeze(-1).double() / seen.sum(-1, keepdim=True)


def _ratio(inner: Tensor, outer: Tensor) -> Tensor:
    """(M,), of the radii."""
    return (inner[:, 2:4].prod(-1) / outer[:, 2:4].prod(-1)).sqrt()


def _plane(candidates: Candidates, known: Tensor) -> tuple[Tensor, Tensor]:
    """As `_planes`, one for each candidate, by its inner circle (M, 5)."""
    outer = candidates.ellipse
    apart = (known[:, :2] - outer[:, :2]) / (1 - _ratio(known, outer).square())[:, None]
    return torch.arange(len(outer), device=outer.device), apart


def _planes(candidates: Candidates, camera: Camera | None) -> tuple[Tensor, Tensor]:
    """The planes to try, one or two for each candidate: candidate (P,) int64 and shift d (P, 2) px."""
    index = torch.arange(len(candidates), device=candidates.frame.device)
    none = torch.zeros_like(candidates.ellipse[:, :2])
    if camera is None:
        return index, none
    k = camera.matrix.to(candidates.ellipse)
    square = conics.to_matrix(conics.conic_from_ellipse(candidates.ellipse)) @ k
    conic = torch.bmm(k.T.expand_as(square), square)
    where = conics.circle_poses(conic, torch.ones_like(candidates.log10_nfa))[0] @ k.T
    apart = where[..., :2] / where[..., 2:] - candidates.ellipse[:, None, :2]
    far = torch.linalg.vector_norm(apart, dim=-1).amax(-1) > _PARTED * candidates.ellipse[:, 3]
    far &= finite(apart, (1, 2))
    if not bool(far.any()):
        return index, none
    own = torch.cat([index[~far], index[far].repeat_interleave(2)])
    return own, torch.cat([none[~far], apart[far].flatten(0, 1)])

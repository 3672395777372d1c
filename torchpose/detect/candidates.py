"""Candidate ellipses of a batch of frames: fits to level-line regions and chained arcs, validated a contrario."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose import ellipse
from torchpose.detect.arcs import chain_pairs, describe_arcs, fit_pairs
from torchpose.detect.finer import MIN_ASPECT, MIN_SEMI_MINOR, SIDE, cut_outs, promising_places
from torchpose.detect.partial import SETTLE, free_of_stumps
from torchpose.detect.prospects import crests, rings, sorted_out
from torchpose.detect.reduce import area_reduce, reduction_factor
from torchpose.detect.regions import (
    AGREE_COS,
    BESIDE,
    MIN_CELLS,
    ON_EDGE,
    PHASE,
    SECTORS,
    Gradient,
    Regions,
    gradient,
    level_line_regions,
    region_polarity,
    strong_cells,
)
from torchpose.detect.validation import (
    ANYTHING,
    SAME,
    WHOLE,
    Candidates,
    Verdict,
    Wanted,
    accepted,
    explain_once,
    glance,
    merge_duplicates,
    score,
    without_known,
)
from torchpose.errors import ArgumentError
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either, finite
from torchpose.geometry.grey import Frames, as_frames, levels
from torchpose.geometry.rows import replace
from torchpose.geometry.segments import marked, members, positions, segment_mean

_MIN_CRESTS = 7  # of cells that are left where edges are thinned
# of a region on its ellipse, a pixel of perimeter: an edge is two to three cells wide, of which one is enough with gaps
# (convention; without it the same 656 of 658 rings, docs/tried.md)
_MIN_CELLS = 0.35
_RING_SETTLE = 2  # fits of a ring to what agrees: its edges are measured later


Hope = Callable[[Candidates], Bool[Tensor, " B"]]


@checked
def find_candidates(
    frames: Frames,
    factor: int | None = None,
    *,
    explain: bool = False,
    wanted: Wanted = ANYTHING,
    coarse: Candidates | None = None,
    hopeful: Hope | None = None,
    float_range: float | None = None,
) -> Candidates:
    """Ellipses in grey frames, one pass for the whole batch.

    Args:
        frames: (H, W), (B, H, W) or (B, 1, H, W) grey, or (B, 3, H, W) RGB; uint8, uint16 or floating point, tensors
            or NumPy arrays. Steps below 1.5 levels, of 255 in floating-point frames, are taken for quantisation. NaN
            pixels are ignored.
        factor: integer reduction before the search; by default the smallest that gives at most 1.3 megapixels. The
            smallest semi-minor axis found is 2 reduced pixels. The same is looked for once more at twice the
            reduction, where blurred and noisy edges stand out four times as much.
        explain: also return what was looked at and rejected, see `Candidates.verdict`.
        wanted: what is asked for; of other ellipses only whole ones are found, and left out.
        coarse: what `find_coarse` found in these frames, if it is known.
        hopeful: which frames (B,) may show what is wanted, given rings (full px) that are seen there: the ``coarse``
            ones and those that single regions of the finer scale follow. In the others no arcs are put together.
        float_range: white in floating-point frames; by default 1.0 where none of their values exceeds it, else 255.0.

    Raises:
        FrameError: frames of another shape or dtype. ArgumentError: another argument is wrong.
    """
    frames = levels(as_frames(frames), float_range)
    _expect_factor(factor)
    factor = reduction_factor(*frames.shape[-2:]) if factor is None else factor
    reduced = area_reduce(frames, factor)
    grad = gradient(reduced)
    onward: Hope | None = None
    if hopeful is not None and coarse is not None:
        seen, ask = coarse, hopeful

        def onward(found: Candidates) -> Tensor:
            return ask(Candidates.cat([replace(found, ellipse=conics.rescaled(found.ellipse, factor)), seen]))

    sharp = find_ellipses(grad, wanted.reduced(factor), onward=onward)
    # rings are found without (docs/tried.md)
    found = [find_finer(frames, factor, grad, sharp, wanted)] if factor > 1 and not wanted.concentric else []
    found.append(replace(sharp, ellipse=conics.rescaled(sharp.ellipse, factor)))
    if coarse is None:
        known = accepted(sharp)
        known = replace(known, ellipse=conics.rescaled(known.ellipse, 0.5))
        blurred = find_ellipses(gradient(area_reduce(reduced, 2, exact=True)), wanted.reduced(2 * factor), known)
        coarse = replace(blurred, ellipse=conics.rescaled(blurred.ellipse, 2 * factor))
    every = Candidates.cat([*found, coarse])
    every = every[(every.verdict != Verdict.ACCEPTED) | wanted.admits(every)]
    return merge_duplicates(every if explain else accepted(every), explain=explain)


@checked
def find_coarse(
    frames: Frames,
    factor: int | None = None,
    *,
    wanted: Wanted = ANYTHING,
    float_range: float | None = None,
) -> Candidates:
    """What `find_candidates` finds at the coarser of its scales, at a fraction of its cost, and without its exclusion.

    Large rings are seen whole there, and texture, letters and noise are not seen at all.

    Args:
        frames: as for `find_candidates`.
        factor: likewise, of the finer scale.
        wanted: likewise.
        float_range: likewise.
    """
    frames = levels(as_frames(frames), float_range)
    _expect_factor(factor)
    factor = reduction_factor(*frames.shape[-2:]) if factor is None else factor
    reduced = area_reduce(area_reduce(frames, factor), 2, exact=True)
    found = accepted(find_ellipses(gradient(reduced), wanted.reduced(2 * factor)))
    found = replace(found, ellipse=conics.rescaled(found.ellipse, 2 * factor))
    return found[wanted.admits(found)]


def _expect_factor(factor: int | None) -> None:
    if factor is not None and factor < 1:
        raise ArgumentError(f"factor: is {factor}; give an integer from 1")


def find_finer(
    frames: Tensor, factor: int, sharp: Gradient, found: Candidates, wanted: Wanted = ANYTHING
) -> Candidates:
    """Small ellipses of a finer scale, full px, where a coarser one has something round that is no whole ellipse.

    ``factor``, the gradient and what was looked at are of the coarser scale.
    """
    fine = factor // 2
    whole = (found.verdict == Verdict.ACCEPTED) & (found.cover > WHOLE)
    place = promising_places(found.frame, found.ellipse, whole)
    height, width = frames.shape[-2:]
    if place.numel() == 0 or min(height, width) < SIDE * fine:
        return found[place[:0]]
    frame, middle = found.frame[place], conics.rescaled(found.ellipse[place], factor)[:, :2]
    cut, corner = cut_outs(frames, frame, middle, fine)
    grad = gradient(cut)
    # where edges fill most of a cut-out, the noise of the whole frame tells more than the median of their gradients
    grad = replace(grad, threshold=torch.minimum(grad.threshold, factor / fine * sharp.threshold[frame]))
    finer = accepted(find_ellipses(grad, wanted.reduced(fine)))
    ellipses = conics.rescaled(finer.ellipse, fine)
    ellipses = torch.cat([ellipses[:, :2] + corner[finer.frame], ellipses[:, 2:]], -1)
    # the ellipses that might have been tried are those of the frame, not those of the cut-out
    more = 2.5 * math.log10(height * width / (SIDE * fine) ** 2)
    finer = replace(finer, ellipse=ellipses, frame=frame[finer.frame], log10_nfa=finer.log10_nfa + more)
    return finer[finer.log10_nfa < 0]


def find_ellipses(
    grad: Gradient, wanted: Wanted = ANYTHING, known: Candidates | None = None, *, onward: Hope | None = None
) -> Candidates:
    """Ellipses of one scale, in its own pixels, with what became of them.

    What is not ``wanted`` is among them where it is seen whole, and explains its edges.
    ``known`` are accepted ellipses of a finer scale in the pixels of this one, which may explain edges better.
    ``onward`` tells of rings that single regions follow which frames arcs are put together in.
    """
    cell, least = strong_cells(grad), MIN_CELLS
    if not cell.numel():  # frames without any cost nothing here
        return Candidates.unscored(cell, cell.new_zeros(0, 5, dtype=torch.float64), cell.double())
    if wanted.concentric:
        cell, least = crests(grad, cell), _MIN_CRESTS
    regions = level_line_regions(grad, cell, least)
    aside = regions.cell[:0]
    if wanted.concentric:
        fit, arcs = sorted_out(regions, grad.centers(regions.cell), wanted.polarity)
        regions, aside = regions.of(fit), regions.cells_of(arcs)
    whole, explained = fit_regions(grad, regions, wanted)
    rest, hope = torch.cat([regions.cell[~explained], aside]), None
    if onward is not None:
        single = accepted(whole)
        hope = onward(single[rings(grad, single)])
        rest = rest[hope[grad.frame(rest)]]
    rest = rest.sort().values
    pieces = fit_arcs(grad, level_line_regions(grad, rest, least, SECTORS, PHASE), wanted)
    found = merge_duplicates(Candidates.cat([whole, pieces]), explain=True)
    if known is not None:
        found = without_known(found, known)
    part = found.verdict == Verdict.ACCEPTED
    if wanted.concentric:  # what stands beside a ring that is seen whole is left out when its edges are measured
        part = part & (found.cover <= WHOLE)
    if hope is not None:
        part = part & hope[found.frame]
    valid = positions(asked_for(grad, found, wanted, part))
    some = found[valid]
    settle = _RING_SETTLE if wanted.concentric else SETTLE
    freed = free_of_stumps(grad, some.frame, some.ellipse, some.polarity, settle)
    moved = positions((freed != some.ellipse).any(-1) & (plausible(grad, freed) == Verdict.ACCEPTED))
    if moved.numel():
        again = score(grad, some.frame[moved], freed[moved], some.polarity[moved])
        found = merge_duplicates(found.replaced(valid[moved], again), explain=True)
    return explain_once(grad, found, known)


def fit_regions(grad: Gradient, regions: Regions, wanted: Wanted = ANYTHING) -> tuple[Candidates, Tensor]:
    """Ellipses that single regions follow, and which of the cells (P,) bool of the regions they explain."""
    xy = grad.centers(regions.cell)
    count = regions.frame.numel()
    if count == 0:  # frames without any cost nothing here
        return Candidates.unscored(regions.frame, xy.new_zeros(0, 5), xy.new_zeros(0)), regions.cell > 0
    gx, gy = regions.gradient.unbind(-1)
    magnitude = (gx * gx + gy * gy).sqrt().double()
    # weights that fall to 0 smoothly leave the ellipse where it is when the threshold, and with it the rim of the
    # region, changes a little
    params = ellipse.fit_near(xy, regions.region, count, magnitude, BESIDE)
    polarity = region_polarity(regions, params[:, :2], xy).sign()
    follows, along = _on_ellipses(regions, xy, params, polarity, magnitude)
    length, edge = (torch.bincount(regions.region[positions(on)], minlength=count) for on in (follows, along))
    verdict = plausible(grad, params)
    elsewhere = length < _MIN_CELLS * conics.perimeter(params)
    verdict = either((verdict == Verdict.ACCEPTED) & elsewhere, int(Verdict.OFF_ELLIPSE), verdict)
    good = positions(verdict == Verdict.ACCEPTED)
    found = score(grad, regions.frame[good], params[good], polarity[good])
    # a region that is not a whole ellipse runs along something else as well: only what lies along the ellipse counts
    beyond = edge < WHOLE * torch.bincount(regions.region, minlength=count)
    partial = (found.cover <= WHOLE) | beyond[good]
    partial = partial & (found.verdict == Verdict.ACCEPTED)
    lost = partial & ~asked_for(grad, found, wanted, partial)
    found = replace(found, verdict=either(lost, int(Verdict.UNWANTED), found.verdict))
    whole = marked(good[(found.verdict == Verdict.ACCEPTED) & (found.cover > WHOLE)], count)
    explained = along & whole.index_select(0, regions.region)
    bad = positions((verdict != Verdict.ACCEPTED) & finite(params, 1))
    rejected = Candidates.unscored(regions.frame[bad], params[bad], polarity[bad], verdict[bad])
    return Candidates.cat([found, rejected]), explained


def _on_ellipses(
    regions: Regions, xy: Tensor, params: Tensor, polarity: Tensor, magnitude: Tensor
) -> tuple[Tensor, Tensor]:
    """Which cells (P,) lie on the ellipse of their region, and which belong to its edge, a blurred one included."""
    each = torch.cat([conics.conic_from_ellipse(params), polarity[:, None]], 1)
    *conic, outwards = each.index_select(0, regions.region).unbind(1)
    off, nx, ny = conics.signed_distance(conic, *xy.unbind(-1))
    gx, gy = regions.gradient.unbind(-1)
    rise = (nx * gx + ny * gy) * outwards
    off = off.abs()
    follows = off < ON_EDGE
    return follows, follows | ((off < BESIDE) & (rise > AGREE_COS * magnitude))


def fit_arcs(grad: Gradient, arcs: Regions, wanted: Wanted = ANYTHING) -> Candidates:
    """Ellipses of pairs of arcs."""
    xy = grad.centers(arcs.cell)
    about = describe_arcs(arcs, xy)
    pair = chain_pairs(about, wanted.polarity)
    if len(pair) == 0:
        return Candidates.unscored(about.frame[:0], xy.new_zeros(0, 5), xy.new_zeros(0))
    params = fit_pairs(arcs, about, xy, pair)
    some = positions(plausible(grad, params) == Verdict.ACCEPTED)
    pair, params = pair[some], params[some]
    # the cells of both members, flat
    which, cell = members(about.size, pair.flatten())
    index = which // 2
    xy, gradient = xy[cell], arcs.gradient[cell]
    weight = torch.linalg.vector_norm(gradient, dim=-1)
    r = ellipse.distance(xy, index, params)
    rms = segment_mean(r.square(), index, len(pair), weight.double()).sqrt()
    good = positions(rms < ON_EDGE)
    first = pair[good, 0]
    likely = Candidates.unscored(about.frame[first], params[good], about.curvature[first].sign())
    likely = likely[asked_for(grad, likely, wanted, glance(grad, likely, 0.5))]
    found = score(grad, likely.frame, likely.ellipse, likely.polarity)
    found = found[found.cover > 0.5]
    return accepted(merge_duplicates(found, 2 * SAME))


def asked_for(grad: Gradient, found: Candidates, wanted: Wanted, among: Bool[Tensor, " M"]) -> Bool[Tensor, " M"]:
    """Which candidates among these are what is wanted, as far as their frames tell."""
    good = among & wanted.admits(found)
    if wanted.concentric:
        some = positions(good)
        good = good.index_copy(0, some, rings(grad, found[some]))
    return good


def plausible(grad: Gradient, ellipses: Float[Tensor, "M 5"]) -> Int[Tensor, " M"]:
    """Verdict on the size and shape of ellipses; `Verdict.TOO_LARGE` for NaN."""
    a, b = ellipses[:, 2], ellipses[:, 3]
    verdict = either(a <= 0.5 * max(grad.shape[1:]), int(Verdict.ACCEPTED), int(Verdict.TOO_LARGE))
    verdict = either(b < MIN_ASPECT * a, int(Verdict.TOO_FLAT), verdict)
    return either(b < MIN_SEMI_MINOR, int(Verdict.TOO_SMALL), verdict)

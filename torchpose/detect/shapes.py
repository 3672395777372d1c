"""Everything a picture holds, each edge explained once: ellipses, polygons and straight segments."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose import ellipse
from torchpose.detect.candidates import find_candidates
from torchpose.detect.lines import Segments, find_segments
from torchpose.detect.reduce import area_reduce, reduction_factor
from torchpose.detect.regions import ON_EDGE, gradient, strong_cells
from torchpose.detect.validation import Candidates, Verdict
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.grey import Frames, as_frames, levels
from torchpose.geometry.segments import marked, pairs_in_group, positions, segment_sum

_MOSTLY = 0.7  # of the samples of a line, or of the perimeter of an ellipse: between half and all (convention)
_BULGE = 0.1  # of the semi-minor axis: the sides of a hexagon leave its best circle by 8 % (derived)
_SAMPLES = 9  # of a line


@dataclass(frozen=True, eq=False)
class Shapes:
    """Ellipses and straight edges of B frames, in full-frame pixels (pixel centre at integer coordinates)."""

    ellipses: Candidates
    segments: Segments


@checked
def find_shapes(
    frames: Frames, factor: int | None = None, *, explain: bool = False, float_range: float | None = None
) -> Shapes:
    """Ellipses, segments and polygons of grey frames; where two explain the same edge, the likelier one.

    That is the one with fewer false alarms (Patraucean, Gurdjos, Grompone von Gioi 2017): a hexagon is no circle though
    an ellipse passes near its sides, and a circle is no polygon with many sides.

    Args:
        frames: as for `find_candidates`.
        factor: likewise.
        explain: likewise.
        float_range: likewise.
    """
    frames = levels(as_frames(frames), float_range)
    factor = reduction_factor(*frames.shape[-2:]) if factor is None else factor
    ellipses = find_candidates(frames, factor, explain=explain, float_range=255.0)
    grad = gradient(area_reduce(frames, factor))
    segments = find_segments(grad, strong_cells(grad))
    segments = replace(segments, ends=factor * segments.ends + 0.5 * (factor - 1))

    valid = positions(ellipses.verdict == Verdict.ACCEPTED)
    line, owner = _explained(segments, ellipses[valid], ON_EDGE * factor)
    likelihood = torch.where(segments.chain >= 0, segments.chain_log10_nfa, segments.log10_nfa)
    beaten = ellipses.log10_nfa[valid[owner]] > likelihood[line]
    # an ellipse loses to a polygon that goes all along it, not to one side of it
    polygon = segments.chain[line] >= 0
    length = torch.linalg.vector_norm(segments.ends[:, 1] - segments.ends[:, 0], dim=-1)
    along = segment_sum(length[line] * (beaten & polygon), owner, valid.numel())
    lost = marked(valid[along > _MOSTLY * conics.perimeter(ellipses.ellipse[valid])], len(ellipses))
    explained = marked(line[~lost[valid[owner]]], len(segments))
    segments = segments[~explained]
    if explain:
        verdict = torch.where(lost, int(Verdict.POLYGON), ellipses.verdict)
        return Shapes(replace(ellipses, verdict=verdict), segments)
    return Shapes(ellipses[~lost], segments)


def _explained(segments: Segments, ellipses: Candidates, tolerance: float) -> tuple[Tensor, Tensor]:
    """Pairs of a segment and an ellipse of its frame that runs along it: indices (Q,), (Q,) int64."""
    line, owner = pairs_in_group(segments.frame, ellipses.frame)
    fraction = torch.linspace(0, 1, _SAMPLES, dtype=torch.float64, device=line.device)
    ends = segments.ends[line]
    at = ends[:, :1] + fraction[:, None] * (ends[:, 1:] - ends[:, :1])
    index = owner.repeat_interleave(_SAMPLES)
    off = ellipse.distance(at.flatten(0, 1), index, ellipses.ellipse).abs()
    near = off < tolerance + _BULGE * ellipses.ellipse[index, 3]
    along = near.view(-1, _SAMPLES).double().mean(-1) > _MOSTLY
    return line[along], owner[along]

"""Ordering: places of equal circles in the square lattices that they lie on, whole batches at once.

The image of a circle tells the affine map of its surroundings but for a turn. So the step w = S^-1 (x_j - x_i) from one
mark to another, S the shape of their ellipses, has the same length between all neighbours of a board, whatever its
tilt, and steps to the four neighbours of a mark are quarter turns apart. Neighbours are linked by that, and places
spread along the links. No model of the lens and no homography has to hold across the board.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry import conics
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import near_pairs, segment_mean, segment_sum

_WIDEST = 20.0  # spacing over the radius of a mark, the most that is looked for: dots a tenth of the pitch wide
_LEAST_STEP = 1.9  # the same, the least: marks of one lattice do not touch
_ALIKE = 1.7  # areas of neighbours, ratio: perspective and the error of small ellipses
_NEAR = 1.28  # of the spacing: a neighbour; the diagonal has 1.41, and perspective changes steps by a tenth
_AFAR = (1.6, 2.5)  # the same: the next but one, where the neighbour itself was not found
_TURN = math.radians(20.0)  # of a step from the axes of its mark; the diagonal is 45 degrees off
_TOGETHER = 0.5  # of a mark's links that agree with its place


@dataclass(frozen=True, eq=False)
class Lattice(Rows):
    """K marks with places.

    Attributes:
        mark: index of the ellipse.
        frame: of it.
        at: place in the lattice of the largest patch of its frame; origin and quarter turn are arbitrary.
    """

    mark: Int[Tensor, " K"]
    frame: Int[Tensor, " K"]
    at: Int[Tensor, "K 2"]


@dataclass(frozen=True, eq=False)
class _Links(Rows):
    """E links from mark to mark.

    Attributes:
        start: the mark that it starts from.
        end: the mark that it leads to.
        direction: along which of the start's four axes.
        turn: quarter turns from the axes of the start to those of the end.
        steps: of the lattice, 1 or 2.
    """

    start: Int[Tensor, " E"]
    end: Int[Tensor, " E"]
    direction: Int[Tensor, " E"]
    turn: Int[Tensor, " E"]
    steps: Int[Tensor, " E"]


def order_marks(
    frame: Int[Tensor, " M"], ellipses: Float[Tensor, "M 5"], polarity: Float[Tensor, " M"], spacing: float | None
) -> Lattice:
    """The largest patch of a square lattice in every frame, of ellipses of one polarity.

    Args:
        spacing: of the lattice over the radius of its marks; None where it is not known.
    """
    links = _links(frame, ellipses, polarity, spacing)
    label, at, turn = _spread(links, len(ellipses))
    step, turned = _moved(links, turn)
    sound = (at[links.end] == at[links.start] + step).all(-1) & (turn[links.end] == turned)
    share = segment_mean(sound.double(), links.end, len(ellipses)).nan_to_num(nan=0.0)
    trusted = (share > _TOGETHER).nonzero()[:, 0]
    size = torch.bincount(label[trusted], minlength=len(ellipses))
    frames = int(frame.max()) + 1 if len(frame) else 0
    most = size.new_zeros(frames).scatter_reduce_(0, frame, size[label], "amax")
    largest = torch.full((frames,), len(ellipses), device=frame.device)
    largest.scatter_reduce_(0, frame, torch.where(size[label] == most[frame], label, len(ellipses)), "amin")
    chosen = trusted[label[trusted] == largest[frame[trusted]]]
    return _one_a_place(Lattice(chosen, frame[chosen], at[chosen]), segment_sum(sound.long(), links.end, len(frame)))


def _links(frame: Tensor, ellipses: Tensor, polarity: Tensor, spacing: float | None) -> _Links:
    """Links between neighbours that see each other along opposite axes."""
    i, j, step = _steps(frame, ellipses, polarity, _WIDEST if spacing is None else _AFAR[1] * spacing)
    length, angle = torch.linalg.vector_norm(step, dim=-1), torch.atan2(step[:, 1], step[:, 0])
    count = len(ellipses)
    if spacing is None:
        nearest = length.new_full((count,), torch.inf).scatter_reduce_(0, i, length, "amin")
        unit = torch.maximum(nearest[i], nearest[j])
    else:
        unit = torch.full_like(length, spacing)
    near = (length < _NEAR * unit) & (length > unit / _NEAR)
    axis = torch.stack([(4 * angle).cos(), (4 * angle).sin()], -1) * near[:, None]
    mean = segment_sum(axis, i, count)
    axis_angle = torch.atan2(mean[:, 1], mean[:, 0])[i] / 4
    quarters = (angle - axis_angle) / (math.pi / 2)
    along = (quarters - quarters.round()).abs() * (math.pi / 2) < _TURN
    direction = quarters.round().long() % 4
    far = (length > _AFAR[0] * unit) & (length < _AFAR[1] * unit) & along
    near &= along
    taken = torch.zeros(4 * count, dtype=torch.bool, device=i.device)
    taken[(4 * i + direction)[near]] = True
    usable = near | (far & ~taken[4 * i + direction])
    key, off = (4 * i + direction)[usable], length[usable]
    best = off.new_full((4 * count,), torch.inf).scatter_reduce_(0, key, off, "amin")
    index = usable.nonzero()[:, 0][off == best[key]]
    i, j, direction, steps = i[index], j[index], direction[index], 1 + far[index].long()
    # the same link from the other end
    forth, back = i * count + j, j * count + i
    order = torch.argsort(forth)
    place = torch.searchsorted(forth[order], back).clamp_max(max(len(order) - 1, 0))
    other = order[place]
    mutual = (forth[other] == back) & (steps[other] == steps) if len(order) else forth > 0
    turn = (direction + 2 - direction[other]) % 4 if len(order) else direction
    return _Links(i, j, direction, turn, steps)[mutual]


def _steps(frame: Tensor, ellipses: Tensor, polarity: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs (i, j) of alike ellipses within ``reach`` radii, and the steps between them in radii (E, 2)."""
    i, j = near_pairs(ellipses[:, :2], ellipses[:, :2], reach * ellipses[:, 2], (frame, frame))
    area = ellipses[:, 2] * ellipses[:, 3]
    ratio = area[i] / area[j]
    alike = (ratio < _ALIKE) & (ratio > 1 / _ALIKE) & (polarity[i] == polarity[j]) & (i != j)
    i, j = i[alike], j[alike]
    shape = conics.shape_matrix(ellipses)
    apart = (ellipses[j] - ellipses[i])[:, :2, None]
    step = torch.linalg.solve(0.5 * (shape[i] + shape[j]), apart)[..., 0]
    length = torch.linalg.vector_norm(step, dim=-1)
    good = (length > _LEAST_STEP) & (length < reach)
    return i[good], j[good], step[good]


def _moved(links: _Links, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Steps (E, 2) of links in the lattice, and turns (E,) of the marks that they lead to, from those (M,) of all."""
    unit = torch.tensor([[1, 0], [0, 1], [-1, 0], [0, -1]], device=turn.device)
    own = turn[links.start]
    return unit[(links.direction + own) % 4] * links.steps[:, None], (own + links.turn) % 4


def _spread(links: _Links, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Patch, place and quarter turn of every mark: the lowest number of a patch spreads along the links."""
    device = links.start.device
    label, turn = torch.arange(count, device=device), torch.zeros(count, dtype=torch.int64, device=device)
    at = torch.zeros(count, 2, dtype=torch.int64, device=device)
    number = torch.arange(len(links), device=device)
    while True:
        # of the links that bring a lower label the one of the lowest, then the first
        offer = label[links.start] * len(links) + number
        best = torch.full((count,), count * max(len(links), 1), device=device)
        best.scatter_reduce_(0, links.end, offer, "amin")
        lower = (best < label * len(links)).nonzero()[:, 0] if len(links) else label[:0]
        if lower.numel() == 0:
            return label, at, turn
        chosen = links[best[lower] % len(links)]
        step, turned = _moved(chosen, turn)
        label[lower], at[lower], turn[lower] = label[chosen.start], at[chosen.start] + step, turned


def _one_a_place(found: Lattice, support: Tensor) -> Lattice:
    """Of the marks that claim one place the one with the most links that agree."""
    low = found.at.amin(0) if len(found) else found.at.new_zeros(2)
    at = found.at - low
    width = int(at.amax()) + 1 if len(found) else 1
    key = (found.frame * width + at[:, 1]) * width + at[:, 0]
    rank = support[found.mark] * (len(support) + 1) - found.mark  # ties: the first
    most = torch.full((int(key.max()) + 1 if len(found) else 0,), -(2**62), device=key.device)
    most.scatter_reduce_(0, key, rank, "amax")
    return found[rank == most[key]]

"""What is unknown of a plate of M points while a camera sees it: places, and edge gain, sizes, tilts of its rings.

All of it is linear in few unknowns z: p = p0 + B z, with p the places x, y, z of every point, the edge gain, the
logarithms of the sizes of all rings, and how they are turned out of the plane of the file. The columns of B are either
those directions in which the places can be told at all by views of an unknown camera pose (`free_plate`), or the
deviations that a target file states (`stated_plate`), then with z of unit variance a priori.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows
from torchpose.identify import drawn_radii
from torchpose.target import Target

_TURNED = 0.02  # rad, deviation of a ring's tilt against the plane of the file: a plate of 100 mm bent by 0.5 mm
GAIN_SIGMA = 0.1  # of the width of a ring, deviation of a gain that nothing is known of: enough for any print
_NOTHING = 1e-12  # of the largest variance, below which a direction is as good as known


@dataclass(frozen=True, eq=False)
class Plate:
    """M points and what is unknown of them, k numbers.

    Attributes:
        ids: of the points.
        nominal: places that the unknowns count from, mm.
        larger: logarithms of the sizes that they count from.
        places: the part of B that moves the places.
        gain: its row of the edge gain, mm.
        sizes: its rows of the logarithms of the rings' sizes.
        turns: its rows of the turns of the rings, rotation vectors in the frame of the target.
        known: information about each unknown besides the views: 0 or 1.
    """

    ids: Int[Tensor, " M"]
    nominal: Float[Tensor, "M 3"]
    larger: Float[Tensor, " M"]
    places: Float[Tensor, "M 3 k"]
    gain: Float[Tensor, " k"]
    sizes: Float[Tensor, "M k"]
    turns: Float[Tensor, "M 3 k"]
    known: Float[Tensor, " k"]

    def __len__(self) -> int:
        """Number of unknowns."""
        return len(self.known)

    @property
    def rims(self) -> bool:
        """Whether anything of the rims is among the unknowns: tilts, and gain or sizes."""
        return bool(self.turns.any())

    def index(self, ids: Tensor) -> Tensor:
        """Which of the points each of these ids (K,) is."""
        return (ids[:, None] == self.ids).long().argmax(1)

    def at(self, z: Tensor) -> Layout:
        """Places, gain and sizes for unknowns (k,)."""
        return Layout(self.nominal + self.places @ z, self.gain @ z, self.larger + self.sizes @ z, self.turns @ z)


@dataclass(frozen=True, eq=False)
class Layout(Rows):
    """Places (M, 3) mm, edge gain () mm beyond the file's, logarithms of the sizes (M,) over it, and turns (M, 3)."""

    places: Tensor
    gain: Tensor
    sizes: Tensor
    turns: Tensor

    def of(self, point: Tensor) -> Self:
        """The same by observation, for points (K,)."""
        return type(self)(self.places[point], self.gain.expand(len(point)), self.sizes[point], self.turns[point])


def motions(places: Float[Tensor, "M 3"]) -> Float[Tensor, "D 7"]:
    """How the places move with a shift (3), a turn (3) and a change of scale (1) of their frame."""
    eye = torch.eye(3, dtype=places.dtype, device=places.device).expand(len(places), 3, 3)
    arm = places - places.mean(0)
    return torch.cat([eye, -rotations.skew(arm), arm[..., None]], -1).flatten(0, 1)


def free_plate(
    ids: Tensor, nominal: Float[Tensor, "M 3"], normals: Float[Tensor, "M 3"] | None = None, *, discs: bool = False
) -> Plate:
    """A plate of which only the frame is held, by inner constraints: it fits the nominal places best.

    Least squares of the distances to the nominal places over shift, turn and scale have their least where the
    deviations are orthogonal to `motions` of the nominal places. So their complement is all that moves: the frame stays
    where it fits best however far the places go.

    Args:
        normals: of the rings of the points; None where the points have none, or nothing is asked of them.
        discs: the points are those of discs, whose gain is no other thing than their size.
    """
    count = len(ids)
    shape = torch.linalg.qr(motions(nominal), mode="complete").Q[:, 7:]
    parts = [shape]
    if normals is not None:
        # the gain, and the size of every ring
        parts += [torch.eye(count + 1).to(shape)[:, int(discs) :], _tilts(normals)]
    known = [torch.full((part.shape[1],), float(k == 2)).to(shape) for k, part in enumerate(parts)]
    return _plate(ids, nominal, parts, torch.cat(known))


def _tilts(normals: Float[Tensor, "M 3"]) -> Float[Tensor, "T k"]:
    """Turns of rings about two axes each, of the deviation that they have a priori."""
    return torch.block_diag(*(torch.stack(plane_axes(normals), -1) * _TURNED))


def _plate(ids: Tensor, nominal: Tensor, parts: Sequence[Tensor], known: Tensor) -> Plate:
    """A plate of columns of places, and where they are asked for of gain and sizes, and of turns; none is shared."""
    places, *of_rims = _side_by_side(parts)
    count, k = len(ids), places.shape[1]
    rims, turns = of_rims or (places.new_zeros(count + 1, k), places.new_zeros(3 * count, k))
    larger = torch.zeros_like(nominal[:, 0])
    return Plate(
        ids, nominal, larger, places.unflatten(0, (-1, 3)), rims[0], rims[1:], turns.unflatten(0, (-1, 3)), known
    )


def _side_by_side(parts: Sequence[Tensor]) -> list[Tensor]:
    """Matrices (r, k) with columns of zeros for those of the others: the rows of a block diagonal matrix."""
    return list(torch.block_diag(*parts).split([len(part) for part in parts]))


def stated_plate(target: Target) -> Plate | None:
    """A plate whose places and edge gain are known as well as the target's file states; None where they are exact.

    What a file that states its print leaves out is open: the tilts of rings, and the gain where it has no deviation.
    """
    if target.covariance is None:
        return None
    covariance, stated_gain = target.covariance[:-1, :-1], target.covariance[-1, -1].sqrt()
    values, vectors = torch.linalg.eigh(covariance)
    some = values > _NOTHING * values[-1].clamp_min(torch.finfo(values.dtype).tiny)
    places = (vectors * values.clamp_min(0).sqrt())[:, some]
    outer, inner = drawn_radii(target).unbind(-1)
    gain = torch.where(stated_gain > 0, stated_gain, GAIN_SIGMA * (outer - inner).mean())
    # a disc of another gain is one of another size
    of_gain = pad(gain / outer, (1, 0)) if target.discs else pad(gain[None], (0, len(outer)))
    # a print that misplaces a ring misplaces its rims by as much
    misplaced = (covariance.diagonal().view(-1, 3).sum(-1) / 3).sqrt() / outer
    rims = torch.cat([of_gain[:, None], pad(torch.diag(misplaced), (0, 0, 1, 0))], 1)
    parts = [places, rims, _tilts(target.normals)]
    return _plate(target.ids, target.centers, parts, places.new_ones(sum(part.shape[1] for part in parts)))

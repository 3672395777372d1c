"""Targets that no picture tells apart."""

import torch

from torchpose.geometry.arguments import checked
from torchpose.identify.hypotheses import SIZE_TOLERANCE
from torchpose.target import MIN_RATIO_GAP, MIN_SPREAD, Target


@checked
def indistinguishable(one: Target, other: Target) -> bool:
    """Whether two targets look alike: as many rings of the same codes, sizes and places, whatever their scale.

    One picture does not tell a small target from a large one farther away, so places and radii count in units of the
    markers' spread; how the targets are turned and shifted in their own frames does not count.
    """
    if one.background != other.background or len(one) != len(other):
        return False
    (ratio, places, sizes, normals), (ratio_2, places_2, sizes_2, normals_2) = _shape(one), _shape(other)
    if bool(((ratio - ratio_2).abs() >= MIN_RATIO_GAP).any()):
        return False
    if bool(((sizes / sizes_2).log().abs() >= torch.tensor(SIZE_TOLERANCE).log()).any()):
        return False
    # the rotation that brings places and normals best together (Kabsch)
    u, _, v = torch.linalg.svd(places.T @ places_2 + normals.T @ normals_2)
    turn = u @ torch.diag(torch.stack([*u.new_ones(2), (u @ v).det().sign()])) @ v
    off = torch.linalg.vector_norm(places @ turn - places_2, dim=-1).max()
    lean = torch.linalg.vector_norm(normals @ turn - normals_2, dim=-1).max()
    # as near as centres may lie to a line: 1 px where they lie 100 px about their middle
    return bool(torch.maximum(off, lean) < MIN_SPREAD)


def _shape(target: Target) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ratios, places and outer radii in units of the spread, and normals, sorted by ratio."""
    ratio, order = (target.radii[:, 1] / target.radii[:, 0]).sort()
    places = target.centers[order] - target.centers.mean(0)
    spread = places.square().sum(-1).mean().sqrt()
    return ratio, places / spread, target.radii[order, 0] / spread, target.normals[order]

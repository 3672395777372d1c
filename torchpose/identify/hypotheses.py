"""Poses of a target from pairs of rings, and the rings that lie where each pose puts the markers.

Each ring's ellipse gives two poses of its plane. In such a plane another marker lies on a circle about the ring, and
only rings of its code near the image of that circle, of the size and in the place that the layout predicts, are paired
with it. Both searches look into a small part of the image (`segments.near_pairs`), and a ring keeps the best few
partners of each code: the cost grows with the number of rings, not with its square.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchpose.geometry.segments import near_pairs, rank_in_group
from torchpose.identify.assignments import Assignments
from torchpose.identify.scene import MarkerTable

# px, of the ring's semi-major axis, of the distance to the ring the pose comes from
# px, of the ring's semi-major axis, of the distance to the ring the pose comes from (convention;
# `scripts/clutter_statistics.py`)
PLACE_TOLERANCE = (2.0, 0.3, 0.05)
# ratio of a ring's semi-major axis to the predicted one: what a rough pose leaves open (convention)
SIZE_TOLERANCE = 1.25
# of a ring, plane and marker, the nearest: one is right, the others are neighbours' (convention: decisions/0058)
_PARTNERS = 4
_STEEPEST = 0.1  # of a plane's depth: how near to the camera a circle in it is taken to reach at most
_NEAREST = 1e-3  # mm: what lies behind the camera gets a box that holds nothing of the right place
# times the tolerance of a place: two poses that put a marker so near to one ring are of one copy (derived: each may be
# off by one)
SAME_PLACE = 2.0


class Hypotheses(NamedTuple):
    """H poses of targets with the assignment each comes from, and S assignments near the places they predict.

    R (H, 3, 3), t (H, 3), origin (H,); pose (S,), member (S,), and miss (S,) of its place, 1 at the tolerance and up to
    `SAME_PLACE`.
    """

    R: Tensor
    t: Tensor
    origin: Tensor
    pose: Tensor
    member: Tensor
    miss: Tensor

    def and_of(self, some: Self, index: Tensor) -> Self:
        """These and those of the assignments ``index`` alone."""
        moved = (some.R, some.t, index[some.origin], some.pose + len(self.R), index[some.member], some.miss)
        return type(self)(*(torch.cat(both) for both in zip(self, moved, strict=True)))


def hypotheses(one: Assignments, table: MarkerTable, matrix: Tensor, side: float) -> Hypotheses:
    """Poses from pairs of assignments, the first of which places the target and the second turns it.

    Args:
        one: A > 0 assignments.
        table: the targets.
        matrix: of the camera.
        side: 1 for targets seen from their printed side, -1 for the same planes seen from behind.
    """
    R, t, origin = _poses(one, table, matrix, side)
    return Hypotheses(R, t, origin, *_support((R, t, origin), one, table, matrix))


def _poses(one: Assignments, table: MarkerTable, matrix: Tensor, side: float) -> tuple[Tensor, Tensor, Tensor]:
    """Poses R (H, 3, 3), t (H, 3) of every pair that agrees with the layout, and the first assignment of each."""
    a, plane, b, height, flat = _pairs(one, table, matrix, side)
    place, normal = one.place[a, plane], side * one.axis[a, plane]
    seen = _frame(normal, one.place[b].mean(1) - place)
    # the pose puts the second marker at its distance in the plane, straight towards the second ring
    x = place + height[:, None] * normal + flat[:, None] * seen[..., 0]
    away = torch.linalg.vector_norm(one.ellipse[b, :2] - one.ellipse[a, :2], dim=-1)
    miss = _miss(x, one.radius[b], one.ellipse[b], away, matrix)
    good = (miss < 1).nonzero()[:, 0]
    slot = (a[good] * 2 + plane[good]) * table.ids.shape[1] + one.marker[b[good]]
    good = good[rank_in_group(slot, by=miss[good]) < _PARTNERS]
    # the first of equals is taken later: by the first ring, the second, the plane
    good = good[torch.argsort((a[good] * len(one) + b[good]) * 2 + plane[good], stable=True)]
    a, b, seen, place = a[good], b[good], seen[good], place[good]
    own, other = table.centers[one.target[a], one.marker[a]], table.centers[one.target[a], one.marker[b]]
    R = seen @ _frame(table.normals[one.target[a], one.marker[a]], other - own).mT
    return R, place - (R @ own[..., None]).squeeze(-1), a


def _pairs(
    one: Assignments, table: MarkerTable, matrix: Tensor, side: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Pairs whose second ring may lie on the image of its circle about the first.

    Returns first assignment (P,), which of its planes (P,), second assignment (P,), and where the second marker lies in
    the frame of the first, mm: height (P,) over its plane, and distance (P,) in the plane.
    """
    # of the layout alone: height and distance of every marker in the frame of every other one
    away = table.centers[:, None] - table.centers[:, :, None]  # (T, M, M, 3)
    heights = (away * table.normals[:, :, None]).sum(-1)
    flats = (away.square().sum(-1) - heights.square()).clamp_min(0).sqrt()
    pairs = table.valid[:, None] & ~torch.eye(away.shape[1], dtype=torch.bool, device=matrix.device)
    a, marker, plane = pairs[one.target, one.marker][..., None].expand(-1, -1, 2).nonzero().unbind(-1)
    of = one.target[a], one.marker[a], marker
    height, flat, radius = heights[of], flats[of], table.radii[of[0], marker, 0]
    normal = side * one.axis[a, plane]
    middle = one.place[a, plane] + height[:, None] * normal
    # the circle's points are at most so far from the image of its middle, and at least so far from the camera
    depth = middle[:, 2].clamp_min(_NEAREST)
    lean = (1 - normal[:, 2].square()).clamp_min(0).sqrt()
    least = torch.maximum(depth - flat * lean, _STEEPEST * depth)
    scale = matrix[0, 0] * torch.linalg.vector_norm(middle, dim=-1) / depth / least
    px, of_size, of_way = PLACE_TOLERANCE
    reach = px + scale * ((1 + of_way) * flat + of_size * SIZE_TOLERANCE * radius)
    center = (middle @ matrix.T)[:, :2] / depth[:, None]
    markers = table.ids.shape[1]
    slots = one.row[a] * markers + marker, one.row * markers + one.marker
    query, b = near_pairs(center, one.ellipse[:, :2], reach, slots)
    other = one.ring[a[query]] != one.ring[b]
    query, b = query[other], b[other]
    return a[query], plane[query], b, height[query], flat[query]


def _support(
    poses: tuple[Tensor, Tensor, Tensor], one: Assignments, table: MarkerTable, matrix: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Assignments near the places that each pose predicts: pose (S,), assignment (S,) and miss (S,), flat."""
    R, t, origin = poses
    target = one.target[origin]
    x = table.centers[target] @ R.mT + t[:, None]
    pose, marker = (table.valid[target] & (x[..., 2] > 0)).nonzero().unbind(-1)
    x, start = x[pose, marker], one.ellipse[origin[pose], :2]
    uv = (x @ matrix.T)[:, :2] / x[:, 2:]
    most = matrix[0, 0] * table.radii[target[pose], marker, 0] * torch.linalg.vector_norm(x, dim=-1) / x[:, 2].square()
    px, of_size, of_way = PLACE_TOLERANCE
    way = torch.linalg.vector_norm(uv - start, dim=-1)
    reach = SAME_PLACE * (px + of_size * SIZE_TOLERANCE * most + of_way * way) / (1 - SAME_PLACE * of_way)
    markers = table.ids.shape[1]
    slots = one.row[origin[pose]] * markers + marker, one.row * markers + one.marker
    query, member = near_pairs(uv, one.ellipse[:, :2], reach, slots)
    away = torch.linalg.vector_norm(one.ellipse[member, :2] - start[query], dim=-1)
    miss = _miss(x[query], one.radius[member], one.ellipse[member], away, matrix)
    agrees = miss < SAME_PLACE
    return pose[query[agrees]], member[agrees], miss[agrees]


def _miss(x: Tensor, radius: Tensor, seen: Tensor, away: Tensor, matrix: Tensor) -> Tensor:
    """How far rings ``seen`` (P, 5) are from markers at ``x`` (P, 3), 1 at the tolerance; infinite for another size.

    Args:
        x: camera frame, mm.
        radius: (P,) of the markers' outer circles, mm.
        seen: outer ellipses, ideal px.
        away: (P,) px, of each ring from the one that the pose comes from.
        matrix: of the camera.
    """
    uv = (x @ matrix.T)[:, :2] / x[:, 2:]
    px, of_size, of_way = PLACE_TOLERANCE
    miss = torch.linalg.vector_norm(uv - seen[:, :2], dim=-1) / (px + of_size * seen[:, 2] + of_way * away)
    # semi-major axes: that of a circle on the optical axis, and the most that the view off axis makes of it
    least = matrix[0, 0] * radius / x[:, 2]
    most = least * torch.linalg.vector_norm(x, dim=-1) / x[:, 2]
    fits = (seen[:, 2] > least / SIZE_TOLERANCE) & (seen[:, 2] < most * SIZE_TOLERANCE) & (x[:, 2] > 0)
    return torch.where(fits, miss, torch.inf)


def _frame(normal: Tensor, direction: Tensor) -> Tensor:
    """Right-handed orthonormal frames (..., 3, 3), columns: direction in the plane, normal x direction, normal."""
    x = direction - (direction * normal).sum(-1, keepdim=True) * normal
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], -1)

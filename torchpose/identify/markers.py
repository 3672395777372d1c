"""Stage: which ring is which marker. The ring-area code proposes, the geometry of the target decides.

Noise, a neighbour's reflection or a stray washer can give a ring the code of another marker. So the code only narrows
the choice: every pair of rings gives full poses of the target (each ring's ellipse tilts the plane, the other ring
turns it), and the pose under which most markers have a ring of the right place, size and code wins. All pairs of all
frames are tried in one flat batch.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import conics
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import pairs_in_group, rank_in_group
from torchpose.identify.scene import MarkerTable
from torchpose.rings import Rings

Ratio = TypeVar("Ratio", float, Tensor)

_RATIO_TOLERANCE = 0.02  # of the ratio of radii, for a large ring
_RATIO_TOLERANCE_PX = 0.35  # over the semi-minor axis of the outer ellipse: what edge offsets do to a small ring
# px, of the ring's semi-major axis, of the distance to the ring the pose comes from
_PLACE_TOLERANCE = (2.0, 0.3, 0.05)
_SIZE_TOLERANCE = 1.25
_SEEDS = 24  # assignments of one target in one frame whose pairs are tried
_EQUAL = 1e-6  # difference of scores that rounding may make


@dataclass(frozen=True, eq=False)
class Identified(Rows):
    """Rings of N rows (B frames times T targets, frame-major) by marker.

    Attributes:
        ring: index into the rings, -1 where the marker was not found.
        R: the rough pose that the rings were assigned under; NaN without one.
        t: the same, mm.
        proposal: row, marker and ring of every ring with the code of a marker, whether or not it fits.
    """

    ring: Int[Tensor, "N M"]
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    proposal: Int[Tensor, "A 3"] = shared()

    def proposed(self, unclaimed: Bool[Tensor, " K"]) -> Tensor:
        """Number (N,) of different markers whose code was read from rings that are ``unclaimed``."""
        row, marker, ring = self.proposal.unbind(-1)
        seen = torch.zeros_like(self.ring, dtype=torch.bool)
        free = unclaimed[ring]
        seen[row[free], marker[free]] = True
        return seen.sum(-1)


@dataclass(frozen=True, eq=False)
class _Assignments(Rows):
    """Rings taken for markers, A of them, sorted by row.

    mismatch: of the code, 1 at its tolerance. ellipse: of the ring's outer circle. center, normal, radius: of the
    marker and its outer circle.
    """

    row: Tensor
    marker: Tensor
    ring: Tensor
    mismatch: Tensor
    ellipse: Tensor
    center: Tensor
    normal: Tensor
    radius: Tensor


class _Poses(NamedTuple):
    """H poses of targets, R (H, 3, 3), t (H, 3), and the assignment (H,) that each comes from."""

    R: Tensor
    t: Tensor
    origin: Tensor


def ratio_tolerance(semi_minor: Ratio) -> Ratio:
    """Largest error of a ring's inner/outer ratio with which its code is read; ``semi_minor``: outer axis, px."""
    return _RATIO_TOLERANCE + _RATIO_TOLERANCE_PX / semi_minor


def identify(rings: Rings, table: MarkerTable, camera: Camera, frames: int) -> Identified:
    """Assigns rings to the markers of every target in every frame; two rings at least.

    Args:
        rings: K rings, in ideal pixels.
        table: the targets.
        camera: for its matrix.
        frames: number of frames.
    """
    rows, markers, device = frames * len(table), table.ids.shape[1], rings.frame.device
    proposed = _propose(rings, table)
    poses = _poses_of_pairs(proposed, camera.matrix)
    # each pose gathers the rings that lie where it puts their markers
    cost, of_pose, member = _support(poses, proposed, camera.matrix)
    # the code has its say, too: markers of neighbouring codes must not change places
    cost = 0.5 * (cost + proposed.mismatch[member])
    count, row = len(poses.R), proposed.row[poses.origin]
    per_marker = torch.full((count * markers,), torch.inf, dtype=torch.float64, device=device)
    per_marker.scatter_reduce_(0, of_pose * markers + proposed.marker[member], cost, "amin")
    per_marker = per_marker.view(count, markers)
    found = per_marker.isfinite()
    score = found.sum(-1) - torch.where(found, per_marker, 0.0).sum(-1) / (2 * markers)

    # the best pose of each row, and the nearest ring of each of its markers
    best_score = torch.full((rows,), -torch.inf, dtype=torch.float64, device=device)
    best_score.scatter_reduce_(0, row, score, "amax")
    # two rings alone fit a plane seen from behind as well: of equals the first, its normal away from the camera
    candidates = (score >= best_score[row] - _EQUAL).nonzero()[:, 0]
    best = torch.full((rows,), count, dtype=torch.int64, device=device)
    best.scatter_reduce_(0, row[candidates], candidates, "amin")
    row, marker, ring = proposed.row, proposed.marker, proposed.ring
    chosen = member[(best[row[member]] == of_pose) & (cost == per_marker[of_pose, marker[member]])]
    assigned = torch.full((rows, markers), -1, dtype=torch.int64, device=device)
    assigned[row[chosen], marker[chosen]] = ring[chosen]
    has = best < count
    alone = ~has[row]  # no pair, no pose: the code is all there is
    assigned[row[alone], marker[alone]] = ring[alone]
    R = torch.full((rows, 3, 3), torch.nan, dtype=torch.float64, device=device)
    t = torch.full((rows, 3), torch.nan, dtype=torch.float64, device=device)
    R[has], t[has] = poses.R[best[has]], poses.t[best[has]]
    return Identified(assigned, R, t, torch.stack([row, marker, ring], -1))


def _propose(rings: Rings, table: MarkerTable) -> _Assignments:
    """Every marker whose code a ring has."""
    outer = rings.outer.params
    expected = table.radii[..., 1] / table.radii[..., 0]
    mismatch = (rings.ratio[:, None, None] - expected).abs() / ratio_tolerance(outer[:, 3])[:, None, None]
    fits = (mismatch < 1) & table.valid & (rings.polarity[:, None, None] == table.polarity[:, None])
    ring, target, marker = fits.nonzero().unbind(-1)
    row = rings.frame[ring] * len(table) + target
    order = torch.argsort(row, stable=True)
    ring, target, marker, row = ring[order], target[order], marker[order], row[order]
    return _Assignments(
        row,
        marker,
        ring,
        mismatch[ring, target, marker],
        outer[ring],
        table.centers[target, marker],
        table.normals[target, marker],
        table.radii[target, marker, 0],
    )


def _poses_of_pairs(one: _Assignments, matrix: Tensor) -> _Poses:
    """Poses from every ordered pair of the best assignments of a row: the first places, the second turns."""
    # every ring alone has two poses of its plane
    conic = matrix.T @ conics.to_matrix(conics.conic_from_ellipse(one.ellipse)) @ matrix
    where, axis = conics.circle_poses(conic, one.radius)  # (A, 2, 3)
    index = (rank_in_group(one.row, by=one.mismatch + 4.0 / one.ellipse[:, 3]) < _SEEDS).nonzero()[:, 0]
    a, b = (index[one_of] for one_of in pairs_in_group(one.row[index], one.row[index]))
    distinct = (one.ring[a] != one.ring[b]) & (one.marker[a] != one.marker[b])
    a, b = a[distinct], b[distinct]
    # two tilts of the plane, and its normal towards or away from the camera
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=matrix.device)
    normal = (axis[a][:, :, None] * sign[:, None]).flatten(1, 2)  # (P, 4, 3)
    origin = where[a].repeat_interleave(2, dim=1)
    seen = _frame(normal, where[b].mean(1, keepdim=True) - origin)
    own = _frame(one.normal[a], one.center[b] - one.center[a])
    rotation = (seen @ own[:, None].mT).flatten(0, 1)
    a = a.repeat_interleave(4)
    return _Poses(rotation, origin.flatten(0, 1) - (rotation @ one.center[a][..., None]).squeeze(-1), a)


def _frame(normal: Tensor, direction: Tensor) -> Tensor:
    """Right-handed orthonormal frames (..., 3, 3), columns: direction in the plane, normal x direction, normal."""
    x = direction - (direction * normal).sum(-1, keepdim=True) * normal
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    normal = normal.expand_as(x)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], -1)


def _support(poses: _Poses, one: _Assignments, matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Assignments that agree with each pose: cost (S,) in [0, 1), pose (S,) and assignment (S,), flat."""
    pose, member = pairs_in_group(one.row[poses.origin], one.row)
    x = (poses.R[pose] @ one.center[member][..., None]).squeeze(-1) + poses.t[pose]
    uv = (x @ matrix.T)[:, :2] / x[:, 2:]
    seen = one.ellipse[member]
    away = torch.linalg.vector_norm(seen[:, :2] - one.ellipse[poses.origin[pose], :2], dim=-1)
    px, of_size, of_way = _PLACE_TOLERANCE
    miss = torch.linalg.vector_norm(uv - seen[:, :2], dim=-1) / (px + of_size * seen[:, 2] + of_way * away)
    # semi-major axes: that of a circle on the optical axis, and the most that the view off axis makes of it
    least = matrix[0, 0] * one.radius[member] / x[:, 2]
    most = least * torch.linalg.vector_norm(x, dim=-1) / x[:, 2]
    fits = (seen[:, 2] > least / _SIZE_TOLERANCE) & (seen[:, 2] < most * _SIZE_TOLERANCE)
    agrees = (miss < 1) & fits & (x[:, 2] > 0)
    return miss[agrees], pose[agrees], member[agrees]

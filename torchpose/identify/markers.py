"""Stage: which ring is which marker. The ring-area code proposes, the geometry of the target decides.

Noise, a neighbour's reflection or a stray washer can give a ring the code of another marker. So the code only narrows
the choice: every pair of rings gives full poses of the target (each ring's ellipse tilts the plane, the other ring
turns it), and the pose under which most markers have a ring of the right place, size and code wins. All pairs of all
frames are tried in one flat batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeVar

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, rank_in_group
from torchpose.rings import Rings
from torchpose.target import Target

Ratio = TypeVar("Ratio", float, Tensor)

_RATIO_TOLERANCE = 0.02  # of the ratio of radii, for a large ring
_RATIO_TOLERANCE_PX = 0.35  # over the semi-minor axis of the outer ellipse: what edge offsets do to a small ring
# px, of the ring's semi-major axis, of the distance to the ring the pose comes from
_PLACE_TOLERANCE = (2.0, 0.3, 0.05)
_SIZE_TOLERANCE = 1.25
_OVERLAP, _CONCENTRIC = 0.3, 0.4  # of the semi-major axis: two rings so far across each other are not both there
_SEEDS = 24  # assignments of one target in one frame whose pairs are tried
_EQUAL = 1e-6  # difference of scores that rounding may make


@dataclass(frozen=True, eq=False)
class MarkerTable:
    """T targets as padded tensors of M markers.

    Attributes:
        ids: (T, M) int64. centers, normals: (T, M, 3) float64. radii: (T, M, 2). valid: (T, M) bool.
        polarity: (T,) float64, +1 dark rings. coplanar: (T,) bool.
    """

    ids: Tensor
    centers: Tensor
    normals: Tensor
    radii: Tensor
    valid: Tensor
    polarity: Tensor
    coplanar: Tensor

    @classmethod
    def of(cls, targets: Sequence[Target]) -> Self:
        most = max(len(t) for t in targets)

        def padded(rows: list[Tensor], fill: float) -> Tensor:
            return torch.stack(
                [torch.cat([r, torch.full((most - r.shape[0], *r.shape[1:]), fill, dtype=r.dtype)]) for r in rows]
            )

        return cls(
            padded([t.ids for t in targets], -1),
            padded([t.centers for t in targets], 0.0),
            padded([t.normals for t in targets], 0.0),
            padded([t.radii for t in targets], 1.0),
            padded([torch.ones(len(t), dtype=torch.bool) for t in targets], False),
            torch.tensor([1.0 if t.background == "light" else -1.0 for t in targets], dtype=torch.float64),
            torch.tensor([t.coplanar for t in targets]),
        )

    def to(self, device: torch.device) -> MarkerTable:
        return MarkerTable(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Identified:
    """Rings of N rows (B frames times T targets, frame-major) by marker.

    Attributes:
        ring: (N, M) int64, index into the rings, -1 where the marker was not found.
        proposal: (A, 3) int64, row, marker and ring of every ring with the code of a marker, whether or not it fits.
        R, t: (N, 3, 3), (N, 3), the rough pose that the rings were assigned under; NaN without one.
    """

    ring: Tensor
    proposal: Tensor
    R: Tensor
    t: Tensor

    def proposed(self, unclaimed: Tensor) -> Tensor:
        """Number (N,) of different markers whose code was read from rings that are ``unclaimed`` (K,) bool."""
        row, marker, ring = self.proposal.unbind(-1)
        seen = torch.zeros_like(self.ring, dtype=torch.bool)
        free = unclaimed[ring]
        seen[row[free], marker[free]] = True
        return seen.sum(-1)


def ratio_tolerance(semi_minor: Ratio) -> Ratio:
    """Largest error of a ring's inner/outer ratio with which its code is read; ``semi_minor``: outer axis, px."""
    return _RATIO_TOLERANCE + _RATIO_TOLERANCE_PX / semi_minor


def identify(rings: Rings, table: MarkerTable, camera: Camera, frames: int) -> Identified:
    """Assigns rings to the markers of every target in every frame; two rings at least.

    Args:
        rings: K rings of ``frames`` frames, in ideal pixels. camera: for its matrix.
    """
    targets, markers = table.ids.shape
    rows = frames * targets
    device = rings.frame.device
    k_matrix = camera.matrix.to(device)
    outer = rings.outer.params

    # 1. the code proposes: assignments (ring, target, marker), flat, sorted by row
    expected = table.radii[..., 1] / table.radii[..., 0]
    tolerance = ratio_tolerance(outer[:, 3])
    mismatch = (rings.ratio[:, None, None] - expected).abs() / tolerance[:, None, None]
    fits = (mismatch < 1) & table.valid & (rings.polarity[:, None, None] == table.polarity[:, None])
    ring, target, marker = fits.nonzero().unbind(-1)
    row = rings.frame[ring] * targets + target
    order = torch.argsort(row, stable=True)
    ring, target, marker, row = ring[order], target[order], marker[order], row[order]
    mismatch = mismatch[ring, target, marker]

    # 2. every ring alone has two poses of its plane
    conic = k_matrix.T @ conics.to_matrix(conics.conic_from_ellipse(outer[ring])) @ k_matrix
    where, axis = conics.circle_poses(conic, table.radii[target, marker, 0])  # (A, 2, 3)
    position = table.centers[target, marker]
    normal = table.normals[target, marker]

    # 3. every ordered pair of the best assignments of a row gives poses of the target
    seed = _best_in_row(mismatch + 4.0 / outer[ring, 3], row, rows) < _SEEDS
    index = seed.nonzero()[:, 0]
    per_row = torch.bincount(row[index], minlength=rows)
    start = per_row.cumsum(0) - per_row
    first, second = ragged_arange(per_row[row[index]])
    a, b = index[first], index[start[row[index[first]]] + second]
    distinct = (ring[a] != ring[b]) & (marker[a] != marker[b])
    a, b = a[distinct], b[distinct]
    # two tilts of the plane, and its normal towards or away from the camera
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=device)
    n_cam = (axis[a][:, :, None] * sign[:, None]).flatten(1, 2)  # (H, 4, 3)
    from_cam = where[a].repeat_interleave(2, dim=1)
    to_cam = where[b].mean(1, keepdim=True)
    e_cam = _frame(n_cam, to_cam - from_cam)
    e_target = _frame(normal[a], position[b] - position[a])
    rotation = (e_cam @ e_target[:, None].mT).flatten(0, 1)
    translation = from_cam.flatten(0, 1) - (rotation @ position[a].repeat_interleave(4, 0)[..., None]).squeeze(-1)
    a = a.repeat_interleave(4)

    # 4. each pose gathers the rings that lie where it puts their markers
    cost, hypothesis, member = _support(
        rotation, translation, a, ring, row, marker, position, outer, table, target, k_matrix
    )
    # the code has its say, too: markers of neighbouring codes must not change places
    cost = 0.5 * (cost + mismatch[member])
    count = rotation.shape[0]
    per_marker = torch.full((count * markers,), torch.inf, dtype=torch.float64, device=device)
    per_marker.scatter_reduce_(0, hypothesis * markers + marker[member], cost, "amin")
    per_marker = per_marker.view(count, markers)
    found = per_marker.isfinite()
    score = found.sum(-1) - torch.where(found, per_marker, 0.0).sum(-1) / (2 * markers)

    # 5. the best pose of each row, and the nearest ring of each of its markers
    best_score = torch.full((rows,), -torch.inf, dtype=torch.float64, device=device)
    best_score.scatter_reduce_(0, row[a], score, "amax")
    # two rings alone fit a plane seen from behind as well: of equals the first, its normal away from the camera
    candidates = (score >= best_score[row[a]] - _EQUAL).nonzero()[:, 0]
    best = torch.full((rows,), count, dtype=torch.int64, device=device)
    best.scatter_reduce_(0, row[a[candidates]], candidates, "amin")
    chosen = (best[row[member]] == hypothesis) & (cost == per_marker[hypothesis, marker[member]])
    assigned = torch.full((rows, markers), -1, dtype=torch.int64, device=device)
    assigned[row[member[chosen]], marker[member[chosen]]] = ring[member[chosen]]
    has = best < count
    alone = ~has[row]  # no pair, no pose: the code is all there is
    assigned[row[alone], marker[alone]] = ring[alone]
    pose_r = torch.full((rows, 3, 3), torch.nan, dtype=torch.float64, device=device)
    pose_t = torch.full((rows, 3), torch.nan, dtype=torch.float64, device=device)
    pose_r[has], pose_t[has] = rotation[best[has]], translation[best[has]]
    return Identified(assigned, torch.stack([row, marker, ring], -1), pose_r, pose_t)


def _best_in_row(value: Tensor, row: Tensor, rows: int) -> Tensor:
    """Rank (A,) of each assignment within its row, by rising value."""
    order = torch.argsort(value, stable=True)
    rank = torch.empty_like(row)
    rank[order] = rank_in_group(row[order], rows)
    return rank


def _frame(normal: Tensor, direction: Tensor) -> Tensor:
    """Right-handed orthonormal frames (..., 3, 3), columns: direction in the plane, normal x direction, normal."""
    x = direction - (direction * normal).sum(-1, keepdim=True) * normal
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    normal = normal.expand_as(x)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], -1)


def _support(
    rotation: Tensor,
    translation: Tensor,
    origin: Tensor,
    ring: Tensor,
    row: Tensor,
    marker: Tensor,
    position: Tensor,
    outer: Tensor,
    table: MarkerTable,
    target: Tensor,
    k_matrix: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Assignments that agree with each pose: cost (S,) in [0, 1), pose (S,) and assignment (S,), flat."""
    rows = int(row.max()) + 1 if row.numel() else 0
    per_row = torch.bincount(row, minlength=rows)
    start = per_row.cumsum(0) - per_row
    hypothesis, offset = ragged_arange(per_row[row[origin]])
    member = start[row[origin[hypothesis]]] + offset
    x = (rotation[hypothesis] @ position[member][..., None]).squeeze(-1) + translation[hypothesis]
    uv = (x @ k_matrix.T)[:, :2] / x[:, 2:]
    seen = outer[ring[member]]
    away = torch.linalg.vector_norm(seen[:, :2] - outer[ring[origin[hypothesis]], :2], dim=-1)
    px, of_size, of_way = _PLACE_TOLERANCE
    miss = torch.linalg.vector_norm(uv - seen[:, :2], dim=-1) / (px + of_size * seen[:, 2] + of_way * away)
    # semi-major axes: that of a circle on the optical axis, and the most that the view off axis makes of it
    least = k_matrix[0, 0] * table.radii[target[member], marker[member], 0] / x[:, 2]
    most = least * torch.linalg.vector_norm(x, dim=-1) / x[:, 2]
    fits = (seen[:, 2] > least / _SIZE_TOLERANCE) & (seen[:, 2] < most * _SIZE_TOLERANCE)
    agrees = (miss < 1) & fits & (x[:, 2] > 0)
    return miss[agrees], hypothesis[agrees], member[agrees]


def crossed_out(
    rings: Rings, frame: Tensor, R: Tensor, t: Tensor, points: Tensor, radii: Tensor, seen: Tensor, camera: Camera
) -> Tensor:
    """Poses (N,) bool under which a marker that was not seen would lie across a ring that was, where none can be.

    Args:
        rings: K rings, ideal px. frame: (N,) int64. R, t: (N, 3, 3), (N, 3). points, radii: (N, M, 3), (N, M, 2) of
            the markers. seen: (N, M) bool, the others are asked for; padded ones must count as seen.
    """
    k = camera.matrix.to(t)
    x = (R[:, None] @ points[..., None]).squeeze(-1) + t[:, None]
    at = (x @ k.T)[..., :2] / x[..., 2:]
    size = k[0, 0] * radii[..., 0] / x[..., 2]
    # every unseen marker with every ring of its frame
    row, marker, ring = ((frame[:, None] == rings.frame)[:, None] & ~seen[..., None]).nonzero().unbind(-1)
    outer = rings.outer.params[ring]
    apart = torch.linalg.vector_norm(at[row, marker] - outer[:, :2], dim=-1)
    reach = torch.minimum(size[row, marker], outer[:, 2])
    across = (apart < outer[:, 3] + _OVERLAP * reach) & (apart > _CONCENTRIC * reach) & (x[row, marker, 2] > 0)
    out = torch.zeros_like(frame, dtype=torch.bool)
    out[row[across]] = True
    return out

"""Both poses of a few rows through a pinhole: starts of planes, and the minima reached from two starts each, on the
host.

Of one frame there are two poses of four points. A tensor operation costs more than all their arithmetic, and a device
would be waited for at every decision; so the numbers are fetched once, and NumPy does what `solve` does from two starts
that are given: the same steps (`iterative`), with the pose first (`few`), and without codes, ratios and covariances.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchpose.pnp.few import Few, factors, minimised, on_host
from torchpose.pnp.planar import COLLINEARITY, FIXED, FLATNESS
from torchpose.pnp.verdict import COINCIDENCE, DECISION

Array = NDArray[Any]


class Pairs(NamedTuple):
    """Minima of N rows: R (N, 2, 3, 3), t (N, 2, 3), rms (N, 2) px, chi2 (N, 2); NaN where there is none, or the same
    one, or where one of two has not been reached. behind: (N,) bool, both have points behind the camera."""

    R: Tensor
    t: Tensor
    rms: Tensor
    chi2: Tensor
    behind: Tensor


def planar_starts(points: Tensor, xy: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both poses of a few rows of coplanar points by IPPE, to first order about their centroids: as `planar`, without a
    last word on the translation.

    Args:
        points: (N, M, 3). xy: (N, M, 2), normalised, 0 where not seen. mask: (N, M) bool.

    Returns:
        R (N, 2, 3, 3), t (N, 2, 3), and whether there are such poses, in front of the camera (N,) bool.
    """
    R, t, known = on_host(_of_planes, points, xy, mask)
    return R, t, known


def pair_minima(
    points: Tensor,
    pixels: Tensor,
    matrix: Tensor,
    covariances: Tensor,
    mask: Tensor,
    starts: tuple[Tensor, Tensor],
    max_iterations: int,
) -> Pairs:
    """Minima from two starts for each of N rows; arguments as of `solve`, points (N, M, 3), starts (N, 2, ...)."""
    return Pairs(*on_host(_minima, points, pixels, matrix, covariances, mask, *starts, max_iterations))


def _minima(
    points: Array, pixels: Array, matrix: Array, covariances: Array, mask: Array, R: Array, t: Array, steps: int
) -> tuple[Array, ...]:
    seen = mask[..., None].astype(points.dtype)
    count = seen.sum(1)
    center = (points * seen).sum(1) / count
    local = (points - center[:, None]) * seen
    unit = np.sqrt(np.square(local).sum(-1).max(-1, keepdims=True)).clip(np.finfo(local.dtype).tiny)
    focal, principal = matrix.diagonal()[:2], matrix[:2, 2]
    xy = np.where(mask[..., None], (pixels - principal) / focal, 0.0)
    root = np.linalg.solve(factors(covariances), np.diag(focal)) * seen[..., None]
    # residuals that are wrong by the rounding of their image points
    scale = np.square(root).max((-1, -2)) * (1 + np.square(xy).sum(-1))
    floor = (4 * np.finfo(xy.dtype).eps) ** 2 * scale.sum(-1)
    few = Few.at(*(value.repeat(2, 0) for value in (local / unit[..., None], xy, root)))
    shift = (R @ center[:, None, :, None] + t[..., None]) / unit[:, :, None, None]
    ends = minimised(few, np.concatenate([R, shift], -1).reshape(-1, 3, 4), floor.repeat(2), steps, _relevant)
    pose, information = ends.pose, few.whole(ends.pose, newton=False)[:, :6, :6]
    depth, uv, white = few.seen(pose)
    pose = pose.reshape(-1, 2, 3, 4)
    chi2 = np.where(depth.min((1, 2)) > 0, np.square(white - few.aimed).sum((1, 2)), np.inf).reshape(-1, 2)
    off = (uv.reshape(-1, 2, *xy.shape[1:]) - xy[:, None]) * focal * seen[:, None]
    rms = np.sqrt(np.square(off).sum((2, 3)) / count)
    worse = (np.nan_to_num(chi2[:, 1], nan=np.inf) >= np.nan_to_num(chi2[:, 0], nan=np.inf)).astype(int)
    same = _distance(pose, information.reshape(-1, 2, 6, 6), worse) < COINCIDENCE
    chi2 = _apart(chi2, ends.done.reshape(-1, 2), worse, same)
    gone = ~np.isfinite(chi2)
    R, t = pose[..., :3], (pose[..., 3:] * unit[:, :, None, None] - pose[..., :3] @ center[:, None, :, None])[..., 0]
    R, t = np.where(gone[..., None, None], np.nan, R), np.where(gone[..., None], np.nan, t)
    behind = (chi2 == np.inf).all(1)
    return R, t, np.where(gone, np.nan, rms), np.where(gone, np.nan, chi2), behind


def _relevant(cost: Array) -> Array:
    """Costs (2 N,) above which a minimum of two matters no more, given those at the starts: as `verdict.relevant`."""
    least = np.nan_to_num(cost.reshape(-1, 2), nan=np.inf).min(1)
    return (2 * least + 2 * DECISION).repeat(2)


def _distance(pose: Array, information: Array, worse: Array) -> Array:
    """Squared Mahalanobis distances (N,) of poses (N, 2, 3, 4) by the information (N, 2, 6, 6) about the better one.

    Args:
        worse: (N,) int, which is the other.
    """
    each = np.arange(len(pose))
    R, t = pose[..., :3], pose[..., 3:]
    # the one as seen from the other: translation, and twice the tangent of half the angle, as steps are made
    turn = np.swapaxes(R[:, 0], -1, -2) @ R[:, 1]
    axis = (turn - np.swapaxes(turn, -1, -2))[:, (2, 0, 1), (1, 2, 0)]
    axis = 2 * axis / (1 + np.trace(turn, axis1=1, axis2=2)[:, None]).clip(1e-12)
    shift = np.swapaxes(R[each, 1 - worse], -1, -2) @ (t[:, 1] - t[:, 0])
    step = np.concatenate([shift[..., 0], axis], 1)
    return np.einsum("ni,nij,nj->n", step, information[each, 1 - worse], step)


def _apart(chi2: Array, done: Array, worse: Array, same: Array) -> Array:
    """Chi-squared (N, 2) of minima that are two, NaN for what is none.

    Args:
        done: (N, 2) bool, were they reached?
        worse: (N,) int, which has the larger one. same: (N,) bool, are both one?
    """
    second, some = np.arange(2) == worse[:, None], chi2 < np.inf
    alone = same[:, None] | ~some.all(1, keepdims=True)
    lost = (~done & ~(second & alone)).any(1, keepdims=True) & some.any(1, keepdims=True)
    return np.where(lost | (second & alone & some), np.nan, chi2)


def _of_planes(points: Array, xy: Array, mask: Array) -> tuple[Array, ...]:
    """`planar_starts`: the homography by Harker and O'Leary, about the centroid, its first order by IPPE."""
    seen = mask[..., None].astype(points.dtype)
    count = seen.sum(1)
    center = (points * seen).sum(1) / count
    offset = (points - center[:, None]) * seen
    square, vectors = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)
    first, second = vectors[..., 2], vectors[..., 1]
    axes = np.stack([first, second, np.cross(first, second)], 1)
    sound = (square[:, 1] > COLLINEARITY**2 * square[:, 2]) & (square[:, 0] <= FLATNESS**2 * square[:, 2])
    # along its principal axes the coordinates of a plane, and 1, are orthogonal
    plane = np.concatenate([offset @ np.swapaxes(axes[:, :2], 1, 2), seen], -1)
    length = np.sqrt(np.stack([square[:, 2], square[:, 1], count[:, 0]], 1))
    basis = plane / length[:, None]
    products = (xy[..., None] * plane[:, :, None]).reshape(*mask.shape, 6)
    coefficients = np.swapaxes(basis, 1, 2) @ products
    # with h3 given, the first two rows of the homography follow by linear least squares from u (h3 . m)
    residual = (products - basis @ coefficients).reshape(len(points), -1, 3)
    gram = np.swapaxes(residual, 1, 2) @ residual
    scatter = np.square(coefficients[:, :2, 2::3]).sum((1, 2)) * square[:, 2] / np.square(count[:, 0])
    firm = _det2(gram) > FIXED * scatter * (gram[:, 0, 0] + gram[:, 1, 1])
    p = -_solved2(gram, gram[:, :2, 2:])[..., 0]
    h = coefficients.reshape(-1, 6, 3) @ np.concatenate([p, np.ones_like(count)], 1)[..., None]
    h = h.reshape(-1, 3, 2) / length[..., None]
    q = h[:, 2]  # image of the centroid
    jacobian = np.swapaxes(h[:, :2], 1, 2) - q[..., None] * p[:, None]
    # a rotation of the axis towards the centroid, by half a turn about the middle between them
    sight = np.concatenate([q, np.ones_like(count)], 1)
    middle = sight / np.linalg.norm(sight, axis=1, keepdims=True) + np.array([0.0, 0.0, 1.0])
    ray = middle[..., None] * middle[:, None] / middle[:, 2:, None] - np.eye(3)
    both = _solved2(ray[:, :2, :2] - q[..., None] * ray[:, 2:, :2], jacobian)
    # the largest singular value is the inverse depth
    half, area = 0.5 * np.square(both).sum((1, 2)), _det2(both)
    inverse = np.sqrt(half + np.sqrt((np.square(half) - np.square(area)).clip(0)))[:, None]
    both = both / inverse[..., None]
    third = np.sqrt((1 - np.square(both).sum(1)).clip(0))
    third[:, 1] *= np.where(both.prod(2).sum(1) > 0, -1.0, 1.0)
    columns = np.concatenate([both[:, None].repeat(2, 1), np.stack([third, -third], 1)[:, :, None]], 2)
    normal = np.cross(columns[..., 0], columns[..., 1])[..., None]
    R = ray[:, None] @ np.concatenate([columns, normal], -1) @ axes[:, None]
    t = (sight / inverse)[:, None]
    depth = (offset @ np.swapaxes(R[:, :, 2], 1, 2)) + t[..., 2:]
    sound &= firm & np.isfinite(R).all((1, 2, 3)) & (depth > 0).all((1, 2))
    return R, t - (R @ center[:, None, :, None])[..., 0], sound


def _det2(matrix: Array) -> Array:
    """Determinants (N,) of the upper left 2 x 2 blocks."""
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]


def _solved2(matrix: Array, right: Array) -> Array:
    """Solutions (N, 2, m) with the upper left 2 x 2 blocks, by Cramer's rule; not finite where these are singular."""
    adjugate = matrix[:, 1::-1, 1::-1].swapaxes(1, 2) * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return adjugate @ right / _det2(matrix)[:, None, None]

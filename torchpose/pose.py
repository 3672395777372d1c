"""Stage: from identified markers to one pose a row, its covariance, and an honest status.

Every row is solved from two starts (both planar solutions; with three markers the rough pose of the identification and
its mirror image), each refined by batched Levenberg-Marquardt. The solution that explains all evidence best wins: the
centres by their covariances, and the shapes of the rings' own ellipses, which decide alone where only three markers are
seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.camera import Camera
from torchpose.geometry import conics, rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.results import Reason, Status
from torchpose.rings import Rings

AMBIGUOUS_CHI2 = 20.0  # contract: two poses are ambiguous where their chi-squared differs by less
MIN_MARKERS = 3  # seen, that a pose needs
_MOST_INFLATION = 1e10  # of a parameter's variance by the others' freedom, beyond which it counts as open
_SHAPE_FLOOR = (0.03, 0.5)  # px, and times the curvature a / b^2: what blur and mask do to an ellipse's shape
_SHAPE_LIMIT = 16.0  # mean chi-squared a shape component above which the rings contradict the pose
_CENTER_LIMIT = (30.0, 10.0)  # chi-squared, and per degree of freedom, above which the centres contradict each other
_ITERATIONS = (16, 60)  # of the solver: for most rows, and for those that need more
_RIM_POINTS = 24  # of a circle: sums over it are exact up to the perspective's high orders
_CENTER_RMS = 0.3  # px, below which they do not: small errors of calibration or print are no mix-up


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was measured of the M markers of N rows; padded, see ``mask``.

    Attributes:
        points, normals: (N, M, 3) float64 in the target frame. radii: (N, M, 2).
        center, covariance: (N, M, 2) ideal px and (N, M, 2, 2): compensated centres.
        shape: (N, M, 2, 5) fitted ellipses, outer and inner, ideal px. shape_covariance: (N, M, 2, 5, 5), see
            `ellipse.EllipseFit`.
        mask: (N, M) bool, marker seen. coplanar: (N,) bool.
        matrix: (3, 3) camera matrix.
    """

    points: Tensor
    normals: Tensor
    radii: Tensor
    center: Tensor
    covariance: Tensor
    shape: Tensor
    shape_covariance: Tensor
    mask: Tensor
    coplanar: Tensor
    matrix: Tensor

    def __getitem__(self, index: Tensor) -> Evidence:
        rows = {n: getattr(self, n)[index] for n in self.__dataclass_fields__ if n != "matrix"}
        return Evidence(**rows, matrix=self.matrix)

    def without(self, marker: Tensor) -> Evidence:
        """The same rows with one marker each, (N,) int64, taken as not seen."""
        mask = self.mask.clone()
        mask[torch.arange(mask.shape[0], device=mask.device), marker] = False
        return replace(self, mask=mask)


@dataclass(frozen=True, eq=False)
class Solutions:
    """Chosen pose of N rows; the fields as in `results.Poses`."""

    R: Tensor
    t: Tensor
    covariance: Tensor
    rms: Tensor
    chi2: Tensor
    R_alt: Tensor
    t_alt: Tensor
    rms_alt: Tensor
    chi2_alt: Tensor
    status: Tensor
    reason: Tensor
    mask: Tensor

    def __getitem__(self, index: Tensor) -> Solutions:
        return Solutions(*(getattr(self, n)[index] for n in self.__dataclass_fields__))

    def replaced(self, index: Tensor, other: Solutions) -> Solutions:
        """These rows, with the rows ``index`` taken from ``other``."""
        return Solutions(*(getattr(self, n).index_copy(0, index, getattr(other, n)) for n in self.__dataclass_fields__))


def gather_evidence(
    rings: Rings,
    ring: Tensor,
    centers: Tensor,
    covariances: Tensor,
    points: Tensor,
    normals: Tensor,
    radii: Tensor,
    coplanar: Tensor,
    matrix: Tensor,
) -> Evidence:
    """Lays the measurements of flat rings out by row and marker.

    Args:
        rings: K rings. ring: (N, M) int64, -1 where not seen. centers, covariances: (N, M, 2), (N, M, 2, 2).
        points, normals, radii, coplanar: of the target of each row, (N, M, ...) and (N,). matrix: (3, 3).
    """
    mask = ring >= 0
    at = ring.clamp_min(0)
    shape = torch.stack([rings.outer.params, rings.inner.params], 1)
    covariance = torch.stack([rings.outer.covariance, rings.inner.covariance], 1)
    if len(rings) == 0:  # nothing to index: any row will do, the mask hides it
        shape, covariance = shape.new_ones(1, 2, 5), covariance.new_ones(1, 2, 5, 5)
    return Evidence(points, normals, radii, centers, covariances, shape[at], covariance[at], mask, coplanar, matrix)


def solve_poses(evidence: Evidence, rough: tuple[Tensor, Tensor]) -> Solutions:
    """Pose, alternative, covariance and status of N rows with three markers or more.

    A row whose centres contradict each other is solved again without each of its markers in turn; if one of these fits,
    that marker is left out.

    Args:
        evidence: N rows. rough: R (N, 3, 3), t (N, 3) to start from.
    """
    solved = _solve(evidence, rough, _ITERATIONS[0])
    slow = (solved.reason == Reason.NOT_CONVERGED).nonzero()[:, 0]
    if slow.numel():
        solved = solved.replaced(slow, _solve(evidence[slow], (rough[0][slow], rough[1][slow]), _ITERATIONS[1]))
    bad = (solved.status == Status.REJECTED) & (evidence.mask.sum(-1) >= 4)
    row, marker = (bad[:, None] & evidence.mask).nonzero().unbind(-1)
    if row.numel() == 0:
        return solved
    retry = _solve(evidence[row].without(marker), (rough[0][row], rough[1][row]), _ITERATIONS[1])
    # of the subsets that fit, the one with the least chi-squared
    cost = torch.where(retry.status == Status.REJECTED, torch.inf, retry.chi2.nan_to_num(nan=torch.inf))
    least = torch.full(bad.shape, torch.inf, dtype=cost.dtype, device=cost.device).scatter_reduce(0, row, cost, "amin")
    winner = (cost.isfinite() & (cost == least[row])).nonzero()[:, 0]
    return solved.replaced(row[winner], retry[winner])


def _solve(e: Evidence, rough: tuple[Tensor, Tensor], iterations: int) -> Solutions:
    seen = e.mask.sum(-1)
    center = torch.where(e.mask[..., None], e.center, 0.0)
    result = pnp.solve(
        e.points,
        center,
        e.matrix,
        covariances=_visible(e.covariance, e.mask),
        mask=e.mask,
        initial=_starts(e, rough),
        max_iterations=iterations,
    )
    # both minima of the centres, weighed again with the rings' shapes
    both_r, both_t = torch.stack([result.R, result.R_alt], 1), torch.stack([result.t, result.t_alt], 1)
    center_chi2 = torch.stack([result.chi2, result.chi2_alt], 1)
    of_shapes = shape_chi2(e, both_r, both_t)
    total = (center_chi2 + of_shapes).nan_to_num(nan=torch.inf)  # NaN: no such minimum
    chi2, best = total.min(1)
    row = torch.arange(best.numel(), device=best.device)
    r, t, rms = both_r[row, best], both_t[row, best], torch.stack([result.rms, result.rms_alt], 1)
    covariance, determined = _covariance(e, r, t)
    chi2_alt = total[row, 1 - best]
    chi2_alt = torch.where(chi2_alt.isfinite(), chi2_alt, torch.nan)

    chi2_center, rms_best = center_chi2[row, best], rms[row, best]
    contradicts = (chi2_center > _CENTER_LIMIT[0] + _CENTER_LIMIT[1] * (2 * seen - 6)) & (rms_best > _CENTER_RMS)
    reason = torch.full_like(seen, Reason.NONE)
    for condition, why in (
        (chi2_alt - chi2 < AMBIGUOUS_CHI2, Reason.TWO_SOLUTIONS),
        (of_shapes[row, best] > 4 * _SHAPE_LIMIT * seen, Reason.RING_SHAPE),
        (contradicts, Reason.RESIDUAL),
        (~chi2.isfinite(), Reason.NOT_CONVERGED),
        (result.code == pnp.PnPCode.BEHIND_CAMERA, Reason.BEHIND_CAMERA),
        ((result.code == pnp.PnPCode.DEGENERATE) | (chi2.isfinite() & ~determined), Reason.DEGENERATE),
    ):
        reason = torch.where(condition, int(why), reason)  # the last that holds
    status = torch.where(reason == Reason.NONE, int(Status.OK), int(Status.REJECTED))
    status = torch.where(reason == Reason.TWO_SOLUTIONS, int(Status.AMBIGUOUS), status)
    return Solutions(
        r,
        t,
        covariance,
        rms_best,
        chi2,
        both_r[row, 1 - best],
        both_t[row, 1 - best],
        rms[row, 1 - best],
        chi2_alt,
        status,
        reason,
        e.mask,
    )


def _starts(e: Evidence, rough: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Two poses (N, 2, 3, 3), (N, 2, 3) to start from: both planar solutions, or the rough pose and its mirror."""
    r, t = rough
    # depth mirrored along the line of sight, the plane turned back on itself: the same weak-perspective image
    weight = e.mask.double() / e.mask.sum(-1, keepdim=True)
    middle = (e.points * weight[..., None]).sum(1)
    at = (r @ middle[..., None]).squeeze(-1) + t
    first = e.mask.int().argmax(-1)
    normal = e.normals[torch.arange(first.numel(), device=first.device), first]
    mirrored = _reflection(at) @ r @ _reflection(normal)
    mirrored_t = at - (mirrored @ middle[..., None]).squeeze(-1)
    focal, principal = e.matrix.diagonal()[:2], e.matrix[:2, 2]
    xy = torch.where(e.mask[..., None], (e.center - principal) / focal, 0.0)
    flat = pnp.planar(e.points, xy, mask=e.mask)
    both = flat.R.isfinite().all(-1).all(-1).all(-1)  # else a marker behind the camera, or no plane
    planar = (e.coplanar & (e.mask.sum(-1) >= 4) & both)[:, None]
    start_r = torch.where(planar[..., None, None], flat.R, torch.stack([r, mirrored], 1))
    start_t = torch.where(planar[..., None], flat.t, torch.stack([t, mirrored_t], 1))
    return start_r, start_t


def _reflection(direction: Tensor) -> Tensor:
    """Householder matrices (N, 3, 3) that turn ``direction`` (N, 3) round."""
    unit = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
    return eye - 2 * unit[..., :, None] * unit[..., None, :]


def _visible(covariance: Tensor, mask: Tensor) -> Tensor:
    """Covariances with the identity where nothing was seen."""
    eye = torch.eye(2, dtype=covariance.dtype, device=covariance.device)
    return torch.where(mask[..., None, None], covariance, eye)


def shape_chi2(e: Evidence, r: Tensor, t: Tensor) -> Tensor:
    """Chi-squared (N, S) of the rings' shapes: elongation and its direction, which blur and threshold hardly touch."""
    x = (r[:, :, None] @ e.points[:, None, ..., None]).squeeze(-1) + t[:, :, None]  # (N, S, M, 3)
    predicted = conics.circle_ellipse(
        e.matrix, r[:, :, None, None], x[..., None, :], e.normals[:, None, :, None], e.radii[:, None]
    )  # (N, S, M, 2, 5)
    difference = conics.shape_matrix(e.shape)[:, None] - conics.shape_matrix(predicted)
    theta = e.shape[..., 4]
    cos, sin = theta.cos(), theta.sin()
    axes = torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))[:, None]
    d = axes.mT @ difference @ axes
    v = torch.stack([d[..., 0, 0] - d[..., 1, 1], 2 * d[..., 0, 1]], -1)
    pick = torch.tensor([[0, 0, 1, 0, -1], [0, 0, 0, 2, 0]], dtype=v.dtype, device=v.device)
    floor = _SHAPE_FLOOR[0] + _SHAPE_FLOOR[1] * e.shape[..., 2] / e.shape[..., 3].square()
    eye = torch.eye(2, dtype=v.dtype, device=v.device)
    covariance = pick @ e.shape_covariance @ pick.T + floor.square()[..., None, None] * eye
    seen = e.mask[..., None, None, None]
    weight = torch.linalg.inv(torch.where(seen, covariance, eye))[:, None]
    chi2 = (v[..., None, :] @ weight @ v[..., None]).squeeze(-1).squeeze(-1)
    return torch.where(e.mask[:, None, :, None], chi2, 0.0).sum((-1, -2))


def _jacobian(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projected centres' derivatives by the pose (N, M, 2, 6), normalised points (N, M, 2), weights (N, M, 2, 2).

    Translation first, then the rotation from the left, R = exp(w) R_est.
    """
    turned = (r[:, None] @ e.points[..., None]).squeeze(-1)
    by_point, n = _derivative(turned + t[:, None], e.matrix)
    weight = torch.linalg.inv(_visible(e.covariance, e.mask)) * e.mask[..., None, None]
    return torch.cat([by_point, -by_point @ rotations.skew(turned)], -1), n, weight


def _rim_jacobian(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same of points all along both rims of every marker, weighted by their length across the edge alone."""
    angle = torch.arange(_RIM_POINTS, dtype=t.dtype, device=t.device) * (2 * torch.pi / _RIM_POINTS)
    one, two = (x[..., None, None, :] for x in plane_axes(e.normals))
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    radii = e.radii[..., None, None]
    points = (e.points[:, :, None, None] + radii * (cos * one + sin * two)).flatten(1, 3)
    along = (radii * (cos * two - sin * one)).flatten(1, 3)
    turned = points @ r.mT
    by_point, n = _derivative(turned + t[:, None], e.matrix)
    tangent = (by_point @ (along @ r.mT)[..., None]).squeeze(-1)  # px per rad
    length = torch.linalg.vector_norm(tangent, dim=-1)
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / length[..., None]
    seen = e.mask.repeat_interleave(2 * _RIM_POINTS, 1)
    weight = normal[..., :, None] * normal[..., None, :] * (length * seen)[..., None, None]
    return torch.cat([by_point, -by_point @ rotations.skew(turned)], -1), n, weight


def _derivative(x: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels' derivatives (..., 2, 3) by points (..., 3) of the camera frame, and their normalised images (..., 2)."""
    n = x[..., :2] / x[..., 2:]
    zero, one = torch.zeros_like(n[..., 0]), torch.ones_like(n[..., 0])
    by_point = torch.stack([one, zero, -n[..., 0], zero, one, -n[..., 1]], -1).unflatten(-1, (2, 3))
    return by_point * (matrix.diagonal()[:2, None] / x[..., 2, None, None]), n


def _by_intrinsics(camera: Camera, n: Tensor) -> Tensor:
    """How residuals in ideal pixels change with fx, fy, cx, cy (..., 2, 4), at normalised points n (..., 2).

    Measured are the pixels of the frame: a changed matrix moves the ideal pixels made of them too.
    """
    focal = camera.matrix.diagonal()[:2]
    d = (camera.distort(n) - camera.matrix[:2, 2]) / focal
    by_raw = focal[:, None] * torch.linalg.inv(camera.J_distort(n))
    return torch.cat([by_raw * d[..., None, :], by_raw], -1)


def center_rms(e: Evidence, r: Tensor, t: Tensor) -> Tensor:
    """RMS distance (N,) in px of the compensated centres from the projected ones."""
    x = (r[:, None] @ e.points[..., None]).squeeze(-1) + t[:, None]
    d = (x @ e.matrix.T)[..., :2] / x[..., 2:] - e.center
    square = torch.where(e.mask, d.square().sum(-1), 0.0)
    return (square.sum(-1) / e.mask.sum(-1)).sqrt()


def _covariance(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pose covariance (J^T W J)^-1 (N, 6, 6), and whether the centres determine all six parameters (N,)."""
    jac, _, weight = _jacobian(e, r, t)
    return _inverse((jac.mT @ weight @ jac).sum(1))


def _inverse(information: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of (N, 6, 6), and whether it determines all six parameters (N,)."""
    # in units of each parameter's own information, so that mm and rad can be compared
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    inverse, info = torch.linalg.inv_ex(information * scale[:, :, None] * scale[:, None, :])
    covariance = inverse * scale[:, :, None] * scale[:, None, :]
    determined = (info == 0) & (inverse.diagonal(dim1=-2, dim2=-1) < _MOST_INFLATION).all(-1)
    return covariance, determined


def intrinsics_covariance(e: Evidence, s: Solutions, camera: Camera, *, refined: bool) -> Tensor:
    """What uncertain intrinsics add to the pose covariance (N, 6, 6): G Sigma_K G^T, G = d pose / d (fx, fy, cx, cy).

    At the least-squares optimum G = -(J^T W J)^-1 J^T W J_K with the Jacobians J and J_K of what the pose is fitted to.

    Args:
        camera: with a ``covariance``.
        refined: the pose is fitted to the edges of the rings, which tell their size and shape too, not to the centres.
    """
    if camera.covariance is None:
        raise ValueError("the camera has no covariance")
    jac, n, weight = (_rim_jacobian if refined else _jacobian)(replace(e, mask=s.mask), s.R, s.t)
    weighted = jac.mT @ weight
    gain = -_inverse((weighted @ jac).sum(1))[0] @ (weighted @ _by_intrinsics(camera, n)).sum(1)
    return gain @ camera.covariance.to(gain) @ gain.mT

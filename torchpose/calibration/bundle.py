"""Joint least squares of a camera's intrinsics and the poses of all views (bundle adjustment of a known target)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum

_ITERATIONS = 200
_RELATIVE = 1e-10  # decrease that a step must promise, of the cost


@dataclass(frozen=True, eq=False)
class Bundle:
    """Least-squares estimate of n intrinsics (fx, fy, cx, cy, then the distortion) and N poses.

    Attributes:
        camera: the estimate. R, t: (N, 3, 3), (N, 3), target to camera, mm.
        residual: (K, 2) px, seen - predicted. chi2: (K,), in the covariances of the points.
        information: (n, n), of the intrinsics, the poses being unknown (Schur complement).
        pose_covariance: (N, 6, 6) of translation (mm), then rotation about the camera axes (rad), for exact intrinsics.
        gain: (N, 6, n), d pose / d intrinsics at the optimum.
        converged: whether the last step promised next to nothing.
    """

    camera: Camera
    R: Tensor
    t: Tensor
    residual: Tensor
    chi2: Tensor
    information: Tensor
    pose_covariance: Tensor
    gain: Tensor
    converged: bool


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: U (n, n), W (N, 6, n), V (N, 6, 6), right-hand sides g (n,) and h (N, 6), cost, residuals."""

    u: Tensor
    w: Tensor
    v: Tensor
    g: Tensor
    h: Tensor
    cost: Tensor
    residual: Tensor
    chi2: Tensor


def adjust(views: Views, camera: Camera, rotation: Tensor, translation: Tensor, *, free: bool = True) -> Bundle:
    """Levenberg-Marquardt over intrinsics and poses; poses are eliminated by the Schur complement (Triggs et al. 2000).

    Residuals are whitened by the covariances of the points. Without ``free`` the camera is given, only poses are found.

    Args:
        views: with regular covariances. camera: to start from; its model and number of coefficients stay.
        rotation, translation: (N, 3, 3), (N, 3), to start from.

    Raises:
        ConfigError: the start puts points behind the camera.
    """
    root = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
    now = _normal(views, camera, rotation, translation, root, free)
    if now is None:
        raise ConfigError("INPUT: a view has points behind the camera that calibration starts from; remove --camera")
    r, t, damping, converged = rotation, translation, 1e-3, False
    for _ in range(_ITERATIONS):
        step_k, step_pose, decrease = _step(now, damping)
        if decrease < _RELATIVE * float(now.cost) + 1e-12:
            converged = True
            break
        moved = moved_camera(camera, step_k) if free else camera
        r_new, t_new = rotations.exp(step_pose[:, 3:]) @ r, t + step_pose[:, :3]
        trial = None if moved is None else _normal(views, moved, r_new, t_new, root, free)
        if moved is not None and trial is not None and trial.cost < now.cost:
            camera, r, t, now, damping = moved, r_new, t_new, trial, max(0.1 * damping, 1e-12)
        else:
            damping *= 10
            if damping > 1e12:  # rounding decides: nowhere lower
                converged = True
                break
    if not free:
        now = _normal(views, camera, r, t, root, True) or now
    covariance = torch.linalg.inv(now.v)
    information = now.u - (now.w.mT @ covariance @ now.w).sum(0)
    return Bundle(camera, r, t, now.residual, now.chi2, information, covariance, -covariance @ now.w, converged)


def moved_camera(camera: Camera, step: Tensor) -> Camera | None:
    """The camera with intrinsics changed by ``step`` (n,); None where that is no camera."""
    matrix = camera.matrix.clone()
    matrix[0, 0] += step[0]
    matrix[1, 1] += step[1]
    matrix[:2, 2] += step[2:4]
    if not bool(step.isfinite().all()) or float(matrix.diagonal()[:2].min()) <= 0:
        return None
    return replace(camera, matrix=matrix, distortion=camera.distortion + step[4:])


def _step(n: _Normal, damping: float) -> tuple[Tensor, Tensor, float]:
    """Damped steps of intrinsics (n,) and poses (N, 6), and the decrease of the cost that they promise."""
    u = n.u + damping * torch.diag(n.u.diagonal())
    v = n.v + damping * torch.diag_embed(n.v.diagonal(dim1=-2, dim2=-1))
    v_inverse = torch.linalg.inv(v)
    reduced = u - (n.w.mT @ v_inverse @ n.w).sum(0)
    right = n.g - (n.w.mT @ v_inverse @ n.h[..., None]).sum(0)[:, 0]
    # focal lengths count in thousands of px, distortion in hundredths
    scale = reduced.diagonal().clamp_min(1e-300).rsqrt()
    scaled, _ = torch.linalg.solve_ex(reduced * scale[:, None] * scale, right * scale)
    step_k = scale * scaled
    step_pose = (v_inverse @ (n.h - n.w @ step_k)[..., None])[..., 0]
    gradient = step_k @ n.g + (step_pose * n.h).sum()
    size = damping * ((step_k.square() * n.u.diagonal()).sum() + (step_pose.square() * n.v.diagonal(0, -2, -1)).sum())
    return step_k, step_pose, float(gradient + size)


def _normal(
    views: Views, camera: Camera, rotation: Tensor, translation: Tensor, root: Tensor, free: bool
) -> _Normal | None:
    """Normal equations at a state, or None where a point is behind the camera or beyond the lens model."""
    arm = (rotation[views.view] @ views.points[..., None])[..., 0]
    x = arm + translation[views.view]
    depth = x[:, 2]
    if not bool((depth > 0).all()):
        return None
    xy = x[:, :2] / depth[:, None]
    if float(xy.norm(dim=-1).max()) >= camera.fold_radius:
        return None
    predicted = camera.distort(xy)
    residual = (root @ (views.pixels - predicted)[..., None])[..., 0]
    eye = torch.eye(2, dtype=xy.dtype).expand(len(xy), 2, 2)
    by_x = camera.J_distort(xy) @ torch.cat([eye, -xy[..., None]], -1) / depth[:, None, None]
    pose = root @ torch.cat([by_x, -by_x @ rotations.skew(arm)], -1)
    intrinsics = root @ (intrinsics_jacobian(camera, xy) if free else xy.new_zeros(len(xy), 2, 0))
    count = len(views)
    return _Normal(
        (intrinsics.mT @ intrinsics).sum(0),
        segment_sum(pose.mT @ intrinsics, views.view, count),
        segment_sum(pose.mT @ pose, views.view, count),
        (intrinsics.mT @ residual[..., None]).sum(0)[:, 0],
        segment_sum((pose.mT @ residual[..., None])[..., 0], views.view, count),
        residual.square().sum(),
        views.pixels - predicted,
        residual.square().sum(-1),
    )


def intrinsics_jacobian(camera: Camera, xy: Tensor) -> Tensor:
    """d(u, v) / d(fx, fy, cx, cy, distortion): (K, 2, 4 + len(distortion)) at normalised coordinates (K, 2)."""
    focal, center = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    bent = (camera.distort(xy) - center) / focal
    eye = torch.eye(2, dtype=xy.dtype).expand(len(xy), 2, 2)
    return torch.cat([torch.diag_embed(bent), eye, focal[:, None] * _by_distortion(camera, xy)], -1)


def _by_distortion(camera: Camera, xy: Tensor) -> Tensor:
    """Derivatives (K, 2, n) of the distorted normalised coordinates by the coefficients, in their order."""
    d, r2 = camera.distortion, xy.square().sum(-1)
    powers = torch.stack([r2, r2.square(), r2.pow(3)], -1)
    if camera.model == "kannala_brandt":
        r = r2.sqrt().clamp_min(1e-12)
        theta = torch.atan(r)
        odd = torch.stack([theta.pow(3), theta.pow(5), theta.pow(7), theta.pow(9)], -1) / r[:, None]
        return xy[:, :, None] * odd[:, None]
    if len(d) == 0:
        return xy.new_zeros(len(xy), 2, 0)
    denominator = 1 + powers @ d[5:8] if len(d) == 8 else torch.ones_like(r2)
    radial = xy[:, :, None] * (powers / denominator[:, None])[:, None]
    cross, square = 2 * xy.prod(-1), 2 * xy.square() + r2[:, None]
    tangential = torch.stack([torch.stack([cross, square[:, 1]], -1), torch.stack([square[:, 0], cross], -1)], -1)
    columns = [radial[..., :2], tangential, radial[..., 2:]]
    if len(d) == 8:
        numerator = 1 + powers @ d[[0, 1, 4]]
        columns.append(-radial * (numerator / denominator)[:, None, None])
    return torch.cat(columns, -1)[..., : len(d)]

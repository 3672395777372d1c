"""Hand-eye calibration: where the camera sits on the robot, from robot poses and target poses of the same moments.

Both mounts are one equation, A_i X B_i = Z: B_i is the target in the camera, X the camera in its mount, and
- camera on the tool: A_i = base_from_tool, X = tool_from_camera, Z = base_from_target;
- camera on the base: A_i = tool_from_base, X = base_from_camera, Z = tool_from_target (the target is on the tool).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.handeye import HandEye

MIN_POSES = 4
_ITERATIONS = 50
_LEAST_TURN_DEG = 1.0  # RMS rotation about an axis, below which the robot has not turned about it
_START_NOISE = (0.05, 2e-4)  # mm, rad of the robot, until the residuals tell
_NOISE_ROUNDS = 8
_LEAST_NOISE = (1e-6, 1e-9)  # mm, rad: where an estimate of none ends


Transform = tuple[Tensor, Tensor]
"""Rotation (..., 3, 3) and translation (..., 3) in mm."""
Noise = tuple[float, float]
"""Standard deviations per axis of the robot's position, mm, and orientation, rad."""


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """Result of `calibrate_hand_eye`.

    Attributes:
        hand_eye: camera in its mount, with its covariance.
        target_rotation, target_translation: (3, 3), (3,) mm: the target on what does not move with the camera (Z).
        covariance: (12, 12) of X (translation, rotation), then Z; rotations multiplied from the left.
        residual: (N, 6), target in the camera, seen - predicted: mm along and rad about the camera's axes.
        chi2, degrees: of the fit.
        robot_sigma_mm, robot_sigma_rad: standard deviation of the robot's poses, per axis, given or estimated.
    """

    hand_eye: HandEye
    target_rotation: Tensor
    target_translation: Tensor
    covariance: Tensor
    residual: Tensor
    chi2: float
    degrees: int
    robot_sigma_mm: float
    robot_sigma_rad: float


def calibrate_hand_eye(
    robot: tuple[Tensor, Tensor],
    target: tuple[Tensor, Tensor],
    covariance: Tensor,
    mount: Literal["base", "tool"],
    *,
    robot_sigma: tuple[float, float] | None = None,
    intrinsics: tuple[Tensor, Tensor] | None = None,
) -> HandEyeFit:
    """Maximum-likelihood hand-eye transform: rotations and translations together, from the start of `linear_start`.

    The residual is the target's pose in the camera; it is weighted by the covariance of that pose and by the noise of
    the robot, taken as equal along all axes. Where the noise is not given, both its parts are estimated from the
    residuals by restricted maximum likelihood (Patterson and Thompson 1971).

    Args:
        robot: base_from_tool of N moments, R (N, 3, 3), t (N, 3) mm. target: camera_from_target, the same.
        covariance: (N, 6, 6) of the target's poses, independent between moments (for exact intrinsics).
        mount: 'tool' for a camera carried by the robot, 'base' for one that looks at a target on the robot.
        robot_sigma: standard deviations of the robot's poses per axis, mm and rad; None: estimated.
        intrinsics: gain (N, 6, n) d pose / d intrinsics and covariance (n, n) of the intrinsics, which shift all poses
            together; None for an exact camera.

    Raises:
        ConfigError: fewer than four poses, or rotations about fewer than two axes.
    """
    check_motion(robot[0])
    a = robot if mount == "tool" else rotations.inverse(*robot)
    x, z = linear_start(a, target)
    noise = robot_sigma or _START_NOISE
    for _ in range(_NOISE_ROUNDS if robot_sigma is None else 1):
        x, z, step = _solve(a, x, z, target, covariance, noise, mount)
        if robot_sigma is None:
            noise = _estimate_noise(step, covariance, a, x, target, noise, mount)
    x, z, step = _solve(a, x, z, target, covariance, noise, mount)
    result = step.covariance
    if intrinsics is not None:
        gain, spread = intrinsics
        # all poses move with the intrinsics, and the solution with the poses
        shift = result @ (step.jacobian.mT @ step.weight @ gain).sum(0)
        result = result + shift @ spread @ shift.T
    count = len(covariance)
    return HandEyeFit(
        HandEye(mount, x[0], x[1], covariance=result[:6, :6]),
        z[0],
        z[1],
        result,
        step.residual,
        float(step.residual.unsqueeze(-1).mT.matmul(step.weight).matmul(step.residual.unsqueeze(-1)).sum()),
        6 * count - 12,
        noise[0],
        noise[1],
    )


def check_motion(rotation: Tensor) -> None:
    """Refuses robot poses (N, 3, 3) that leave the hand-eye transform open.

    Raises:
        ConfigError: too few, no rotation, or rotation about one axis only.
    """
    if len(rotation) < MIN_POSES:
        raise ConfigError(
            f"robot_pose: {len(rotation)} poses with the target in view; hand-eye calibration takes {MIN_POSES} at "
            "least, better 15"
        )
    turns = rotations.log(rotation @ _nearest_rotation(rotation.mean(0)).mT)
    size = torch.linalg.svdvals(turns) / len(turns) ** 0.5
    first, second = size.rad2deg()[:2].tolist()
    if first < _LEAST_TURN_DEG:
        raise ConfigError("robot_pose: the robot does not turn; add poses turned by 10 to 30 degrees about two axes")
    if second < _LEAST_TURN_DEG:
        raise ConfigError(
            "robot_pose: the robot turns about one axis only, which leaves the position along it open; "
            "add poses turned by 10 to 30 degrees about another axis"
        )


def linear_start(
    a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """X and Z of A_i X B_i = Z, rotations before translations (Shah 2013): exact without noise.

    Args:
        a, b: N rigid transforms each, R (N, 3, 3), t (N, 3).
    """
    ra, rb = a[0], b[0]
    # vec(R_Z) = (R_B^T kron R_A) vec(R_X), column by column; their mean has R_X and R_Z as its first singular pair
    kron = torch.einsum("nij,nkl->nikjl", rb.mT, ra).reshape(-1, 9, 9).mean(0)
    u, _, vh = torch.linalg.svd(kron)
    rx, rz = (_nearest_rotation(v.reshape(3, 3).T) for v in (vh[0], u[:, 0]))
    # R_A t_X - t_Z = -t_A - R_A R_X t_B
    eye = torch.eye(3, dtype=ra.dtype).expand_as(ra)
    left = torch.cat([ra, -eye], -1).flatten(0, 1)
    right = (-a[1] - (ra @ rx @ b[1][..., None])[..., 0]).flatten()
    t = torch.linalg.lstsq(left, right[:, None]).solution[:, 0]
    return (rx, t[:3]), (rz, t[3:])


def _nearest_rotation(m: Tensor) -> Tensor:
    """Of a matrix that is a rotation up to a factor of either sign, and noise."""
    u, _, vh = torch.linalg.svd(m * torch.linalg.det(m).sign())
    return u @ vh


@dataclass(frozen=True, eq=False)
class _Step:
    """One linearisation: residual (N, 6), Jacobian (N, 6, 12), weight (N, 6, 6), covariance (12, 12)."""

    residual: Tensor
    jacobian: Tensor
    weight: Tensor
    covariance: Tensor


def _solve(
    a: Transform, x: Transform, z: Transform, b: Transform, covariance: Tensor, noise: Noise, mount: str
) -> tuple[Transform, Transform, _Step]:
    """Gauss-Newton over X and Z with given noise of the robot."""
    for _ in range(_ITERATIONS):
        step = _linearise(a, x, z, b, covariance, noise, mount)
        right = (step.jacobian.mT @ step.weight @ step.residual[..., None]).sum(0)[:, 0]
        delta = step.covariance @ right
        x, z = ((rotations.exp(d[3:]) @ p[0], p[1] + d[:3]) for p, d in ((x, delta[:6]), (z, delta[6:])))
        if float(delta @ right) < 1e-10:
            break
    return x, z, _linearise(a, x, z, b, covariance, noise, mount)


def _linearise(
    a: Transform, x: Transform, z: Transform, b: Transform, covariance: Tensor, noise: Noise, mount: str
) -> _Step:
    """Residual of B_i against X^-1 A_i^-1 Z, its Jacobian by X and Z, and its weight."""
    to_x = rotations.inverse(*rotations.compose(*a, *x))  # camera from what Z is given in
    r, t = rotations.compose(*to_x, *z)
    residual = torch.cat([b[1] - t, rotations.log(b[0] @ r.mT)], -1)
    rx = x[0].T.expand(len(t), 3, 3)
    # X moves by (d, w): the target moves by -R_X^T (d + w x (R_X t)), and turns by -R_X^T w
    in_mount = t @ x[0].T
    zero = torch.zeros_like(rx)
    by_x = torch.cat([torch.cat([-rx, rx @ rotations.skew(in_mount)], -1), torch.cat([zero, -rx], -1)], -2)
    # Z moves by (d, w): t_Z by d, R_Z by w, both turned into the camera
    by_z = torch.cat([torch.cat([to_x[0], zero], -1), torch.cat([zero, to_x[0]], -1)], -2)
    jacobian = torch.cat([by_x, by_z], -1)
    spread = covariance + robot_covariance(a, x, (r, t), noise, mount)
    weight = torch.linalg.inv(spread)
    information = (jacobian.mT @ weight @ jacobian).sum(0)
    scale = information.diagonal().rsqrt()
    inverse = torch.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale
    return _Step(residual, jacobian, weight, inverse)


def robot_covariance(a: Transform, x: Transform, b: Transform, noise: Noise, mount: str) -> Tensor:
    """What noise of the tool's position and orientation does to the target in the camera, (N, 6, 6).

    Args:
        a, x: as in the equation. b: camera_from_target, R (N, 3, 3), t (N, 3). noise: mm, rad, per axis.
    """
    camera_from_tool = rotations.inverse(*(x if mount == "tool" else rotations.compose(*a, *x)))
    # the tool turns about its own origin, and takes what is ``arm`` away along
    lever = rotations.skew(b[1] - camera_from_tool[1])
    eye = torch.eye(3, dtype=lever.dtype).expand_as(lever)
    variance_t, variance_r = noise[0] ** 2, noise[1] ** 2
    top = torch.cat([variance_t * eye + variance_r * lever @ lever.mT, -variance_r * lever], -1)
    bottom = torch.cat([-variance_r * lever.mT, variance_r * eye], -1)
    return torch.cat([top, bottom], -2)


def _estimate_noise(
    step: _Step, covariance: Tensor, a: Transform, x: Transform, b: Transform, start: Noise, mount: str
) -> Noise:
    """Noise of the robot (mm, rad) of greatest restricted likelihood for the residuals of the last fit."""
    unit = [robot_covariance(a, x, b, noise, mount) for noise in ((1.0, 0.0), (0.0, 1.0))]
    log = torch.tensor(start, dtype=torch.float64).clamp_min(_LEAST_NOISE[1]).log().requires_grad_()
    optimiser = torch.optim.LBFGS([log], max_iter=50, line_search_fn="strong_wolfe")
    residual = step.residual[..., None]

    @torch.enable_grad()
    def closure() -> Tensor:
        optimiser.zero_grad()
        variance = (2 * log).exp()
        spread = covariance + variance[0] * unit[0] + variance[1] * unit[1]
        white = torch.linalg.solve(spread, torch.cat([step.jacobian, residual], -1))
        information = (step.jacobian.mT @ white[..., :-1]).sum(0)
        cost = spread.logdet().sum() + (residual.mT @ white[..., -1:]).sum() + information.logdet()
        cost.backward()
        return cost

    optimiser.step(closure)
    sigma_t, sigma_r = log.detach().exp().tolist()
    return max(sigma_t, _LEAST_NOISE[0]), max(sigma_r, _LEAST_NOISE[1])

"""Hand-eye calibration: where the camera sits on the robot, from robot poses and target poses of the same moments.

Both mounts are one equation, A_i X B_i = Z: B_i is the target in the camera, X the camera in its mount, and
- camera on the tool: A_i = base_from_tool, X = tool_from_camera, Z = base_from_target;
- camera on the base: A_i = tool_from_base, X = base_from_camera, Z = tool_from_target (the target is on the tool).
"""

import math
from dataclasses import dataclass
from typing import Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import Minimum, Normal, Pose, Unknowns, minimise, scaled_inverse
from torchpose.geometry.projection import by_pose
from torchpose.handeye import HandEye

MIN_POSES = 4
_ITERATIONS = 50
_RELATIVE = 1e-12  # decrease that a step must promise, of the cost
_LEAST_TURN_DEG = 1.0  # RMS rotation about an axis, below which the robot has not turned about it
START_NOISE = (0.05, 2e-4)  # mm, rad of the robot, until the residuals tell
_NOISE_ROUNDS, _NOISE_STEPS = 8, 100
_SETTLED = 1e-6  # relative change of a variance in a step: far below what residuals tell of it
LEAST_NOISE = (1e-6, 1e-9)  # mm, rad: where an estimate of none ends

_MOST_NOISE = (5.0, 0.05)  # mm, rad: a robot that is farther off was not there when the frames were taken

Mount = Literal["base", "tool"]
Transform = tuple[Tensor, Tensor]
"""Rotation (..., 3, 3) and translation (..., 3) in mm."""
Noise = tuple[float, float]
"""Standard deviations per axis of the robot's position, mm, and orientation, rad."""


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """Result of `calibrate_hand_eye`."""

    hand_eye: HandEye  # camera in its mount, with its covariance
    target_rotation: Float[Tensor, "3 3"]  # of the target on what does not move with the camera (Z)
    target_translation: Float[Tensor, " 3"]  # mm
    covariance: Float[Tensor, "12 12"]  # of X (translation, rotation), then Z; rotations multiplied from the left
    residual: Float[Tensor, "N 6"]  # target in the camera, seen - predicted: mm along and rad about the camera's axes
    chi2: float
    degrees: int  # of freedom of the fit
    robot_sigma_mm: float  # standard deviation of the robot's position, per axis, given or estimated
    robot_sigma_rad: float  # the same of its orientation

    @property
    def shown(self) -> Noise:
        """The noise that the residuals show, if it is in proportion as it was given."""
        # of a fit that is lost, as that of the wrong mount may be, even the sum of squares is
        over = (self.chi2 / max(self.degrees, 1)) ** 0.5 if self.chi2 >= 0 else math.inf
        return over * self.robot_sigma_mm, over * self.robot_sigma_rad


@checked
def calibrate_hand_eye(
    robot: Transform,
    target: Transform,
    covariance: Float[Tensor, "N 6 6"],
    mount: Mount,
    *,
    robot_sigma: Noise | None = None,
    intrinsics: tuple[Tensor, Tensor] | None = None,
) -> HandEyeFit:
    """Maximum-likelihood hand-eye transform: rotations and translations together, from the start of `linear_start`.

    The residual is the target's pose in the camera; it is weighted by the covariance of that pose and by the noise of
    the robot, taken as equal along all axes. Where the noise is not given, both its parts are estimated from the
    residuals by restricted maximum likelihood (Patterson and Thompson 1971).

    Args:
        robot: base_from_tool of N moments, R (N, 3, 3), t (N, 3) mm.
        target: camera_from_target, the same.
        covariance: of the target's poses, independent between moments (for exact intrinsics).
        mount: 'tool' for a camera carried by the robot, 'base' for one that looks at a target on the robot.
        robot_sigma: standard deviations of the robot's poses per axis, mm and rad; None: estimated.
        intrinsics: gain (N, 6, n) d pose / d intrinsics and covariance (n, n) of the intrinsics, which shift all poses
            together; None for an exact camera.

    Raises:
        ConfigError: fewer than four poses, or rotations about fewer than two axes.
    """
    check_motion(robot[0])
    moments = _Moments(robot if mount == "tool" else rotations.inverse(*robot), target, covariance, mount)
    x, z = linear_start(moments.a, target)
    unknowns = Unknowns({name: Pose(r[None], t[None]) for name, (r, t) in (("x", x), ("z", z))})
    noise = robot_sigma or START_NOISE
    for _ in range(_NOISE_ROUNDS if robot_sigma is None else 0):
        unknowns = moments.fit(unknowns, noise).unknowns
        noise = _estimate_noise(moments, unknowns, noise)
    found = moments.fit(unknowns, noise)
    spread = found.covariance()[0][0]
    residual, jacobian, weight = moments.linearised(found.unknowns, noise)
    if intrinsics is not None:
        gain, uncertainty = intrinsics
        # all poses move with the intrinsics, and the solution with the poses
        shift = spread @ (jacobian.mT @ weight @ gain).sum(0)
        spread = spread + shift @ uncertainty @ shift.T
    (r, t), z = _transforms(found.unknowns)
    hand_eye = HandEye(mount, r, t, covariance=spread[:6, :6])
    return HandEyeFit(hand_eye, *z, spread, residual, float(found.normal.cost), 6 * len(covariance) - 12, *noise)


def calibrate_mount(
    robot: Transform,
    target: Transform,
    covariance: Tensor,
    *,
    robot_sigma: Noise | None = None,
    intrinsics: tuple[Tensor, Tensor] | None = None,
) -> HandEyeFit:
    """`calibrate_hand_eye` where the mount is not known: it follows from the poses.

    Raises:
        ConfigError: as there, or poses of robot and target that have nothing to do with each other.
    """
    mounts: tuple[Mount, Mount] = ("base", "tool")
    fits = [
        calibrate_hand_eye(robot, target, covariance, mount, robot_sigma=robot_sigma, intrinsics=intrinsics)
        for mount in mounts
    ]
    fit = min(fits, key=lambda one: one.shown[0])
    if not (fit.shown[0] <= _MOST_NOISE[0] and fit.shown[1] <= _MOST_NOISE[1]):  # nor where it is no number
        raise ConfigError(
            f"robot_pose: robot and target poses disagree by {fit.shown[0]:.1f} mm and {fit.shown[1]:.2g} rad; check "
            "the units and that each pose was read when its frame was taken"
        )
    return fit


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


def linear_start(a: Transform, b: Transform) -> tuple[Transform, Transform]:
    """X and Z of A_i X B_i = Z, N moments, rotations before translations (Shah 2013): exact without noise."""
    ra, rb = a[0], b[0]
    # vec(R_Z) = (R_B^T kron R_A) vec(R_X), column by column; their mean has R_X and R_Z as its first singular pair
    kron = torch.einsum("nij,nkl->nikjl", rb.mT, ra).reshape(-1, 9, 9).mean(0)
    u, _, vh = torch.linalg.svd(kron)
    rx, rz = (_nearest_rotation(v.reshape(3, 3).T) for v in (vh[0], u[:, 0]))
    # R_A t_X - t_Z = -t_A - R_A R_X t_B
    eye = torch.eye(3, dtype=ra.dtype, device=ra.device).expand_as(ra)
    left = torch.cat([ra, -eye], -1).flatten(0, 1)
    right = (-a[1] - (ra @ rx @ b[1][..., None])[..., 0]).flatten()
    t = torch.linalg.lstsq(left, right[:, None]).solution[:, 0]
    return (rx, t[:3]), (rz, t[3:])


def _nearest_rotation(matrix: Tensor) -> Tensor:
    """Of a matrix that is a rotation up to a factor of either sign, and noise."""
    u, _, vh = torch.linalg.svd(matrix * torch.linalg.det(matrix).sign())
    return u @ vh


@dataclass(frozen=True, eq=False)
class _Moments:
    """N moments: A_i, B_i, the covariance (N, 6, 6) of the latter, and where the camera is mounted."""

    a: Transform
    b: Transform
    covariance: Tensor
    mount: Mount

    def fit(self, unknowns: Unknowns, noise: Noise) -> Minimum:
        """Gauss-Newton over X and Z with given noise of the robot."""

        def problem(unknowns: Unknowns) -> Normal:
            residual, jacobian, weight = self.linearised(unknowns, noise)
            both = torch.cat([jacobian, residual[..., None]], -1)
            product = (both.mT @ weight @ both).sum(0, keepdim=True)
            return Normal(product[:, :-1, :-1], product[:, :-1, -1], product[:, -1, -1])

        return minimise(problem, unknowns, _ITERATIONS, tolerance=_RELATIVE)

    def linearised(self, unknowns: Unknowns, noise: Noise) -> tuple[Tensor, Tensor, Tensor]:
        """Residual (N, 6) of B_i against X^-1 A_i^-1 Z, its Jacobian (N, 6, 12) by X and Z, its weight (N, 6, 6)."""
        x, z = _transforms(unknowns)
        to_x = rotations.inverse(*rotations.compose(*self.a, *x))  # camera from what Z is given in
        r, t = rotations.compose(*to_x, *z)
        residual = torch.cat([self.b[1] - t, rotations.log(self.b[0] @ r.mT)], -1)
        rx = x[0].T.expand(len(t), 3, 3)
        zero = torch.zeros_like(rx)
        # X moves by (d, w): the target moves by -R_X^T (d + w x (R_X t)), and turns by -R_X^T w
        by_x = -torch.cat([by_pose(rx, t @ x[0].T), torch.cat([zero, rx], -1)], -2)
        # Z moves by (d, w): t_Z by d, R_Z by w, both turned into the camera
        by_z = torch.cat([torch.cat([to_x[0], zero], -1), torch.cat([zero, to_x[0]], -1)], -2)
        weight, info = torch.linalg.inv_ex(self.covariance + self.robot_covariance(x, (r, t), noise))
        weight = torch.where((info == 0)[:, None, None], weight, torch.nan)  # of a fit that is lost, see `shown`
        return residual, torch.cat([by_x, by_z], -1), weight

    def robot_covariance(self, x: Transform, target: Transform, noise: Noise) -> Tensor:
        """What noise of the tool's position and orientation does to the target in the camera, (N, 6, 6)."""
        camera_from_tool = rotations.inverse(*(x if self.mount == "tool" else rotations.compose(*self.a, *x)))
        # the tool turns about its own origin, and takes what is ``arm`` away along
        arm = target[1] - camera_from_tool[1]
        eye = torch.eye(3, dtype=arm.dtype, device=arm.device).expand(len(arm), 3, 3)
        moved = torch.cat([by_pose(eye, arm), torch.cat([torch.zeros_like(eye), eye], -1)], -2)
        return (moved * arm.new_tensor(noise).square().repeat_interleave(3)) @ moved.mT


def _transforms(unknowns: Unknowns) -> tuple[Transform, Transform]:
    """X and Z."""
    x, z = (cast(Pose, unknowns.own[name]) for name in ("x", "z"))
    return (x.R[0], x.t[0]), (z.R[0], z.t[0])


def _estimate_noise(moments: _Moments, unknowns: Unknowns, start: Noise) -> Noise:
    """Noise of the robot (mm, rad) that the residuals of the last fit show."""
    x, _ = _transforms(unknowns)
    residual, jacobian, _ = moments.linearised(unknowns, start)
    units: tuple[Noise, Noise] = ((1.0, 0.0), (0.0, 1.0))
    parts = torch.stack([moments.robot_covariance(x, moments.b, unit) for unit in units])
    nothing = jacobian.new_zeros(jacobian.shape[-1], jacobian.shape[-1] + 1)
    return restricted_noise(residual, jacobian, moments.covariance, parts, nothing, start)


def restricted_noise(
    residual: Float[Tensor, "N 6"],
    columns: Float[Tensor, "N 6 u"],
    covariance: Float[Tensor, "N 6 6"],
    parts: Float[Tensor, "2 N 6 6"],
    known: Float[Tensor, "u v"],
    start: Noise,
) -> Noise:
    """Noise of the robot (mm, rad) of greatest restricted likelihood (Patterson and Thompson 1971).

    Residuals y that u unknowns move by X have the covariance S, of the poses and of the parts D_k of the noise. At the
    maximum y^T P D_k P y = tr P D_k with P = S^-1 - S^-1 X (A + X^T S^-1 X)^-1 X^T S^-1, A being what else is known of
    the unknowns: a step makes both equal as if P stayed, and never leads to less than nothing.

    Args:
        residual: seen less predicted.
        columns: derivatives of the predicted by the unknowns.
        covariance: of the residuals without the noise.
        parts: of their covariance by noise of 1 mm, and of 1 rad.
        known: A, and last the right side (v = u + 1) that belongs to it.
        start: from above it is found in few steps.
    """
    y, information, right = residual[..., None], known[:, :-1], known[:, -1:]
    variance, least = y.new_tensor(start).square(), y.new_tensor(LEAST_NOISE).square()
    for _ in range(_NOISE_STEPS):
        weight = torch.linalg.inv(covariance + (variance[:, None, None, None] * parts).sum(0))
        pulled = columns.mT @ weight
        inverse, determined = scaled_inverse((information + (pulled @ columns).sum(0))[None])
        if not bool(determined):
            break
        own = inverse[0] @ (right + (pulled @ y).sum(0))
        left = weight @ (y - columns @ own)
        outer = weight - pulled.mT @ inverse @ pulled
        over = (left.mT @ parts @ left).sum((1, 2, 3)) / (outer * parts).sum((1, 2, 3))
        before, variance = variance, torch.maximum(variance * over, least)
        if bool(((variance / before).log().abs() < _SETTLED).all()):
            break
    mm, rad = variance.sqrt().tolist()
    return mm, rad

"""What ties cameras together: moments in which two of them see the target, and a robot whose poses are known.

Cameras between which a chain of common moments leads are a group. Their places are along the ties of most moments.
Between groups there may be a robot: the first camera of each group has a place in its mount, by the poses of robot and
target at the moments of that group, and the target is at one place on the other side of the robot for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.calibration.hand_eye import START_NOISE, HandEyeFit, Transform, calibrate_mount, check_motion
from torchpose.calibration.robot import POSE, Robot
from torchpose.calibration.views import Views
from torchpose.camera import Camera, CameraRig
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

_BY_ROBOT = "robot poses of these moments in a capture manifest would tie them, too"


def common_moments(views: Views, cameras: int) -> Int[Tensor, "C C"]:
    """In how many moments each two cameras see the target."""
    seen = torch.zeros(cameras, len(views), dtype=torch.int64, device=views.view.device)
    seen[views.lens, views.view] = 1
    return seen @ seen.mT


def groups_of(common: Int[Tensor, "C C"]) -> Int[Tensor, " C"]:
    """Number of the group of each camera: of those that a chain of common moments leads to, by their first camera."""
    reached = torch.linalg.matrix_power((common > 0).double(), len(common)) > 0
    first = reached.int().argmax(1)
    return torch.unique(first, return_inverse=True)[1]


def check_connected(names: Sequence[str], common: Int[Tensor, "C C"], *, robot: bool = False) -> None:
    """
    Raises:
        ConfigError: cameras that neither a chain of common moments nor a robot ties to the first one.
    """
    group = groups_of(common)
    if int(group.amax()) and not robot:
        raise ConfigError(
            f"INPUT: cameras {apart(names, common)} are apart: the target is seen by one of each at no moment; add "
            f"moments in which it is, or calibrate each by itself; {_BY_ROBOT}"
        )


def names_of(names: Sequence[str], group: Tensor, number: int) -> str:
    """Of the cameras of a group."""
    return " and ".join(compress(names, (group == number).tolist()))


def apart(names: Sequence[str], common: Int[Tensor, "C C"]) -> str:
    """The cameras in their groups, such as `cam0 | cam1 and cam2`."""
    group = groups_of(common)
    return " | ".join(names_of(names, group, k) for k in range(int(group.amax()) + 1))


def group_of_moments(views: Views, group: Int[Tensor, " C"]) -> Int[Tensor, " N"]:
    """The group that sees the target at each moment."""
    return torch.zeros(len(views), dtype=torch.int64).index_put((views.view,), group[views.lens])


def first_places(
    cameras: tuple[Camera, ...], R: Float[Tensor, "C N 3 3"], t: Float[Tensor, "C N 3"], common: Int[Tensor, "C C"]
) -> CameraRig:
    """Places as seen from the first camera of each group, along the ties of most moments; poses are NaN where there is
    none."""
    count = len(cameras)
    eye = torch.eye(3, dtype=R.dtype)
    turns, shifts = [eye] * count, [torch.zeros(3, dtype=R.dtype)] * count
    placed = torch.zeros(count, dtype=torch.bool)
    for _ in range(count):
        open_ties = torch.where(placed[:, None] & ~placed, common, 0)
        if not bool(open_ties.any()):
            placed[int((~placed).int().argmax())] = True
            continue
        known, new = divmod(int(open_ties.argmax()), count)
        back = rotations.inverse(R[known], t[known])
        turn, shift = most_agreed(*rotations.compose(R[new], t[new], *back))
        turns[new], shifts[new] = rotations.compose(turn, shift, turns[known], shifts[known])
        placed[new] = True
    return CameraRig(cameras, torch.stack(turns), torch.stack(shifts))


def most_agreed(R: Tensor, t: Tensor) -> Transform:
    """That of some transforms (N, 3, 3), (N, 3) of the least median distance to all; NaN are none."""
    there = t.isfinite().all(-1)
    R, t = R[there], t[there]
    turned = rotations.log(R[:, None] @ R.mT).norm(dim=-1)
    moved = (t[:, None] - t).norm(dim=-1) / t.norm(dim=-1).median().clamp_min(1.0)
    best = int((turned + moved).median(-1).values.argmin())
    return R[best], t[best]


class Tied(NamedTuple):
    """Cameras with their places from the first, poses of the moments in that, and the robot with its chain."""

    rig: CameraRig
    R: Tensor
    t: Tensor
    robot: Robot


def tied_by_robot(
    names: Sequence[str], views: Views, rig: CameraRig, seen: Transform, tool: Float[Tensor, "N 6"]
) -> Tied:
    """Groups of cameras put together by the robot.

    The group that tells most has the chain, by hand-eye calibration; any one moment more then places another group.

    Args:
        rig: places as seen from the first camera of each group.
        seen: poses (N, 3, 3), (N, 3) of the moments in these.
        tool: base_from_tool, mm and the rotation vector in rad; NaN where it is not known.

    Raises:
        ConfigError: a group that no robot pose is known of, or motions of the robot that leave the chain open.
    """
    common = common_moments(views, len(rig))
    group = groups_of(common)
    of_moment = group_of_moments(views, group)
    parts = [((of_moment == k) & tool.isfinite().all(-1)).nonzero()[:, 0] for k in range(int(group.amax()) + 1)]
    for k, part in enumerate(parts):
        if not len(part):
            raise ConfigError(
                f"INPUT: cameras {apart(names, common)} are apart, and no robot pose is known of the moments in which "
                f"{names_of(names, group, k)} has the target; add them to the manifest"
            )
    robot = rotations.exp(tool[:, 3:]), tool[:, :3]
    fit = _chain(apart(names, common), parts, seen, robot)
    mount, z = fit.hand_eye.mount, (fit.target_rotation, fit.target_translation)
    # A X B = Z at every moment
    back = rotations.inverse(*robot) if mount == "tool" else robot
    each = rotations.compose(*rotations.compose(*back, *z), *rotations.inverse(*seen))
    mounted = [most_agreed(each[0][part], each[1][part]) for part in parts]
    x, others = mounted[0], mounted[1:]
    first = [(torch.eye(3).to(tool), torch.zeros(3).to(tool))]
    first += [rotations.compose(*rotations.inverse(*own), *x) for own in others]
    turns, shifts = (torch.stack(of) for of in zip(*first, strict=True))
    places = rotations.compose(rig.R, rig.t, turns[group], shifts[group])
    poses = rotations.compose(*rotations.inverse(turns[of_moment], shifts[of_moment]), *seen)
    # from above it is found in few rounds, see `hand_eye.restricted_noise`
    noise = max(fit.shown[0], START_NOISE[0]), max(fit.shown[1], START_NOISE[1])
    return Tied(CameraRig(rig.cameras, *places), *poses, Robot(*robot, mount, x, z, noise))


def _chain(cameras: str, parts: Sequence[Tensor], seen: Transform, robot: Transform) -> HandEyeFit:
    """The hand-eye calibration of the group with most moments among those whose motions determine it."""
    wrong = ""
    for part in sorted(parts, key=len, reverse=True):
        try:
            check_motion(robot[0][part])
        except ConfigError as error:
            wrong = wrong or str(error)
            continue
        exact = seen[1].new_zeros(len(part), POSE, POSE)  # next to the robot's noise
        one, other = ((R[part], t[part]) for R, t in (robot, seen))
        return calibrate_mount(one, other, exact, robot_sigma=START_NOISE)
    raise ConfigError(f"INPUT: cameras {cameras} are apart, and the robot does not tie them: {wrong}")

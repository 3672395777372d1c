"""Where a robot stood at the views of a calibration: it ties cameras together that see the target at no common moment.

Cameras and target are on either side of the robot, so base, tool, camera and target are a chain that closes at every
view. With X the first camera in its mount, B the target in that camera, Z the target on what does not move with it:

- cameras on the base: base_from_tool = X B Z^-1;
- cameras on the tool: base_from_tool = Z (X B)^-1.

What is left of that is the robot's noise, equal along all axes, the position's and the orientation's: six residuals a
view, of the view's pose and of X and Z. X and Z are common to all cameras, whose places are in B.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.calibration.hand_eye import Mount, Noise, Transform, restricted_noise
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.geometry.projection import by_pose
from torchpose.geometry.rows import Rows, shared

POSE = 6
CHAIN = 2 * POSE  # unknowns of X and Z
_LOST = 38.3  # chi-squared of a pose that is left out (derived: of six residuals one good pose in 10^6 has more)


@dataclass(frozen=True, eq=False)
class Robot(Rows):
    """base_from_tool of N views, of which t is NaN where it is not known, and the chain to start from.

    Attributes:
        R, t: the robot's poses, mm.
        mount: what the cameras are on.
        x, z: the first camera in its mount, and the target on the other side.
        noise: of the robot.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    mount: Mount = shared()
    x: Transform = shared()
    z: Transform = shared()
    noise: Noise = shared()

    def coarser(self, times: float) -> Self:
        """The same with so much more noise."""
        return replace(self, noise=(times * self.noise[0], times * self.noise[1]))

    @property
    def known(self) -> Tensor:
        """(N,) bool."""
        return self.t.isfinite().all(-1)

    def closed(self, x: Transform, z: Transform, R: Tensor, t: Tensor) -> Closure:
        """The chain with views at poses (N, 3, 3), (N, 3)."""
        y = rotations.compose(*x, R, t)
        turn = x[0].expand(len(t), 3, 3)
        zero = torch.zeros_like(turn)
        y_by_view = torch.cat([torch.cat([turn, zero], -1), torch.cat([zero, turn], -1)], -2)
        eye = torch.eye(3).to(turn).expand_as(turn)
        y_by_x = torch.cat([by_pose(eye, y[1] - x[1]), torch.cat([zero, eye], -1)], -2)
        z = z[0].expand(len(t), 3, 3), z[1].expand(len(t), 3)
        if self.mount == "base":
            found, by_y, by_z = _quotient(y, z)
        else:
            found, by_z, by_y = _quotient(z, y)
        off = torch.cat([self.t - found[1], rotations.log(self.R @ found[0].mT)], -1)
        known = self.known[:, None]
        weight = torch.where(known, off.new_tensor(self.noise).repeat_interleave(3).square().reciprocal(), 0.0)
        return Closure(torch.where(known, off, 0.0), by_y @ y_by_view, torch.cat([by_y @ y_by_x, by_z], -1), weight)


class Closure(NamedTuple):
    """How chains close: the robot's poses less those that the rest predicts, by base axes (N, 6), their derivatives by
    the poses of the views (N, 6, 6) and by X and Z (N, 6, 12), and their weights (N, 6), 0 where nothing is known."""

    residual: Tensor
    by_view: Tensor
    by_chain: Tensor
    weight: Tensor


def _quotient(u: Transform, v: Transform) -> tuple[Transform, Tensor, Tensor]:
    """u v^-1 of N pairs, and its derivatives (N, 6, 6) by either; steps are a translation, and a turn from the left."""
    turn = u[0] @ v[0].mT
    arm = (turn @ v[1][..., None])[..., 0]
    zero, eye = torch.zeros_like(turn), torch.eye(3).to(turn).expand_as(turn)
    # what u turns about itself takes v^-1 along, which lies at -arm from there
    by_u = torch.cat([by_pose(eye, -arm), torch.cat([zero, eye], -1)], -2)
    by_v = -torch.cat([torch.cat([turn, rotations.skew(arm) @ turn], -1), torch.cat([zero, turn], -1)], -2)
    return (turn, u[1] - arm), by_u, by_v


class Settled(NamedTuple):
    """A robot with the chain that an adjustment has found, its residuals (N, 6), and the noise that they show."""

    robot: Robot
    residual: Tensor
    shown: Noise

    def again(self) -> Robot:
        """For the next adjustment: with this noise, and without poses that contradict the others."""
        scale = self.residual.new_tensor(self.robot.noise).repeat_interleave(3)
        lost = (self.residual / scale).square().sum(-1) > _LOST
        return replace(self.robot, t=torch.where(lost[:, None], torch.nan, self.robot.t), noise=self.shown)


class WithoutRobot(NamedTuple):
    """Normal equations of everything but the chain: of the u unknowns (u, u), of these and the views' poses (N, u, 6),
    and of the latter (N, 6, 6)."""

    own: Tensor
    mixed: Tensor
    views: Tensor


def shown_noise(robot: Robot, closure: Closure, by_own: Float[Tensor, "N 6 u"], rest: WithoutRobot) -> Noise:
    """The noise of the robot that its residuals show, about an adjustment: of a chain in which each view has the pose
    that its points alone give it.

    Args:
        robot: with the noise of the adjustment.
        closure: at its end.
        by_own: derivatives of the predicted poses by the u unknowns.
        rest: what the points tell.
    """
    some = robot.known
    poses, _ = scaled_inverse(rest.views)
    told = rest.own - (rest.mixed @ poses @ rest.mixed.mT).sum(0)
    columns = (by_own - closure.by_view @ poses @ rest.mixed.mT)[some]
    spread = (closure.by_view @ poses @ closure.by_view.mT)[some]
    pull = (closure.weight * closure.residual)[some, :, None]
    # at the end of an adjustment the points pull against the chain
    alone = closure.residual[some] + (spread @ pull)[..., 0]
    known = torch.cat([told, -(columns.mT @ pull).sum(0)], -1)
    parts = torch.diag_embed(torch.eye(2).to(spread).repeat_interleave(3, 1))[:, None].expand(-1, len(alone), -1, -1)
    return restricted_noise(alone, columns, spread, parts, known, robot.noise)

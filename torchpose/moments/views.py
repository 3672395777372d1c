"""What each camera of a rig has of the targets of a moment, laid out by moment and target."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchpose.camera import CameraRig
from torchpose.geometry import rotations
from torchpose.identify import Scene
from torchpose.pose import Evidence, Found
from torchpose.refine import Sight


class View(NamedTuple):
    """What one camera has of N rows, the targets of every moment.

    Attributes:
        camera: its number in the rig.
        scene: of its own pictures.
        found: in these, one row a picture and target.
        row: (N,) int64, which of them each row is; -1 where the camera has no picture.
        moment: (B',) int64, of its pictures.
    """

    camera: int
    scene: Scene
    found: Found
    row: Tensor
    moment: Tensor

    def evidence(self, rows: Tensor) -> Evidence:
        """What it measured of some rows (J,), with the markers that its own solution explains, where it has one."""
        own = self.row[rows]
        some = self.found.evidence[own.clamp_min(0)]
        return replace(some, mask=self.used[own.clamp_min(0)] & (own >= 0)[:, None])

    @property
    def used(self) -> Tensor:
        """(N', M) bool, the markers of its own rows, without those that its solutions leave out."""
        index, solutions = self.found.solvable, self.found.solutions
        own = self.found.evidence.mask
        return own.index_copy(0, index, torch.where(solutions.solved[:, None], solutions.mask, own[index]))

    def place(self, rows: Tensor) -> Tensor:
        """Which of its solutions some rows (J,) are; -1 where it has none."""
        own = self.row[rows]
        place = torch.full((len(self.found.evidence),), -1, device=own.device)
        place = place.index_copy(0, self.found.solvable, torch.arange(len(self.found.solvable), device=own.device))
        return torch.where(own >= 0, place[own.clamp_min(0)], -1)

    def sight(self, rows: Tensor, mask: Tensor) -> Sight:
        """Rows (J,) in its pictures, with the markers of the mask (J, M)."""
        own = self.row[rows].clamp_min(0)
        return replace(Sight.of_scene(self.scene, self.found, own), mask=mask)


class Moments(NamedTuple):
    """B moments of T targets, N = B T rows, moment-major, and what the cameras have of them; one view a camera that
    has any picture.
    """

    rig: CameraRig
    views: list[View]
    moments: int
    targets: int

    @property
    def rows(self) -> int:
        return self.moments * self.targets

    def of_views(self, views: list[View]) -> Self:
        return self._replace(views=views)

    def in_view(self, view: View, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Poses in the axes of a view's camera."""
        return self.rig.seen_by(view.camera, R, t)

    def seen(self, rows: Tensor) -> Tensor:
        """(J, V, M) bool, the markers that each view has of some rows."""
        return torch.stack([view.evidence(rows).mask for view in self.views], 1)


def motion_in_view(rig: CameraRig, camera: int) -> Tensor:
    """(6, 6): how a pose in the axes of a camera moves with that in the axes of the first."""
    turn = rig.R[camera]
    return torch.block_diag(turn, turn)


def motion_of_place(rig: CameraRig, camera: int, t: Tensor) -> Tensor:
    """(J, 6, k): how poses at t (J, 3) in the axes of a camera move with the numbers of the cameras' places."""
    arm = t - rig.t[camera].to(t)
    by_place = torch.eye(6).to(t).repeat(len(t), 1, 1)
    by_place[:, :3, 3:] = -rotations.skew(arm)
    return by_place @ rig.factor()[camera].to(t)

"""What is known of a batch before anything in it is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.least_squares import covariance_factor
from torchpose.geometry.rows import Rows
from torchpose.target import Target

_SAME_CODE = 1e-3  # of the ratio of radii: what differs by less is one code


@dataclass(frozen=True, eq=False)
class MarkerTable(Rows):
    """T targets as padded tensors of M markers.

    Attributes:
        ids: of the markers.
        centers: target frame, mm.
        normals: the same.
        radii: outer and inner, mm, as printed (`Target.printed_radii`).
        valid: False where padded.
        polarity: +1 dark rings, -1 light ones.
        coplanar: whether all markers lie in one plane.
        by_print: how place (mm) and edge gain (mm) of the markers vary with each of Q numbers of unit variance, as
            `Target.covariance` says.
    """

    ids: Int[Tensor, "T M"]
    centers: Float[Tensor, "T M 3"]
    normals: Float[Tensor, "T M 3"]
    radii: Float[Tensor, "T M 2"]
    valid: Bool[Tensor, "T M"]
    polarity: Float[Tensor, " T"]
    coplanar: Bool[Tensor, " T"]
    by_print: Float[Tensor, "T M 4 Q"]

    @classmethod
    def of(cls, targets: Sequence[Target]) -> Self:
        def padded(rows: Sequence[Tensor], fill: float) -> Tensor:
            return torch.nn.utils.rnn.pad_sequence(list(rows), batch_first=True, padding_value=fill)

        return cls(
            padded([t.ids for t in targets], -1),
            padded([t.centers for t in targets], 0.0),
            padded([t.normals for t in targets], 0.0),
            padded([t.printed_radii for t in targets], 1.0),
            padded([torch.ones(len(t), dtype=torch.bool) for t in targets], False),
            torch.tensor([1.0 if t.background == "light" else -1.0 for t in targets], dtype=torch.float64),
            torch.tensor([t.coplanar for t in targets]),
            _by_print(targets),
        )

    @property
    def half_gap(self) -> Float[Tensor, " T"]:
        """Half of the least difference between two codes of each target, as ratios of radii; inf where there is one."""
        ratio = self.radii[..., 1] / self.radii[..., 0]
        apart = (ratio[:, :, None] - ratio[:, None]).abs()
        both = self.valid[:, :, None] & self.valid[:, None] & (apart > _SAME_CODE)
        return 0.5 * torch.where(both, apart, torch.inf).flatten(1).amin(1)


def _by_print(targets: Sequence[Target]) -> Tensor:
    """`MarkerTable.by_print`; Q is the most directions that a covariance has, 0 where all targets are perfect."""
    factors = [covariance_factor(t.centers.new_zeros(1, 1) if t.covariance is None else t.covariance) for t in targets]
    table = torch.zeros(len(targets), max(map(len, targets)), 4, max(f.shape[1] for f in factors), dtype=torch.float64)
    for of_target, target, factor in zip(table, targets, factors, strict=True):
        if target.covariance is not None:
            places = factor[:-1].unflatten(0, (-1, 3))
            of_target[: len(target), :3, : factor.shape[1]] = places
            of_target[: len(target), 3, : factor.shape[1]] = factor[-1]
    return table


class Scene(NamedTuple):
    """B frames (B, H, W) in grey levels, the camera that took them, the targets looked for, and whose each row is.

    frame (N,) and target (N,) int64: before identification every frame and target is a row, N = B * T, frame-major;
    then every copy of a target that was found, in the same order.
    """

    frames: Tensor
    camera: Camera
    table: MarkerTable
    frame: Tensor
    target: Tensor

    @classmethod
    def of(cls, frames: Tensor, camera: Camera, table: MarkerTable) -> Self:
        """With a row for every frame and target."""
        every = torch.arange(len(frames) * len(table), device=frames.device)
        return cls(frames, camera, table, every // len(table), every % len(table))

    def of_rows(self, group: Tensor) -> Self:
        """The same with other rows, of the frames and targets ``group`` (N,): frame times T plus target."""
        return self._replace(frame=group // len(self.table), target=group % len(self.table))

    @property
    def groups(self) -> int:
        """Number of frames times targets."""
        return len(self.frames) * len(self.table)

    @property
    def group(self) -> Tensor:
        """(N,) int64, frame times T plus target."""
        return self.frame * len(self.table) + self.target

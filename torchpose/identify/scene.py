"""What is known of a batch before anything in it is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.rows import Rows
from torchpose.target import Target

_SAME_CODE = 1e-3  # of the ratio of radii: what differs by less is one code
MOST_GAIN = 3.0  # deviations of the edge gain that a file states, up to which codes are read (a convention)
# mm, of prints of which nothing is said: laser printers and copiers (docs/targets.md); no more than makes half a code
_OFFICE_GAIN = 0.1


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
        gain_sigma: of the edge gain, mm; 0 where the file states none.
    """

    ids: Int[Tensor, "T M"]
    centers: Float[Tensor, "T M 3"]
    normals: Float[Tensor, "T M 3"]
    radii: Float[Tensor, "T M 2"]
    valid: Bool[Tensor, "T M"]
    polarity: Float[Tensor, " T"]
    coplanar: Bool[Tensor, " T"]
    gain_sigma: Float[Tensor, " T"]

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
            torch.stack([t.radii.new_zeros(()) if t.covariance is None else t.covariance[-1, -1] for t in targets])
            .clamp_min(0)
            .sqrt(),
        )

    @property
    def half_gap(self) -> Float[Tensor, " T"]:
        """Half of the least difference between two codes of each target, as ratios of radii; inf where there is one."""
        ratio = self.radii[..., 1] / self.radii[..., 0]
        apart = (ratio[:, :, None] - ratio[:, None]).abs()
        both = self.valid[:, :, None] & self.valid[:, None] & (apart > _SAME_CODE)
        return 0.5 * torch.where(both, apart, torch.inf).flatten(1).amin(1)

    @property
    def gain_scale(self) -> Float[Tensor, " T"]:
        """Standard deviation of each target's edge gain, mm: as its file states it, or that of a plausible print.

        Of a print of which nothing is said the codes alone tell what they are: by less than half of the way to the next.
        """
        by_half = self.half_gap[:, None] * self.radii[..., 0].square() / self.radii.sum(-1)
        least = torch.where(self.valid, by_half, torch.inf).amin(1)
        plausible = least.clamp_max(_OFFICE_GAIN) / MOST_GAIN
        return torch.where(self.gain_sigma > 0, self.gain_sigma, plausible)

    @property
    def most_gain(self) -> Float[Tensor, " T"]:
        """Largest edge gain with which codes are read, mm."""
        return MOST_GAIN * self.gain_scale


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

    def printed_radii(self, gain: Tensor) -> Tensor:
        """(N, M, 2) mm, of the markers of every row where its file states how uncertain the edge gain is, by ``gain``.

        Args:
            gain: (N,) mm, of each row.
        """
        outwards = self.table.polarity[self.target] * torch.where(self.table.gain_sigma[self.target] > 0, gain, 0.0)
        radii = self.table.radii[self.target]
        return radii + outwards[:, None, None] * radii.new_tensor([1.0, -1.0])

    @property
    def groups(self) -> int:
        """Number of frames times targets."""
        return len(self.frames) * len(self.table)

    @property
    def group(self) -> Tensor:
        """(N,) int64, frame times T plus target."""
        return self.frame * len(self.table) + self.target

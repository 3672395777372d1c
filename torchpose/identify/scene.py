"""What is known of a batch before anything in it is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either
from torchpose.geometry.least_squares import covariance_factor
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows, shared
from torchpose.grids import Grid
from torchpose.target import MIN_RATIO_GAP, Target

NOWHERE = -3.0  # inner radius of a disc over its outer one: no pixel is as far from an edge
MOST_GAIN = 3.0  # deviations of the edge gain that a file states, up to which codes are read (a convention)
# mm, of prints of which nothing is said: laser printers and copiers spread ink by 60 to 100 um
_OFFICE_GAIN = 0.1


@dataclass(frozen=True, eq=False)
class MarkerTable(Rows):
    """T targets as padded tensors of M markers.

    Attributes:
        ids: of the markers.
        centers: target frame, mm.
        normals: the same.
        radii: outer and inner, mm, as printed (`Target.printed_radii`); of a disc the inner one is `NOWHERE` times the
            outer one: its inner edge is nowhere.
        valid: False where padded.
        polarity: +1 dark rings, -1 light ones.
        coplanar: whether all markers lie in one plane.
        gain_sigma: of the edge gain, mm; 0 where the file states none.
        gain_scale: the same, or that of a plausible print where the file states none.
        half_gap: half of the least difference between two codes of each target, as ratios of radii; inf where there is
            one.
        by_print: how place (mm), turn about the place (rad) and edge gain (mm) of the markers, target frame, vary with
            each of Q numbers of unit variance, as `Target.covariance` says and those of the camera leave open.
        by_camera: the same with each of the C uncertain numbers of a camera that was calibrated together with the
            target (`Target.cross_covariance`); 0 with any other.
        scale_sigma: `Target.scale_sigma`, the last of the Q numbers where any target has one.
        layouts: of the T targets that are boards of equal marks, None for others.
    """

    ids: Int[Tensor, "T M"]
    centers: Float[Tensor, "T M 3"]
    normals: Float[Tensor, "T M 3"]
    radii: Float[Tensor, "T M 2"]
    valid: Bool[Tensor, "T M"]
    polarity: Float[Tensor, " T"]
    coplanar: Bool[Tensor, " T"]
    gain_sigma: Float[Tensor, " T"]
    gain_scale: Float[Tensor, " T"]
    half_gap: Float[Tensor, " T"]
    by_print: Float[Tensor, "T M 7 Q"]
    by_camera: Float[Tensor, "T M 7 C"]
    scale_sigma: Float[Tensor, " T"]
    layouts: tuple[Grid | None, ...] = shared(())

    @property
    def coded(self) -> Bool[Tensor, " T"]:
        """Whether the markers of each target are told apart by their codes."""
        return torch.tensor([grid is None for grid in self.layouts], dtype=torch.bool, device=self.ids.device)

    @classmethod
    def of(cls, targets: Sequence[Target], camera: Camera | None = None) -> Self:
        """Of the targets, seen by a camera if it is known."""

        def padded(rows: Sequence[Tensor], fill: float) -> Tensor:
            return torch.nn.utils.rnn.pad_sequence(list(rows), batch_first=True, padding_value=fill)

        by_print, by_camera = _by_numbers(targets, camera)
        return cls(
            padded([t.ids for t in targets], -1),
            padded([t.centers for t in targets], 0.0),
            padded([t.normals for t in targets], 0.0),
            padded([drawn_radii(t) for t in targets], 1.0),
            padded([torch.ones(len(t), dtype=torch.bool) for t in targets], False),
            torch.tensor([1.0 if t.background == "light" else -1.0 for t in targets], dtype=torch.float64),
            torch.tensor([t.coplanar for t in targets]),
            torch.stack([_gain_sigma(t) for t in targets]),
            torch.stack([_gain_scale(t) for t in targets]),
            torch.stack([_half_gap(t.printed_radii) for t in targets]),
            by_print,
            by_camera,
            torch.tensor([t.scale_sigma for t in targets], dtype=torch.float64),
            tuple(t.grid for t in targets),
        )


@checked
def drawn_radii(target: Target) -> Tensor:
    """(M, 2), see `MarkerTable.radii`."""
    outer, inner = target.printed_radii.unbind(-1)
    return torch.stack([outer, NOWHERE * outer if target.discs else inner], -1)


def _gain_sigma(target: Target) -> Tensor:
    """Standard deviation of the edge gain as the target's file states it, mm; 0 where it does not."""
    if target.covariance is None:
        return target.radii.new_zeros(())
    return target.covariance[-1, -1].clamp_min(0).sqrt()


def _gain_scale(target: Target) -> Tensor:
    """Standard deviation of the edge gain, mm: the one that is stated, or that of a plausible print.

    A print of which nothing is said is read with a gain of less than half of the way from a code to the next.
    """
    radii = target.printed_radii
    by_half = (_half_gap(radii) * radii[:, 0].square() / radii.sum(-1)).amin()
    stated = _gain_sigma(target)
    inside = torch.where(radii[:, 1] > 0, radii[:, 1], radii[:, 0])
    room = torch.minimum(inside, 0.5 * (radii[:, 0] - radii[:, 1])).amin()  # or neither hole nor ring is left
    most = torch.where(stated > 0, (MOST_GAIN * stated).minimum(0.9 * room), by_half.clamp_max(_OFFICE_GAIN))
    return most / MOST_GAIN


def _half_gap(radii: Tensor) -> Tensor:
    """Half of the least difference between two ratios of radii (M, 2); inf where there is one."""
    ratio = radii[:, 1] / radii[:, 0]
    apart = (ratio[:, None] - ratio).abs()
    return 0.5 * either(apart > 0.5 * MIN_RATIO_GAP, apart, torch.inf).amin()


def _by_numbers(targets: Sequence[Target], camera: Camera | None) -> tuple[Tensor, Tensor]:
    """`MarkerTable.by_print`, of the most directions that a covariance has, and `MarkerTable.by_camera`."""
    nothing = torch.zeros(1, 1, dtype=torch.float64)
    lens = covariance_factor(nothing if camera is None or camera.covariance is None else camera.covariance.double())
    parts = [_by_both(target, camera, lens) for target in targets]
    markers = max(map(len, targets))

    def laid_out(factors: Sequence[Tensor], numbers: int) -> Tensor:
        table = torch.zeros(len(factors), markers, 7, numbers, dtype=torch.float64)
        for of_target, factor in zip(table, factors, strict=True):
            of_target[: len(factor), :, : factor.shape[2]] = factor
        return table

    alone, together = ([part[k] for part in parts] for k in range(2))
    scaled = int(any(target.scale_sigma for target in targets))
    return laid_out(alone, max(f.shape[2] for f in alone) + scaled), laid_out(together, lens.shape[1])


def _by_both(target: Target, camera: Camera | None, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Factors (M, 7, Q) and (M, 7, C) of what is open of a target: by numbers of its own, by the camera's.

    The camera's parameters are L u, by its factor L ``lens`` (n, C), so that the target has the covariance
    S L^+T with u, S that with the parameters; what u leaves open of the target is its own.
    """
    size, covariance = 3 * len(target) + 1, target.covariance
    by_camera = torch.zeros(size, lens.shape[1], dtype=torch.float64)
    if covariance is None:
        return torch.zeros(len(target), 7, 0, dtype=torch.float64), _by_marker(by_camera)
    covariance, cross = covariance.double(), target.cross_covariance
    same = camera is not None and camera.adjustment is not None and camera.adjustment == target.adjustment
    if same and cross is not None and cross.shape[1] == len(lens):
        by_camera = cross.double() @ torch.linalg.pinv(lens).mT
        covariance = covariance - by_camera @ by_camera.mT
    return torch.cat([_by_marker(covariance_factor(covariance)), _turns(target)], -1), _by_marker(by_camera)


def _by_marker(factor: Tensor) -> Tensor:
    """Factors (M, 7, Q) of those (3 M + 1, Q) of places and edge gain: nothing is turned."""
    places = factor[:-1].unflatten(0, (-1, 3))
    return torch.cat([places, torch.zeros_like(places), factor[-1:].expand(len(places), 1, -1)], 1)


def _turns(target: Target) -> Tensor:
    """Factors (M, 7, 2 M) of the rings' turns: a plate that may be off in height is bent, and turns its rings with it.

    One that is off by s at its rim, r from its middle, has the height s (x / r)^2 and there the slope 2 s / r. Of a
    target that was measured, the turns were measured, too.
    """
    count = len(target)
    if target.covariance is None or target.adjustment is not None:
        return torch.zeros(count, 7, 0, dtype=torch.float64)
    normals = target.normals.double()
    places = target.covariance.double()[:-1, :-1].unflatten(1, (count, 3)).unflatten(0, (count, 3))
    own = places.diagonal(dim1=0, dim2=2).permute(2, 0, 1)
    height = (normals[:, None] @ own @ normals[..., None])[:, 0, 0].clamp_min(0).sqrt()
    reach = torch.linalg.vector_norm(target.centers - target.centers.mean(0), dim=-1).max()
    turn = torch.stack(plane_axes(normals), -1) * (2 * height / reach)[:, None, None]  # (M, 3, 2)
    each = torch.eye(count, dtype=torch.float64)[:, None, :, None] * turn[:, :, None]
    turned = torch.nn.functional.pad(each.flatten(-2), (0, 0, 3, 1))
    return turned[..., turned.any(0).any(0)]


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

    def stated_gain(self, gain: Tensor) -> Tensor:
        """The gains (N,) of rows whose targets' files state how uncertain the edge gain is, 0 of the others."""
        return either(self.table.gain_sigma[self.target] > 0, gain, 0.0)

    def printed_radii(self, gain: Tensor) -> Tensor:
        """(N, M, 2) mm, of the markers of every row printed with an edge gain (N,) beyond that of the file."""
        radii = self.table.radii[self.target]
        return radii + (self.table.polarity[self.target] * gain)[:, None, None] * radii.new_tensor([1.0, -1.0])

    @property
    def groups(self) -> int:
        """Number of frames times targets."""
        return len(self.frames) * len(self.table)

    @property
    def group(self) -> Tensor:
        """(N,) int64, frame times T plus target."""
        return self.frame * len(self.table) + self.target

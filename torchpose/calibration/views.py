"""What a calibration is computed from: known points seen in N views, flat."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, compress
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.calibration.robot import Robot
from torchpose.camera import Camera
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import rank_in_group

_TURNS_KNOWN = 0.02  # rad
_UNITS = (1e-3, 1e-3, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3)  # mm and rad, of about the size of a ring's deviations


@dataclass(frozen=True, eq=False)
class Rims(Rows):
    """What the grey values along both rims of K rings tell of the pose of each, fitted by itself with a camera.

    The unknowns of a ring are its place (3, mm), its turn about that (3, camera axes) and the edge gain (1, mm). Their
    chi-squared is that at the fit and d^T information d - 2 d^T pull for a change d.

    Attributes:
        R: of the frame of the target, as the ring has it; a turn about its normal tells nothing.
        t: centre of the ring, camera axes, mm, where it has the size of the file.
        gain: every edge lies outwards by so much more than in the file, mm.
        information: of the grey values alone.
        pull: of the grey values at the fit, where something else held it.
        by_camera: how the unknowns would follow the intrinsics of the camera that they were fitted with.
        cameras: these; `Views.lens` says which one each was fitted with.
    """

    R: Float[Tensor, "K 3 3"]
    t: Float[Tensor, "K 3"]
    gain: Float[Tensor, " K"]
    information: Float[Tensor, "K 7 7"]
    pull: Float[Tensor, "K 7"]
    by_camera: Float[Tensor, "K 7 n"]
    cameras: tuple[Camera, ...] = shared()

    @property
    def covariance(self) -> Float[Tensor, "K 7 7"]:
        """Of the unknowns, turns being known to a degree or so: what circles do not tell of them is not needed."""
        turns = torch.nn.functional.pad(self.t.new_full((3,), _TURNS_KNOWN**-2), (3, 1))
        return torch.linalg.inv(self.information + torch.diag(turns))

    @property
    def roots(self) -> Float[Tensor, "K 7 7"]:
        """U with U^T U = information."""
        values, vectors = torch.linalg.eigh(self._scaled(self.information))
        root = values.clamp_min(0).sqrt()[..., None] * vectors.mT
        return root / self._units

    @property
    def best(self) -> Float[Tensor, "K 7"]:
        """The change to the unknowns of least chi-squared, with turns as in `covariance`."""
        return (self.covariance @ self.pull[..., None]).squeeze(-1)

    def widened(self, px: float, depth: float, gain: float, lens: Tensor) -> Self:
        """The same with errors besides: of the centre's pixel, per axis, of the relative distance, and of the gain."""
        distance = self.t[:, 2]
        focal = torch.stack([camera.matrix.diagonal()[:2] for camera in self.cameras])
        root = torch.diag_embed(torch.nn.functional.pad(self.t.new_zeros(len(self), 6), (0, 1), value=gain))
        root[:, [0, 1], [0, 1]] = (px / focal[lens]).to(distance) * distance[:, None]
        root[:, :3, 2] = depth * self.t  # along the ray: the pixel stays
        # (A^-1 + S S^T)^-1 = A - A S (1 + S^T A S)^-1 S^T A, which needs no inverse of what is zero
        left = root.mT @ self.information
        inner = left @ root + torch.eye(7).to(root)
        right = torch.cat([left, root.mT @ self.pull[..., None]], -1)
        less = left.mT @ torch.linalg.solve(inner, right)
        information = self.information - less[..., :-1]
        return replace(self, information=0.5 * (information + information.mT), pull=self.pull - less[..., -1])

    @property
    def _units(self) -> Tensor:
        return torch.tensor(_UNITS).to(self.t)

    def _scaled(self, information: Tensor) -> Tensor:
        return information * self._units[:, None] * self._units


@dataclass(frozen=True, eq=False)
class Views(Rows):
    """K points seen in N views of one camera, or at N moments by several. Indexing selects points, `len` is N.

    Attributes:
        view: index of the view.
        point: id of the marker, or number of the board's corner.
        points: in the frame of the target, mm.
        pixels: raw (distorted) px.
        covariance: px^2; zero where it is not known, see `torchpose.calibration.intrinsics.calibrate_intrinsics`.
        names: of the N views (of the frames).
        rims: of the rings, where they were measured.
        camera: number of the camera that saw each point, where there are several.
        robot: where the robot stood at each view, where that counts.
    """

    view: Int[Tensor, " K"]
    point: Int[Tensor, " K"]
    points: Float[Tensor, "K 3"]
    pixels: Float[Tensor, "K 2"]
    covariance: Float[Tensor, "K 2 2"]
    names: tuple[str, ...] = shared()
    rims: Rims | None = None
    camera: Int[Tensor, " K"] | None = None
    robot: Robot | None = shared(None)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def lens(self) -> Int[Tensor, " K"]:
        """Number of the camera that saw each point."""
        return torch.zeros_like(self.view) if self.camera is None else self.camera

    @property
    def counts(self) -> Int[Tensor, " N"]:
        """Number of points in each view."""
        return torch.bincount(self.view, minlength=len(self))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The views of all parts."""
        names = tuple(name for part in parts for name in part.names)
        first = accumulate(map(len, parts), initial=0)
        return super().cat(
            [replace(part, names=names, view=part.view + start) for part, start in zip(parts, first, strict=False)]
        )

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The points of parts that have their N views, moments of several cameras, in common."""
        return super().cat(parts)

    def of_lens(self, number: int) -> Self:
        """What one camera has of moments, those without it left out."""
        rest = self[self.lens == number]
        return rest.of_views(rest.counts > 0)

    def of_views(self, keep: Tensor) -> Self:
        """Some of the views, a mask (N,), numbered anew."""
        rest = self[keep[self.view]]
        robot = None if self.robot is None else self.robot[keep]
        names = tuple(compress(self.names, keep.tolist()))
        return replace(rest, names=names, view=(keep.cumsum(0) - 1)[rest.view], robot=robot)

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """By view: points (N, M, 3), pixels (N, M, 2) and mask (N, M), M the most points of a view."""
        place = (self.view, rank_in_group(self.view, len(self)))
        shape = (len(self), int(self.counts.max()))

        def laid(values: Tensor) -> Tensor:
            return values.new_zeros(*shape, *values.shape[1:]).index_put(place, values)

        return laid(self.points), laid(self.pixels), laid(torch.ones_like(self.view, dtype=torch.bool))

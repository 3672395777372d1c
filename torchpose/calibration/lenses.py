"""The lenses of observations by several cameras: what each does, row by row, and the intrinsics of all as one list."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.camera.fold import growing_radius


def by_lens(
    cameras: Sequence[Camera],
    lens: Int[Tensor, " K"],
    value: Callable[[Camera, Tensor], Tensor],
    xy: Float[Tensor, "K 2"],
) -> Tensor:
    """What a function of a camera and normalised coordinates (k, 2) gives, with the camera of every row."""
    if len(cameras) == 1:
        return value(cameras[0], xy)
    rows = [(lens == number).nonzero()[:, 0] for number in range(len(cameras))]
    parts = [value(camera, xy[own]) for camera, own in zip(cameras, rows, strict=True)]
    return torch.cat(parts)[torch.cat(rows).argsort()]


def distorted(cameras: Sequence[Camera], lens: Tensor, xy: Tensor) -> Float[Tensor, "K 2"]:
    """Pixels of normalised coordinates."""
    return by_lens(cameras, lens, Camera.distort, xy)


def slopes(cameras: Sequence[Camera], lens: Tensor, xy: Tensor) -> Float[Tensor, "K 2 2"]:
    """Derivatives of pixels by normalised coordinates."""
    return by_lens(cameras, lens, Camera.J_distort, xy)


def by_all_intrinsics(cameras: Sequence[Camera], lens: Tensor, xy: Tensor) -> Float[Tensor, "K 2 n"]:
    """Derivatives of pixels by the intrinsics of all cameras, zero by those of the others."""
    first = dict(zip(map(id, cameras), starts(cameras), strict=True))
    whole = count(cameras)

    def own(camera: Camera, at: Tensor) -> Tensor:
        values, before = by_intrinsics(camera, at), first[id(camera)]
        return pad(values, (before, whole - before - values.shape[-1]))

    return by_lens(cameras, lens, own, xy)


def starts(cameras: Sequence[Camera]) -> list[int]:
    """Where the intrinsics of each camera begin in the list of all."""
    return [count(cameras[:number]) for number in range(len(cameras))]


def count(cameras: Sequence[Camera]) -> int:
    """Number of intrinsics of all cameras."""
    return sum(4 + len(camera.distortion) for camera in cameras)


def folds(cameras: Sequence[Camera], like: Tensor) -> Float[Tensor, " C"]:
    """Normalised radius up to which the lens of each may be looked through."""

    def fold(camera: Camera) -> float:
        d = camera.distortion.tolist()
        return growing_radius(np.array([*d[:2], d[4]]), np.array(d[5:])) if len(d) == 8 else camera.fold_radius

    return like.new_tensor([fold(camera) for camera in cameras])


def moved_camera(camera: Camera, step: Tensor) -> Camera | None:
    """The camera with intrinsics changed by ``step`` (n,); None where that is no camera."""
    matrix = camera.matrix.clone()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    if not bool(step.isfinite().all()) or float(matrix.diagonal()[:2].min()) <= 0:
        return None
    return replace(camera, matrix=matrix, distortion=camera.distortion + step[4:])


def moved_cameras(cameras: Sequence[Camera], step: Tensor) -> tuple[Camera, ...] | None:
    """All cameras with their intrinsics changed; None where one would be no camera."""
    parts = step.split([4 + len(camera.distortion) for camera in cameras])
    moved = [moved_camera(camera, part) for camera, part in zip(cameras, parts, strict=True)]
    there = [camera for camera in moved if camera is not None]
    return tuple(there) if len(there) == len(moved) else None


def intrinsics_between(cameras: Sequence[Camera], others: Sequence[Camera]) -> Tensor:
    """Intrinsics (n,) of cameras less those of others."""
    one, two = (torch.cat([intrinsics(camera) for camera in some]) for some in (cameras, others))
    return one - two


def intrinsics(camera: Camera) -> Tensor:
    """fx, fy, cx, cy (px) and the distortion."""
    return torch.cat([camera.matrix.diagonal()[:2], camera.matrix[:2, 2], camera.distortion])

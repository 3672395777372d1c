"""The calling convention of every solver: points in, up to S candidate poses out; and the layout they share.

Public tensors have the batch first. Inside the solvers everything is a structure of arrays with the batch last, so that
each scalar of a formula is one contiguous vector over the poses (docs/decisions/0004-pnp-layout.md). The public tensors
are permuted views of those arrays: handing them from one solver to the next copies nothing.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.errors import ArgumentError
from torchpose.geometry.arguments import one_device
from torchpose.geometry.small_linalg import det

_ROUNDING = 1e-9  # of the lengths and the determinant of a rotation in float64 (convention)


class Candidates(NamedTuple):
    """S poses for each of B sets of points in float64, best first; NaN where a solution does not exist.

    Attributes:
        R: (B, S, 3, 3), object to camera: X_cam = R X + t.
        t: (B, S, 3), in the unit of the object points.
        rms: (B, S), root mean square distance of the projections from the normalised image points.
    """

    R: Tensor
    t: Tensor
    rms: Tensor


def expect(name: str, value: Tensor, *shapes: tuple[int, ...]) -> None:
    """Raises ArgumentError where a value is no tensor of real numbers, or has none of the shapes."""
    if not isinstance(value, Tensor):
        raise ArgumentError(f"{name}: is of type {type(value).__name__}; give a tensor")
    if value.is_complex():
        raise ArgumentError(f"{name}: has dtype {value.dtype}; give real numbers")
    if value.shape not in shapes:
        raise ArgumentError(f"{name}: has shape {tuple(value.shape)}; give {' or '.join(map(str, shapes))}")


def expect_mask(mask: Tensor | None, *shapes: tuple[int, ...]) -> None:
    """Raises ArgumentError where a mask is none of bool, or has none of the shapes."""
    if mask is not None:
        expect("mask", mask, *shapes)
        if mask.dtype != torch.bool:
            raise ArgumentError(f"mask: has dtype {mask.dtype}; give bool, True where a point was seen")


def expect_pixels(image_points: Tensor) -> tuple[int, int]:
    """B and N of image points (B, N, 2)."""
    if not isinstance(image_points, Tensor) or image_points.is_complex():
        raise ArgumentError(f"image_points: is of type {type(image_points).__name__}; give a tensor of real numbers")
    if image_points.ndim != 3 or image_points.shape[-1] != 2:
        raise ArgumentError(f"image_points: has shape {tuple(image_points.shape)}; give (B, N, 2)")
    return image_points.shape[0], image_points.shape[1]


def batch_last(
    object_points: Tensor, image_points: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Object points (3, N, B) or (3, N, 1) where shared, image points (2, N, B) and weights 0 or 1 (N, B) or None.

    Points that the mask leaves out become zero, so that whatever they hold (NaN included) drops out of every sum.

    Raises:
        ArgumentError: the shapes do not fit (N, 3) or (B, N, 3), (B, N, 2) and (B, N).
    """
    batch, count = expect_pixels(image_points)
    expect("object_points", object_points, (count, 3), (batch, count, 3))
    expect_mask(mask, (batch, count))
    one_device(image_points=image_points, object_points=object_points, mask=mask)
    # closed forms square their condition numbers: float32 input is exact in float64, so is the arithmetic
    xy = image_points.double().permute(2, 1, 0).contiguous()
    points = object_points.to(xy).reshape(-1, count, 3).permute(2, 1, 0)
    if mask is None:
        return points.contiguous(), xy, None
    keep = mask.T
    return torch.where(keep, points, 0.0), torch.where(keep, xy, 0.0), keep.to(xy.dtype)


def weighted_mean(x: Tensor, weight: Tensor | None) -> Tensor:
    """Mean over the points: (k, N, B) -> (k, B), of those with weight 1."""
    return x.mean(1) if weight is None else (x * weight).sum(1) / weight.sum(0)


def rank(r: Tensor, t: Tensor, points: Tensor, xy: Tensor, weight: Tensor | None) -> Candidates:
    """Sorts poses R (3, 3, S, B), t (3, S, B) by their reprojection error.

    Those with a point behind become NaN, and those whose R is no rotation, of a method that went astray.
    """
    x, y, z = points[:, :, None]
    camera = r[:, 0, None] * x + r[:, 1, None] * y + r[:, 2, None] * z + t[:, None]  # (3, N, S, B)
    error, ahead = (camera[:2] / camera[2] - xy[:, :, None]).square().sum(0), camera[2] > 0
    if weight is not None:
        error, ahead = error * weight[:, None], ahead | (weight[:, None] == 0)
    rms = (error.mean(0) if weight is None else error.sum(0) / weight.sum(0)).sqrt()
    # of rows of length one, the determinant is 1 where they are perpendicular and right-handed, and less elsewhere
    rotation = ((r.square().sum(1) - 1).abs().amax(0) < _ROUNDING) & (det(r) > 1 - _ROUNDING)
    rms = torch.where(ahead.all(0) & rms.isfinite() & rotation, rms, torch.inf)
    if len(rms) > 1:
        rms, order = rms.sort(0)
        r, t = (v.gather(v.ndim - 2, order.expand_as(v)) for v in (r, t))
    valid = rms.isfinite()
    r, t, rms = (torch.where(valid, v, torch.nan) for v in (r, t, rms))
    return Candidates(r.permute(3, 2, 0, 1), t.permute(2, 1, 0), rms.T)

"""Stage: sub-pixel edges from Zernike moments (Ghosal and Mehrotra 1993; paper, section III-B-2).

The moments A_nm up to order 4 of the N x N window around a pixel are correlations with fixed kernels. They come as a
convolution layer for dense use, and evaluated at a list of edge pixels only (gather and one matrix product), which
gives the same numbers at a hundredth of the cost on a large frame; tests/rings/test_zernike.py shows both equal.

Model: a straight step of height k at distance l (in units of the mask radius N/2) from the pixel's centre, along the
direction phi of increasing grey. Then A'_11 = (2/3) k (1 - l^2)^(3/2) and A_20 = l A'_11.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from torchpose.errors import ArgumentError
from torchpose.geometry import blur as blurs
from torchpose.geometry.arguments import checked, expect_index, unasked
from torchpose.geometry.constants import constant
from torchpose.geometry.least_squares import solve_scaled
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import segment_sum, values_at

ORDERS = ((0, 0), (1, 1), (2, 0), (2, 2), (3, 1), (3, 3), (4, 0), (4, 2), (4, 4))
EDGE_ORDERS = ((1, 1), (2, 0))  # all that the edge position needs
MASK = 7
WIDEST = 1.3  # px, of a blur: a wider one is out of the reach of a mask of 7 px (measured: decisions/0065)
_SUBSAMPLES = 128  # of a pixel along a side (convention: the rim of the disc to 1e-5 of its area)
_ROUND = (
    0.01  # information about the blur's direction that is taken for there, in that about its size: an arc tells little
)
_HELD = ((0.0, 0.0, 0.0), (0.0, _ROUND, 0.0), (0.0, 0.0, _ROUND))
# from a mean, and what the two axes and the diagonals have more or less, to a blur, px^2
_AS_BLUR = tuple(tuple(MASK**2 / 12 * v for v in row) for row in ((1, 0, 1), (1, 0, -1), (0, 1, 0)))
_LEAST_SLOPE = 0.4  # sigma = 0.22 N; a wider blur is out of the mask's reach and stays uncorrected beyond that


Frames = Shaped[Tensor, "B H W"]
Index = Int[Tensor, " E"]
Pixels = Int[Tensor, "E 2"]


@dataclass(frozen=True, eq=False)
class Edges(Rows):
    """Sub-pixel edges, flat.

    Attributes:
        points: u, v of the edge point, px.
        normal: unit direction of increasing grey.
        offset: signed distance of the edge from the pixel's centre along the normal, px.
        step: height of the grey step.
        inside: the edge runs through its own pixel: |du| and |dv| at most 0.5 px. Where it is False the window saw an
            edge of a neighbouring pixel, or none.
    """

    points: Float[Tensor, "E 2"]
    normal: Float[Tensor, "E 2"]
    offset: Float[Tensor, " E"]
    step: Float[Tensor, " E"]
    inside: Bool[Tensor, " E"]


@lru_cache(maxsize=8)
def kernels(size: int = MASK, orders: tuple[tuple[int, int], ...] = ORDERS) -> Tensor:
    """Correlation kernels (K, N, N) float64: for each (n, m) R_nm cos(m theta) and, if m > 0, R_nm sin(m theta).

    Each weight is the integral of the Zernike function over the part of the pixel's square inside the unit disc (mask
    radius N/2), by the midpoint rule on a 128 x 128 sub-grid. Raises ValueError unless ``size`` is odd and at least 3.
    """
    if size < 3 or size % 2 == 0:
        raise ValueError(f"Zernike mask size must be odd and at least 3, not {size}")
    with torch.inference_mode(False):  # kept, and used where gradients are wanted
        return _kernels(size, orders)


def _kernels(size: int, orders: tuple[tuple[int, int], ...]) -> Tensor:
    n = size * _SUBSAMPLES
    axis = (torch.arange(n, dtype=torch.float64) + 0.5) * (2.0 / n) - 1.0
    y, x = axis[:, None], axis[None, :]
    rho2 = x * x + y * y
    rho, theta = rho2.sqrt(), torch.atan2(y, x)
    disc = (rho2 <= 1.0).double() * (2.0 / n) ** 2

    def pixel_sums(fine: Tensor) -> Tensor:
        return fine.unflatten(0, (size, -1)).unflatten(2, (size, -1)).sum((1, 3))

    planes = []
    for order, repetition in orders:
        radial = _radial_polynomial(order, repetition, rho) * disc
        for wave in (torch.cos, torch.sin)[: 2 if repetition else 1]:
            fine = radial * wave(repetition * theta)
            planes.append(pixel_sums(fine))
    kernel = torch.stack(planes)
    # all but A_00 integrate to zero; what the sub-grid misses at the rim would pass mean grey off as edge distance
    coverage = pixel_sums(disc)
    rest = kernel.sum((1, 2)) * torch.tensor([n > 0 for n, m in orders for _ in range(2 if m else 1)])
    return kernel - (rest / coverage.sum())[:, None, None] * coverage


def _radial_polynomial(n: int, m: int, rho: Tensor) -> Tensor:
    """Zernike radial polynomial R_nm."""
    out = torch.zeros_like(rho)
    for s in range((n - m) // 2 + 1):
        c = (-1) ** s * math.factorial(n - s)
        c //= math.factorial(s) * math.factorial((n + m) // 2 - s) * math.factorial((n - m) // 2 - s)
        out = out + c * rho ** (n - 2 * s)
    return out


class ZernikeMoments(nn.Module):
    """Dense Zernike moments as a convolution layer with fixed weights.

    ``forward(frames (B, 1, H, W)) -> (B, K, H - N + 1, W - N + 1)``, the channels as in `kernels`; output pixel (v, u)
    belongs to the window centred at (v + N // 2, u + N // 2).
    """

    weight: Tensor

    def __init__(
        self, size: int = MASK, orders: tuple[tuple[int, int], ...] = ORDERS, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        self.register_buffer("weight", kernels(size, orders)[:, None].to(dtype))

    def forward(self, frames: Tensor) -> Tensor:
        return nn.functional.conv2d(frames.to(self.weight.dtype), self.weight)


@checked
def moments_at(
    frames: Frames, frame: Index, pixels: Pixels, size: int = MASK, orders: tuple[tuple[int, int], ...] = EDGE_ORDERS
) -> Tensor:
    """Zernike moments (E, K) float32 of the windows at given pixels only; the columns as in `kernels`.

    Args:
        frames: (B, H, W), any real dtype, contiguous. frame: (E,) int64.
        pixels: (E, 2) int64 u, v of the window centres, at least N // 2 from the border.
    """
    height, width = frames.shape[-2:]
    half = size // 2
    _expect_inside(frames, frame, pixels, half)
    across = range(-half, half + 1)
    window = constant(tuple(row * width + column for row in across for column in across), pixels)
    base = (frame * height + pixels[:, 1]) * width + pixels[:, 0]
    values = values_at(frames, base[:, None] + window)
    # every kernel but A_00 sums to nearly zero: taking the middle grey off first keeps float32 exact to rounding
    middle = values[:, size * size // 2, None].clone()
    weight = kernels(size, orders).flatten(1).to(values)
    return values.sub_(middle) @ weight.T + middle * weight.sum(1)


def _expect_inside(frames: Tensor, frame: Tensor, pixels: Tensor, half: int) -> None:
    """Raises ArgumentError where a window leaves its frame: it would hold pixels of the next line or frame."""
    expect_index("frame", frame, len(frames))
    if pixels.numel() and not unasked():
        low, high = pixels.aminmax(dim=0)
        size = torch.tensor([frames.shape[-1], frames.shape[-2]], device=pixels.device)
        if bool((low < half).any() | (high >= size - half).any()):
            raise ArgumentError(
                f"pixels: go from {low.tolist()} to {high.tolist()} in frames of {size.tolist()}; "
                f"stay {half} px from the border, half of the window"
            )


@checked
def locate(frames: Frames, frame: Index, pixels: Pixels, size: int = MASK) -> Edges:
    """Sub-pixel edge in the window of each given pixel: phi from A_11, then l = A_20 / A'_11.

    Args:
        frames: (B, H, W) grey. frame: (E,) int64. pixels: (E, 2) int64 u, v, at least N // 2 from the border.
    """
    c, s, a20 = moments_at(frames, frame, pixels, size).T.double().unbind()
    a11 = (c * c + s * s).sqrt()
    nx, ny, length = c / a11, s / a11, a20 / a11
    offset = length * (size / 2)
    dx, dy = offset * nx, offset * ny
    step = 1.5 * a11 / (1 - length.square()).clamp_min(1e-3).pow(1.5)
    inside = (dx.abs() <= 0.5) & (dy.abs() <= 0.5)
    u, v = pixels.unbind(-1)
    return Edges(torch.stack([u + dx, v + dy]).mT, torch.stack([nx, ny]).mT, offset, step, inside)


@checked
def edge_blur(offset: Tensor, distance: Tensor, normal: Tensor, group: Tensor, count: int) -> Tensor:
    """What blur makes of small offsets, per group: its covariance (count, 3) px^2, see `geometry.blur`.

    A Gaussian-blurred edge at distance l (in mask radii) is read as l (1 - 3 s^2 / (1 - l^2)), s the blur's deviation
    across the edge in mask radii; so measured offsets over true distances have the slope 1 - 3 s^2, by direction. A
    fitted ellipse, the mean of hundreds of edges all around, stands in for the truth: errors that change sign with the
    position in the pixel average out in it. The areas of the frame's and of the kernel's pixels are in it.

    Args:
        offset: (E,) as measured. distance: (E,) from the pixel's centre to the fitted ellipse along the same normal.
        normal: (E, 2) unit. group: (E,) int64, edges of one blur.
    """
    nu, nv = normal.unbind(-1)
    # a mean, and what the two directions of an axis and their diagonals have more or less
    rows = torch.stack([torch.ones_like(nu), nu * nu - nv * nv, 2 * nu * nv], -1) * distance[:, None]
    columns = torch.cat([rows, (distance - offset)[:, None]], -1)
    sums = segment_sum((rows[:, :, None] * columns[:, None]).flatten(1), group, count).view(-1, 3, 4)
    matrix = sums[..., :3] + sums[:, :1, :1] * constant(_HELD, sums)
    loss = solve_scaled(matrix, sums[..., 3:]).squeeze(-1).nan_to_num(nan=0.0)
    return blurs.limited(loss @ constant(_AS_BLUR, loss), 0.0, (1 - _LEAST_SLOPE) * MASK**2 / 12)


@checked
def slope_across(blur: Tensor, normal: Tensor) -> Tensor:
    """Slope (E,) of measured offsets over true distances under blurs (E, 3) at edges of these normals (E, 2)."""
    return (1 - 12 / MASK**2 * blurs.across(blur, *normal.unbind(-1))).clamp(_LEAST_SLOPE, 1.0)


@checked
def deblur(offset: Tensor, slope: Tensor, size: int = MASK) -> Tensor:
    """True offsets (E,) in px from measured ones (E,) and the slope (E,) of their blur: inverts `edge_blur`'s law.

    Two fixed-point steps; the law holds to |offset| < N / 4, beyond which the curvature term is held.
    """
    radius = size / 2
    true = offset / slope
    for _ in range(2):
        l2 = (true / radius).square().clamp_max(0.25)
        true = offset / (1 - (1 - slope) / (1 - l2)).clamp_min(_LEAST_SLOPE)
    return true


@checked
def curvature_shift(blur: Tensor, normal: Tensor, size: int = MASK) -> Tensor:
    """How far edges of unit curvature are read on their convex side, px^2 (px for a curvature of 1/px).

    Derived to first order in the curvature k: the edge x = k y^2 / 2 under a Gaussian of variances s^2 across and t^2
    along it (in mask radii) has the mean offset k (y^2 + t^2) / 2, and the A_20 kernel weighs it by R_20 dy, so a
    deblurred offset is wrong by

        k / 2 (t^2 + <y^2> / <1>), with <f> = integral of R_20 f G_s(x) over the unit disc.

    The blur alone would draw a disc's edge inwards; the mask's weight on the ends of the arc pushes it out further.
    The polynomial in 1 - slope (`edge_blur`) stays within 1 % of the integral for t = s up to 1.2 px in a mask of 7.

    Args:
        blur: (E, 3) px^2. normal: (E, 2) of the edges.
    """
    q = 1 - slope_across(blur, normal)
    nu, nv = normal.unbind(-1)
    beyond = blurs.across(blur, -nv, nu) - blurs.across(blur, nu, nv)
    return (size / 2) ** 2 * (0.1 + 0.063 * q + 0.155 * q * q) + 0.5 * beyond


@lru_cache(maxsize=8)
def edge_correlation(size: int = MASK) -> float:
    """Variance inflation of means along an edge: windows of neighbouring edge pixels share their noise.

    For white pixel noise the error of l at an edge pixel is the noise correlated with the A_20 kernel, so the errors of
    a row of edge pixels have the autocorrelation of that kernel; the factor is its sum (derived; checked by Monte-Carlo
    in tests/rings/test_zernike.py).
    """
    kernel = kernels(size, EDGE_ORDERS)[-1]  # which are made anyway
    return float(kernel.sum(1).square().sum() / kernel.square().sum())

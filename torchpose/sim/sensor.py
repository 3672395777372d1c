"""What lies between the picture and the stored grey values: uneven light on the way in, noise and rounding after it."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked

GREY_MAX = 255.0  # grey levels of rendered frames, whatever the bit depth of the sensor
_GAIN_STEP = 8  # px between the points where the light is computed
_CHUNK = 1 << 16  # pairs of deviates at a time: they stay in the processor's cache


@dataclass(frozen=True)
class Lighting:
    """Uneven light as a gain of the frame, smooth in the pixels.

    The gain is applied to the blurred picture, so it is exact where it is constant over the blur. It is computed every
    8 px and interpolated linearly, which leaves some (8 px / focal length)^2 of it.

    Attributes:
        gradient: relative change of the light from the frame's centre to its right and to its lower border.
        point: position of a point light in the camera frame, mm, or None. The target's plane is lit with the inverse
            square of the distance and Lambert's cosine, relative to the target's origin; everything else as if it lay
            in that plane.
        vignetting: exponent n of the fall-off cos^n of the angle from the optical axis; 4 is the natural one.
    """

    gradient: tuple[float, float] = (0.0, 0.0)
    point: tuple[float, float, float] | None = None
    vignetting: float = 0.0

    def gain(self, camera: Camera, R: Tensor, t: Tensor) -> Tensor:
        """(B, H, W) float32 gain of every pixel, for poses (B, 3, 3), (B, 3) in mm."""
        u, v = _coarse_nodes(camera, t)
        across, down = (2 * x / max(size - 1, 1) - 1 for x, size in ((u, camera.width), (v, camera.height)))
        gain = 1 + self.gradient[0] * across + self.gradient[1] * down[:, None]
        gain = gain.expand(len(t), *gain.shape)
        if self.vignetting or self.point is not None:
            ray = coarse_rays(camera, t)
            gain = gain * ray.square().sum(-1) ** (-0.5 * self.vignetting)
        if self.point is not None:
            light = t.new_tensor(self.point)
            normal = R[:, None, None, :, 2]
            origin = t[:, None, None]
            depth = (origin * normal).sum(-1) / (ray * normal).sum(-1)
            here = _irradiance(depth[..., None] * ray, light, normal)
            gain = gain * here / _irradiance(origin, light, normal)
        return enlarged(gain.float(), camera).clamp_min(0)


def coarse_rays(camera: Camera, like: Tensor) -> Tensor:
    """(h, w, 3) rays of depth 1 of every eighth pixel, the last ones included, of the dtype and device of ``like``."""
    pixel = torch.stack(torch.meshgrid(*_coarse_nodes(camera, like), indexing="xy"), -1)
    return torch.nn.functional.pad(camera.undistort_points(pixel).nan_to_num(), (0, 1), value=1.0)


def enlarged(coarse: Tensor, camera: Camera) -> Tensor:
    """(B, H, W) of values (B, h, w) at the places of `coarse_rays`, linear between them."""
    size = (camera.height, camera.width)
    return interpolate(coarse[:, None], size=size, mode="bilinear", align_corners=True)[:, 0]


def _coarse_nodes(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (w,) and rows (h,) of the pixels of `coarse_rays`."""
    u, v = (
        torch.linspace(0, size - 1, 2 + (size - 1) // _GAIN_STEP, dtype=like.dtype, device=like.device)
        for size in (camera.width, camera.height)
    )
    return u, v


def _irradiance(x: Tensor, light: Tensor, normal: Tensor) -> Tensor:
    """Of a surface at x with the given normal, from a point light, up to a factor; 0 where it faces away."""
    to_light = light - x
    squared = to_light.square().sum(-1)
    # the printed side is the one that the normal points away from
    return (-(to_light * normal).sum(-1)).clamp_min(0) / (squared * squared.sqrt())


@checked
def add_noise(
    frames: Tensor,
    sigma: float | Tensor,
    seed: int = 0,
    *,
    index: Tensor | None = None,
    bits: int = 8,
    full_well: float | None = None,
    gamma: float | Literal["srgb"] = 1.0,
) -> Tensor:
    """Frames as the sensor delivers them: read noise, shot noise, gamma, rounding to ``bits`` bits, clipping.

    The linear model of EMVA 1288 (release 4.0, section 2): the variance of a pixel is sigma^2 + 255 grey / full_well,
    in squared grey levels. The photon count is taken as Gaussian with the mean and the variance of the Poisson
    distribution, which differs from it below some tens of electrons.

    The noise of a pixel depends on ``seed``, the frame's number and the pixel alone (a counter-based generator:
    SplitMix64 of Steele, Lea and Flood 2014 and the Box-Muller transform in float32), so it is the same in any batch.

    Args:
        frames: (B, H, W), grey levels 0..255.
        sigma: read noise in grey levels of 0..255; a number or (B,).
        seed: any integer.
        index: (B,) int64, the frames' numbers; 0 to B - 1 by default.
        bits: 1 to 16; white (255) becomes 2^bits - 1.
        full_well: electrons of a white pixel; None for a sensor without shot noise.
        gamma: stored = 255 (grey / 255)^(1 / gamma), after the noise; or the curve of sRGB.

    Returns:
        (B, H, W) uint8 for up to 8 bits, else uint16.

    Raises:
        ConfigError: ``bits`` is out of range, ``sigma`` is negative, or ``full_well`` or ``gamma`` is not above 0.
    """
    if not 1 <= bits <= 16:
        raise ConfigError(f"bits: {bits} is not a bit depth of this camera model; give 1 to 16")
    for name, value in (("full_well", full_well), ("gamma", 1.0 if gamma == "srgb" else gamma)):
        if value is not None and not value > 0:
            raise ConfigError(f"{name}: {value} is not above 0; give a positive number")
    count, height, width = frames.shape
    amplitude = torch.as_tensor(sigma, dtype=torch.float32, device=frames.device).expand(count)
    if not bool((amplitude >= 0).all()):
        raise ConfigError("sigma: the noise is negative; give 0 or more grey levels")
    key = frame_keys(count, seed, None if index is None else index.to(frames.device)).to(frames.device)
    steps = torch.arange(1, min(_CHUNK, (height * width + 1) // 2) + 1, device=frames.device) * _GOLDEN
    flat, top = frames.reshape(count, height * width), 2**bits - 1
    out = torch.empty(flat.shape, dtype=torch.uint8 if bits <= 8 else torch.uint16, device=frames.device)
    together = max(1, 2 * _CHUNK // max(1, flat.shape[1]))  # small frames share a chunk
    for a in range(0, count, together):
        rows = slice(a, a + together)
        for b in range(0, flat.shape[1], 2 * _CHUNK):
            grey = flat[rows, b : b + 2 * _CHUNK].float()
            start = key[rows] + torch.tensor(b // 2, device=key.device) * _GOLDEN
            level = _noisy(grey, _normal(start, steps, grey.shape[1]), amplitude[rows, None], full_well)
            level = toned(level, gamma)
            out[rows, b : b + 2 * _CHUNK] = level.mul_(top / GREY_MAX).round_().clamp_(0, top).to(out.dtype)
    return out.view(count, height, width)


def toned(grey: Tensor, gamma: float | Literal["srgb"]) -> Tensor:
    """Stored grey levels of linear ones, 0..255, by a power law or by the curve of sRGB (IEC 61966-2-1)."""
    if gamma == 1:
        return grey
    share = (grey / GREY_MAX).clamp_min(0)
    if gamma != "srgb":
        return share.pow(1 / gamma).mul(GREY_MAX)
    steep = 1.055 * share.clamp_min(0.0031308).pow(1 / 2.4) - 0.055
    return torch.where(share <= 0.0031308, 12.92 * share, steep).mul(GREY_MAX)


def _noisy(grey: Tensor, deviate: Tensor, sigma: Tensor, full_well: float | None) -> Tensor:
    """Grey levels with noise, in the memory of the normal deviates."""
    if full_well is None:
        return deviate.mul_(sigma).add_(grey)
    variance = grey.clamp_min(0) * (GREY_MAX / full_well) + sigma.square()
    return deviate.mul_(variance.sqrt_()).add_(grey)


def frame_keys(count: int, seed: int, index: Tensor | None = None) -> Tensor:
    """(B,) int64 keys of the chance in each frame, from its number ``index`` (B,), 0 to ``count`` - 1 by default."""
    number = torch.arange(count) if index is None else index
    return _mix64(_mix64(torch.full_like(number, seed % 2**62)) + number)


def normal_deviates(key: Tensor, count: int) -> Tensor:
    """(B, count) float32 normal deviates of the keys (B,) of `frame_keys`."""
    return _normal(key, torch.arange(1, (count + 1) // 2 + 1, device=key.device) * _GOLDEN, count)


def _normal(start: Tensor, steps: Tensor, count: int) -> Tensor:
    """(B, count) float32 normal deviates, two for each counter ``start`` (B,) + ``steps`` (>= count / 2,)."""
    pairs = (count + 1) // 2
    bits = _scramble(start[:, None] + steps[:pairs])
    radius = (bits & 0xFFFFFFFF).float().add_(0.5).mul_(2.0**-32).log_().mul_(-2).sqrt_()
    angle = bits.bitwise_right_shift_(32).float().add_(0.5).mul_(2 * math.pi * 2.0**-32)
    out = torch.empty(len(start), pairs, 2, device=start.device)
    torch.mul(radius, angle.cos(), out=out[..., 0])
    torch.mul(radius, angle.sin_(), out=out[..., 1])
    return out.flatten(1)[:, :count]


_GOLDEN = 0x9E3779B97F4A7C15 - 2**64


def _mix64(x: Tensor) -> Tensor:
    """SplitMix64 of the counters x, int64, which wraps around as the unsigned type does."""
    return _scramble(x + _GOLDEN)


def _scramble(x: Tensor) -> Tensor:
    """Output function of SplitMix64, in place."""
    x.bitwise_xor_((x >> 30).bitwise_and_(2**34 - 1)).mul_(0xBF58476D1CE4E5B9 - 2**64)
    x.bitwise_xor_((x >> 27).bitwise_and_(2**37 - 1)).mul_(0x94D049BB133111EB - 2**64)
    return x.bitwise_xor_((x >> 31).bitwise_and_(2**33 - 1))

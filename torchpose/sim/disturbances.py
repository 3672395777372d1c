"""What lenses, air and lamps do to the picture, and sensors before they are read out.

All of it acts on rendered frames (B, H, W) of grey levels 0..255. Blur and displacement are multiplications in the
frequency domain, which is exact for pictures without content beyond the Nyquist frequency: of an edge with a Gaussian
blur of 0.7 px it is half a percent, of one with 1 px 2e-4. Chance comes from keys, see `torchpose.sim.fields`.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.geometry.arguments import checked
from torchpose.geometry.rows import Rows, shared
from torchpose.sim.fields import keys_of, smooth_field, uniform
from torchpose.sim.sensor import normal_deviates

_PAD = 16  # px on every side, mirrored: what is blurred or moved by a few px does not come round from the other side
# the comatic spot: Gaussians along a line, shares, distances and deviations in its length (convention)
COMA = ((0.6, 0.0, 0.0), (0.28, 0.5, 0.2), (0.12, 1.0, 0.35))
_TAYLOR = 4  # order in the displacement: 0.4 px leave less than 1 % of the contrast at the Nyquist frequency


@dataclass(frozen=True, eq=False)
class Disturbances(Rows):
    """Of B frames; 0 stands for none.

    Attributes:
        coma_px: length of the tail of a comatic spot, whose centroid stays in place.
        coma_deg: its direction, from u towards v.
        haze_px: RMS of the displacement along u, and along v, by hot air.
        ghost: grey levels of a window's reflection that lies over the frame.
        speckle: contrast of laser speckle, standard deviation over mean.
        flicker: depth of the light's modulation along the rows, of its mean.
        haze_length: px, the distance at which the displacement's autocorrelation has fallen to 1/e.
        speckle_px: the same for the speckle's field.
        flicker_px: period in rows.
        seed: of chance.
    """

    coma_px: Float[Tensor, " B"]
    coma_deg: Float[Tensor, " B"]
    haze_px: Float[Tensor, " B"]
    ghost: Float[Tensor, " B"]
    speckle: Float[Tensor, " B"]
    flicker: Float[Tensor, " B"]
    haze_length: float = shared(40.0)
    speckle_px: float = shared(3.0)
    flicker_px: float = shared(90.0)
    seed: int = shared(0)

    @classmethod
    def of(cls, count: int, *, seed: int = 0, **given: float) -> Self:
        """The same for ``count`` frames, with the fields that are given."""
        rows = {f.name: given.get(f.name, 0.0) for f in fields(cls) if not f.metadata.get("shared")}
        each: dict[str, Any] = {n: torch.full((count,), v, dtype=torch.float64) for n, v in rows.items()}
        return cls(**{**given, **each}, seed=seed)


@dataclass(frozen=True)
class SensorPattern:
    """What a sensor does to every frame alike, and the jitter of its lines.

    Attributes:
        prnu: photo response non-uniformity, standard deviation of the pixels' gains of 1 (EMVA 1288), white.
        column_noise: standard deviation of the columns' offsets in grey levels, the same in all frames.
        line_jitter: px, standard deviation of the displacement along u of every line, anew in every frame.
        seed: of the sensor.
    """

    prnu: float = 0.0
    column_noise: float = 0.0
    line_jitter: float = 0.0
    seed: int = 0


@checked
def disturbed(
    frames: Float[Tensor, "B H W"], what: Disturbances, index: Int[Tensor, " B"] | None = None
) -> Float[Tensor, "B H W"]:
    """Frames with all disturbances, in the order of the light: lamp, surface, air, lens; ``index``: their numbers."""

    def keys(purpose: str) -> Tensor:
        return keys_of(len(frames), what.seed, purpose, index)

    if bool(what.flicker.any()):
        frames = frames * flicker(what.flicker, what.flicker_px, frames.shape[1], keys("flicker"))
    if bool(what.speckle.any()):
        frames = frames * speckle(what.speckle, what.speckle_px, (frames.shape[1], frames.shape[2]), keys("speckle"))
    if bool(what.haze_px.any()):
        size = (frames.shape[1], frames.shape[2])
        field = torch.stack([smooth_field(keys(name), size, what.haze_length) for name in ("air-u", "air-v")], -1)
        frames = displaced(frames, what.haze_px.to(field)[:, None, None, None] * field)
    if bool(what.ghost.any()):
        frames = frames + what.ghost.to(frames)[:, None, None] * window(frames, keys("ghost"))
    if bool(what.coma_px.any()):
        frames = coma(frames, what.coma_px, what.coma_deg.deg2rad())
    return frames


@checked
def read_out(
    frames: Float[Tensor, "B H W"], pattern: SensorPattern, seed: int, index: Int[Tensor, " B"] | None = None
) -> Float[Tensor, "B H W"]:
    """Frames with the patterns of the sensor, before its noise; ``seed`` and ``index`` are those of the frames."""
    count, height, width = frames.shape
    own = keys_of(1, pattern.seed, "sensor").to(frames.device)
    if pattern.prnu:
        frames = frames * (1 + pattern.prnu * normal_deviates(own, height * width).view(1, height, width))
    if pattern.line_jitter:
        shift = pattern.line_jitter * normal_deviates(keys_of(count, seed, "lines", index).to(frames.device), height)
        frames = lines_moved(frames, shift)
    if pattern.column_noise:
        frames = frames + pattern.column_noise * normal_deviates(own + 1, width)[:, None]
    return frames


def coma(
    frames: Float[Tensor, "B H W"], length: Float[Tensor, " B"], direction: Float[Tensor, " B"]
) -> Float[Tensor, "B H W"]:
    """Blurred by a sharp head with a wider, fainter tail of a length (px) in a direction (rad); the centroid stays."""
    spectrum, u, v = _spectrum(frames)
    along = direction.cos()[:, None, None] * u + direction.sin()[:, None, None] * v
    size = length[:, None, None]
    middle = sum(share * place for share, place, _ in COMA)
    way = torch.zeros((), dtype=torch.complex128, device=frames.device)
    for share, place, width in COMA:
        damped = (-2 * (math.pi * width * size) ** 2 * (u * u + v * v)).exp()
        way = way + share * torch.polar(damped, -2 * math.pi * (place - middle) * size * along)
    return _picture(spectrum * way.to(spectrum), frames)


def displaced(frames: Float[Tensor, "B H W"], shift: Float[Tensor, "B H W 2"]) -> Float[Tensor, "B H W"]:
    """Frames whose picture lies ``shift`` px (u, v) further, which changes slowly from pixel to pixel; up to 0.5 px.

    The grey value at p is that of the picture at p - shift(p), by a Taylor series of spectral derivatives.
    """
    spectrum, u, v = _spectrum(frames)
    du, dv = -shift[..., 0], -shift[..., 1]
    total = frames
    for order in range(1, _TAYLOR + 1):
        for by_v in range(order + 1):
            by_u = order - by_v
            way = (2j * math.pi * u) ** by_u * (2j * math.pi * v) ** by_v
            term = _picture(spectrum * way.to(spectrum), frames)
            total = total + du**by_u * dv**by_v / (math.factorial(by_u) * math.factorial(by_v)) * term
    return total


def lines_moved(frames: Float[Tensor, "B H W"], shift: Float[Tensor, "B H"]) -> Float[Tensor, "B H W"]:
    """Frames whose lines lie ``shift`` px further along u, by the shift theorem."""
    width = frames.shape[2]
    wide = pad(frames, (_PAD, _PAD), mode="reflect")
    frequency = torch.fft.rfftfreq(wide.shape[2], device=frames.device)
    turn = torch.polar(torch.ones_like(shift)[..., None], -2 * math.pi * shift[..., None] * frequency)
    return torch.fft.irfft(torch.fft.rfft(wide) * turn, n=wide.shape[2])[..., _PAD : _PAD + width]


def flicker(depth: Float[Tensor, " B"], period: float, rows: int, key: Int[Tensor, " B"]) -> Float[Tensor, "B H 1"]:
    """Gain of the rows under a lamp that is modulated as a sine: a rolling shutter meets it row after row."""
    phase = 2 * math.pi * (uniform(key, 1) + torch.arange(rows, dtype=torch.float64, device=key.device) / period)
    return (1 + depth[:, None] * phase.sin()).float()[..., None]


def speckle(
    contrast: Float[Tensor, " B"], length: float, size: tuple[int, int], key: Int[Tensor, " B"]
) -> Float[Tensor, "B H W"]:
    """Gain of mean 1 and of a contrast up to 1, from an intensity with the exponential distribution (Goodman 2007).

    Its autocovariance at the distance d is contrast^2 exp(-2 (d / length)^2).
    """
    parts = [smooth_field(key + number, size, length).square() for number in (0, 1)]
    return 1 + contrast.float()[:, None, None] * ((parts[0] + parts[1]) / 2 - 1)


def window(frames: Float[Tensor, "B H W"], key: Int[Tensor, " B"]) -> Float[Tensor, "B H W"]:
    """The reflection of a window of two by two panes, 0 to 1, out of focus, of a random place, size and turn."""
    _, height, width = frames.shape
    chance = uniform(key, 4).float()[:, :, None, None]
    turn, size = 0.6 * (chance[:, 2] - 0.5), height * (0.35 + 0.25 * chance[:, 3])
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    du = u.to(frames) - width * (0.35 + 0.3 * chance[:, 0])
    dv = v.to(frames) - height * (0.35 + 0.3 * chance[:, 1])
    x, y = turn.cos() * du + turn.sin() * dv, turn.cos() * dv - turn.sin() * du
    soft, bar = 3.0, 0.06 * size  # px of its edges: the panes lie far behind the target

    def inside(a: Tensor) -> Tensor:
        frame = ((size / 2 - a.abs()) / soft).sigmoid()
        return frame * ((a.abs() - bar / 2) / soft).sigmoid()

    return inside(x) * inside(y)


def _spectrum(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Spectrum of the frames with a mirrored margin, and its frequencies along u and v, cycles a px, float64."""
    wide = pad(frames[:, None], (_PAD,) * 4, mode="reflect")[:, 0]
    u = torch.fft.rfftfreq(wide.shape[2], dtype=torch.float64, device=frames.device)
    v = torch.fft.fftfreq(wide.shape[1], dtype=torch.float64, device=frames.device)[:, None]
    return torch.fft.rfft2(wide), u, v


def _picture(spectrum: Tensor, like: Tensor) -> Tensor:
    """Frames (B, H, W) of a spectrum of `_spectrum`."""
    _, height, width = like.shape
    wide = torch.fft.irfft2(spectrum, s=(height + 2 * _PAD, width + 2 * _PAD))
    return wide[:, _PAD : _PAD + height, _PAD : _PAD + width]

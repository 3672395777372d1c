"""Corruptions of simulated frames in the manner of ImageNet-C (Hendrycks, Dietterich 2019), for the scripts beside it.

A frame is made in three stages, and a corruption belongs to one of them: ``scene`` changes what is drawn and how the
sensor works, ``light`` the noise-free picture that falls on it, ``file`` the grey values that it delivered. Everything
random depends on the seed and on the frame's number alone, so that one view meets every corruption.

Blur is exact for pictures without content beyond the Nyquist frequency: the picture, rendered with a Gaussian of
`BASE_PSF` px, is multiplied by the transfer function of the kernel, not by samples of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
import skimage.data
import torch
from torch import Tensor

import torchpose as tp
from torchpose.geometry import rotations
from torchpose.sim import add_noise, disturbances, render, shapes
from torchpose.sim.disturbances import COMA, lines_moved
from torchpose.sim.shapes import Shapes

F64 = torch.float64
DARK, LIGHT, SURROUND, NOISE = 30.0, 220.0, 90.0, 2.0  # grey levels of the sample frames
PLATE_MM = 70.0
PSF = 0.7  # px, of every frame that no corruption blurs
BASE_PSF = 0.5  # px, below a kernel; its aliases are below 2 % of an edge
WHITE = 255.0
# pictures that scikit-image brings along, one after the other over the frames
PHOTOGRAPHS = (
    "camera", "coffee", "chelsea", "rocket", "astronaut", "coins", "brick", "grass", "page", "text", "moon", "gravel",
)  # fmt: skip
# distances in mm, and the lateral room in mm, at which the whole plate is in view
DISTANCES = {"sample": (145.0, 185.0, 25.0, 12.0), "small": (300.0, 480.0, 80.0, 45.0)}

SCENE = {"dark": DARK, "light": LIGHT, "plate": (PLATE_MM, PLATE_MM)}  # options of `render`

Background = Literal["none", "photo"]
Way = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Transfer function (H, W) complex or real at frequencies u (W,) and v (H, 1), cycles a px."""


@dataclass(frozen=True)
class Blur:
    """A point-spread function beside the pixel's square: a Gaussian of the covariance px^2, convolved with a box along
    the line ``smear`` (px) and with a disc of the radius ``disc`` (px).
    """

    covariance: tuple[float, float, float] = (PSF * PSF, 0.0, PSF * PSF)  # uu, uv, vv
    smear: tuple[float, float] = (0.0, 0.0)
    disc: float = 0.0

    @property
    def sigma(self) -> float:
        """Deviation in px of the isotropic Gaussian of the same mean variance."""
        own = 0.5 * (self.covariance[0] + self.covariance[2])
        return math.sqrt(own + (self.smear[0] ** 2 + self.smear[1] ** 2) / 24 + self.disc**2 / 4)

    def imaging(self) -> dict[str, Any]:
        """Options of `torchpose.sim.render` and of the bound."""
        uu, uv, vv = self.covariance
        options: dict[str, Any] = {"psf_sigma": torch.tensor([[uu, uv], [uv, vv]], dtype=F64), "disc": self.disc}
        return options | ({"smear": torch.tensor(self.smear, dtype=F64)} if any(self.smear) else {})


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame on its way from the scene to the file.

    Attributes:
        camera, target, R, t: the view, with R (3, 3) and t (3,) float64; shapes in place of a target where no
            corruption asks for its rings.
        rng: chance of this frame.
        imaging: options of `torchpose.sim.render`.
        sensor: options of `torchpose.sim.add_noise`.
        blur: what the bound is computed with.
        contrast: grey levels between paper and ring, as light has changed it.
        picture: (H, W) float32 before noise, or the grey values of the file.
    """

    camera: tp.Camera
    target: Any
    R: Tensor
    t: Tensor
    rng: np.random.Generator
    imaging: dict[str, Any]
    sensor: dict[str, Any] = field(default_factory=lambda: {"sigma": NOISE})
    blur: Blur = Blur()
    contrast: float = LIGHT - DARK
    picture: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame."""
        return self.camera.width, self.camera.height

    def drawn(self, **imaging: Any) -> Shot:
        return replace(self, imaging=self.imaging | imaging)

    def seen(self, picture: np.ndarray, contrast: float | None = None) -> Shot:
        return replace(self, picture=picture, contrast=self.contrast if contrast is None else contrast)

    def lit(self, gain: np.ndarray) -> Shot:
        """The shot under light (H, W) that is not the same everywhere; the contrast is RMS over the rings."""
        at = self.ring_places()[0].round().astype(int).clip(0, np.array(self.size) - 1)
        there = math.sqrt(np.square(gain[at[:, 1], at[:, 0]]).mean())
        return self.seen(self.picture * gain, self.contrast * there)

    def ring_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (M, 2) and outer radii (M,) of the rings in px."""
        points = (self.R @ self.target.centers[..., None]).squeeze(-1) + self.t
        radius = self.camera.matrix[0, 0] * self.target.radii[:, 0] / points[:, 2]
        return self.camera.project(points).numpy(), radius.numpy()


@dataclass(frozen=True)
class Corruption:
    """A row of the matrix.

    Attributes:
        stage: at which of the three stages it acts.
        values: its severities, from mild to severe.
        apply: a shot and a severity to the corrupted shot.
        unseen: severities at which a person does not see the small rings any more; a line is not counted there.
        hidden: the geometry hides the fault, which no estimator from one frame can see.
        own_background: it draws its own surroundings, so that it comes without photographs.
        psf: Gaussian blur in px of the picture that it acts on.
    """

    stage: Literal["scene", "light", "file"]
    values: tuple[float, ...] | tuple[tuple[float, float], ...]
    apply: Callable[[Shot, Any], Shot]
    unseen: tuple[float, ...] = ()
    hidden: bool = False
    own_background: bool = False
    psf: float = PSF

    def visible(self, value: float | tuple[float, float], kind: str) -> bool:
        """Whether a person still sees the rings."""
        return not (kind == "small" and value in self.unseen)


def severity(value: float | tuple[float, float]) -> str:
    """As it stands in tables."""
    return " x ".join(f"{v:g}" for v in value) if isinstance(value, tuple) else f"{value:g}"


def view(number: int, seed: int, camera: tp.Camera, kind: str, background: Background) -> Shot:
    """The view of a frame: tilt to 40 degrees, any roll, the plate before grey or before a photograph."""
    rng = np.random.default_rng([seed, number])
    near, far, across, down = DISTANCES[kind]
    turn = tilted(math.radians(rng.uniform(0, 40)), *rng.uniform(0, 2 * math.pi, 2))
    place = torch.tensor([rng.uniform(-across, across), rng.uniform(-down, down), rng.uniform(near, far)], dtype=F64)
    around = photograph(number, camera) if background == "photo" else even(camera)
    return Shot(camera, tp.Target.load("quad40"), turn, place, rng, SCENE | {"surround": around})


def tilted(lean: float, azimuth: float, roll: float) -> Tensor:
    """Rotation (3, 3) of a plate rolled about its normal, then tilted about an axis of that azimuth; rad."""
    twist = torch.tensor([[lean * math.cos(azimuth), lean * math.sin(azimuth), 0.0], [0.0, 0.0, roll]], dtype=F64)
    turn = rotations.exp(twist)
    return turn[0] @ turn[1]


def shoot(shot: Shot, corruption: Corruption, value: Any, seed: int) -> tuple[Shot, Tensor]:
    """The corrupted shot and its frame (H, W) uint8."""
    if corruption.stage == "scene":
        shot = corruption.apply(shot, value)
    around = torch.from_numpy(np.ascontiguousarray(shot.imaging["surround"]))[None]
    imaging = shot.imaging | {"surround": around, "psf_sigma": corruption.psf}
    shot = shot.seen(render(shot.camera, shot.target, shot.R[None], shot.t[None], **imaging)[0].numpy())
    if corruption.stage == "light":
        shot = corruption.apply(shot, value)
    noisy = add_noise(torch.from_numpy(shot.picture.astype(np.float32))[None], seed=seed, **shot.sensor)[0]
    bits = shot.sensor.get("bits", 8)
    shot = shot.seen(np.round(noisy.numpy() * (WHITE / (2**bits - 1))).astype(np.uint8))
    if corruption.stage == "file":
        shot = corruption.apply(shot, value)
    return shot, torch.from_numpy(np.ascontiguousarray(shot.picture))


# surroundings, (H, W) float32


def even(camera: tp.Camera) -> np.ndarray:
    return np.full((camera.height, camera.width), SURROUND, np.float32)


def photograph(number: int, camera: tp.Camera) -> np.ndarray:
    """One of `PHOTOGRAPHS`, enlarged to the frame."""
    picture = getattr(skimage.data, PHOTOGRAPHS[number % len(PHOTOGRAPHS)])()
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return cv2.resize(picture, (camera.width, camera.height)).astype(np.float32)


def discs(shot: Shot, count: float) -> Shot:
    """Discs of 4 to 20 px radius everywhere around the plate."""
    return _spots(shot, int(count), 4.0, 20.0)


def specks(shot: Shot, count: float) -> Shot:
    """Specks of 0.7 to 2 px radius everywhere around the plate."""
    return _spots(shot, int(count), 0.7, 2.0)


def _spots(shot: Shot, count: int, least: float, most: float) -> Shot:
    around, parts = shot.imaging["surround"].copy(), 16  # cv2 counts in sixteenths of a pixel
    for x, y, r, grey in shot.rng.uniform([0, 0, least, 10], [*shot.size, most, 240], (count, 4)):
        place = (round(x * parts), round(y * parts))
        cv2.circle(around, place, round(r * parts), grey, -1, cv2.LINE_8, 4)
    return shot.drawn(surround=cv2.GaussianBlur(around, (0, 0), PSF))


def page_of_text(shot: Shot, scale: float) -> Shot:
    """A page of print, magnified, again and again."""
    page = cv2.resize(skimage.data.page(), None, fx=scale, fy=scale)
    times = [-(-size // have) for size, have in zip(shot.size[::-1], page.shape, strict=True)]
    return shot.drawn(surround=np.tile(page, times)[: shot.size[1], : shot.size[0]].astype(np.float32))


def checkers(shot: Shot, side: float) -> Shot:
    """Squares of that side in px."""
    u, v = _grid(shot)
    return shot.drawn(surround=np.where((u // side + v // side) % 2 == 0, 40.0, 210.0).astype(np.float32))


def moire(shot: Shot, period: float) -> Shot:
    """Two gratings over each other, of that period in px and a tenth more, 7 degrees apart."""
    u, v = _grid(shot)
    first = np.cos(2 * math.pi / period * u)
    second = np.cos(2 * math.pi / (1.1 * period) * (u * math.cos(0.12) + v * math.sin(0.12)))
    return shot.drawn(surround=(125 + 45 * first + 45 * second).astype(np.float32))


def _grid(shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates u (1, W) and v (H, 1)."""
    return np.arange(shot.size[0], dtype=np.float32)[None], np.arange(shot.size[1], dtype=np.float32)[:, None]


# what lies on the plate


def dust(shot: Shot, count: float) -> Shot:
    """Grains of 0.1 to 0.5 mm radius."""
    return shot.drawn(covers=_grains(shot.rng, int(count), 0.1, 0.5))


def drops(shot: Shot, count: float) -> Shot:
    """Drops of 0.5 to 2 mm radius."""
    return shot.drawn(covers=_grains(shot.rng, int(count), 0.5, 2.0))


def _grains(rng: np.random.Generator, count: int, least: float, most: float) -> Shapes:
    """Discs that do not touch, each in a cell of a lattice over the plate."""
    cell = 2.05 * most
    places = np.stack(np.meshgrid(*[np.arange(-0.5 * (PLATE_MM - cell), 0.5 * PLATE_MM, cell)] * 2), -1).reshape(-1, 2)
    out = []
    for place in rng.permutation(places)[:count]:
        radius = rng.uniform(least, most)
        at = place + rng.uniform(-1, 1, 2) * (most - radius)
        out.append(shapes.ring(at.tolist(), radius, level=float(rng.uniform(10, 240))))
    return shapes.cat(out)


def wires(shot: Shot, count: float) -> Shot:
    """Parallel wires of 0.35 mm over every ring."""
    out = []
    for (x, y, _), (radius, _) in zip(shot.target.centers.tolist(), shot.target.radii.tolist(), strict=True):
        turn, level = shot.rng.uniform(0, 2 * math.pi), float(shot.rng.uniform(10, 160))
        for step in (np.arange(count) - (count - 1) / 2 + shot.rng.uniform(-0.3, 0.3)) * (1.6 * radius / max(count, 2)):
            at = (x - step * math.sin(turn), y + step * math.cos(turn))
            out.append(shapes.rectangle(at, 2.6 * radius, 0.35, turn, level))
    return shot.drawn(covers=shapes.cat(out))


def cover(shot: Shot, share: float) -> Shot:
    """A strip over that share of the perimeter of every ring."""
    out = []
    for (x, y, _), (radius, _) in zip(shot.target.centers.tolist(), shot.target.radii.tolist(), strict=True):
        near, turn = radius * math.cos(math.pi * share), shot.rng.uniform(0, 2 * math.pi)
        middle = 0.5 * (near + 1.25 * radius)
        at = (x + middle * math.cos(turn), y + middle * math.sin(turn))
        level = float(shot.rng.uniform(20, 200))
        out.append(shapes.rectangle(at, 1.25 * radius - near, 2.1 * radius, turn, level))
    return shot.drawn(covers=shapes.cat(out))


# blur


def gaussian(shot: Shot, sigma: float) -> Shot:
    return elliptic(shot, (sigma, sigma))


def elliptic(shot: Shot, sigmas: tuple[float, float]) -> Shot:
    """A Gaussian of these deviations in px along two axes, the first in a random direction."""
    turn = shot.rng.uniform(0, math.pi)
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    total = axes.T @ np.diag(np.square(sigmas)) @ axes
    kernel = total - BASE_PSF**2 * np.eye(2)

    def way(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.exp(-2 * math.pi**2 * (kernel[0, 0] * u * u + 2 * kernel[0, 1] * u * v + kernel[1, 1] * v * v))

    return blurred(shot, way, Blur((total[0, 0], total[0, 1], total[1, 1])))


def motion(shot: Shot, length: float) -> Shot:
    """A box of that length in px along a random direction."""
    turn = shot.rng.uniform(0, math.pi)
    a, b = length * math.cos(turn), length * math.sin(turn)
    return blurred(shot, lambda u, v: np.sinc(a * u + b * v), Blur(_BASE, smear=(a, b)))


def defocus(shot: Shot, radius: float) -> Shot:
    """A disc of that radius in px."""
    from scipy.special import j1

    def way(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x = 2 * math.pi * radius * np.hypot(u, v).clip(1e-9)
        return 2 * j1(x) / x

    return blurred(shot, way, Blur(_BASE, disc=radius))


def coma(shot: Shot, length: float) -> Shot:
    """A head and a fainter, wider tail in a random direction, of that length in px; its centroid stays in place."""
    turn = shot.rng.uniform(0, 2 * math.pi)
    share, along, width = np.array(COMA).T * np.array([[1.0], [length], [length]])
    frame = torch.from_numpy(shot.picture)[None]
    through = disturbances.coma(frame, torch.tensor([length], dtype=F64), torch.tensor([turn], dtype=F64))[0].numpy()
    spread, tail = float(share @ width**2), float(share @ along**2 - (share @ along) ** 2)
    cos, sin = math.cos(turn), math.sin(turn)
    own = BASE_PSF**2 + spread
    blur = Blur((own + tail * cos * cos, tail * cos * sin, own + tail * sin * sin))
    return replace(shot.seen(through), blur=blur)


_BASE = (BASE_PSF**2, 0.0, BASE_PSF**2)


def blurred(shot: Shot, way: Way, blur: Blur) -> Shot:
    """The shot with its picture, which was rendered with `BASE_PSF`, through a kernel of that transfer function."""
    reach = math.ceil(4 * blur.sigma) + 8
    wide = np.pad(shot.picture, reach, mode="reflect")
    u, v = np.fft.rfftfreq(wide.shape[1])[None], np.fft.fftfreq(wide.shape[0])[:, None]
    spectrum = torch.fft.rfft2(torch.from_numpy(wide)) * torch.from_numpy(way(u, v)).to(torch.complex64)
    through = torch.fft.irfft2(spectrum, s=wide.shape).numpy()[reach:-reach, reach:-reach]
    return replace(shot.seen(through), blur=blur)


# light


def haze(shot: Shot, share: float) -> Shot:
    """That share of the light comes from the haze."""
    return shot.seen(shot.picture * (1 - share) + 200 * share, shot.contrast * (1 - share))


def low_contrast(shot: Shot, share: float) -> Shot:
    """Paper and ring apart by that share of the range."""
    contrast = share * WHITE
    return shot.seen(125 + (shot.picture - 125) * (contrast / (LIGHT - DARK)), contrast)


def exposure(shot: Shot, gain: float) -> Shot:
    return shot.seen(shot.picture * gain, shot.contrast * gain)


def shadow(shot: Shot, left: float) -> Shot:
    """A shadow's edge across the plate, 4 px wide, behind which that share of the light is left."""
    (u, v), turn = _grid(shot), shot.rng.uniform(0, 2 * math.pi)
    at = shot.ring_places()[0].mean(0)
    across = (u - at[0]) * math.cos(turn) + (v - at[1]) * math.sin(turn)
    return shot.lit(left + (1 - left) / (1 + np.exp(-across.clip(-80, 80))))


def highlight(shot: Shot, amplitude: float) -> Shot:
    """A glare on the edge of every ring, of that amplitude in whites."""
    (u, v), glare = _grid(shot), np.zeros_like(shot.picture)
    for at, radius in zip(*shot.ring_places(), strict=True):
        turn, size = shot.rng.uniform(0, 2 * math.pi), 0.25 * radius
        x, y = at + radius * np.array([math.cos(turn), math.sin(turn)])
        glare += np.exp(-((u - x) ** 2) / (2 * size**2)) * np.exp(-((v - y) ** 2) / (2 * size**2))
    return shot.seen(shot.picture + WHITE * amplitude * glare)


def light_gradient(shot: Shot, ratio: float) -> Shot:
    """Light that falls by this ratio across the frame."""
    (u, v), turn = _grid(shot), shot.rng.uniform(0, 2 * math.pi)
    x = (u / shot.size[0] - 0.5) * math.cos(turn) + (v / shot.size[1] - 0.5) * math.sin(turn)
    return shot.lit(ratio ** -(x + 0.5))


def vignetting(shot: Shot, power: float) -> Shot:
    """Fall-off with that power of the cosine of the angle from the axis."""
    (u, v), (width, height) = _grid(shot), shot.size
    squared = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / float(shot.camera.matrix[0, 0]) ** 2
    return shot.lit((1 + squared) ** (-power / 2))


def banding(shot: Shot, sigma: float) -> Shot:
    """Columns with offsets of that deviation in grey levels."""
    return shot.seen(shot.picture + shot.rng.normal(0, sigma, shot.size[0])[None].astype(np.float32))


def rolling_shutter(shot: Shot, shift: float) -> Shot:
    """Rows displaced along u, by this many px more at the last than at the first one."""
    return _rows_moved(shot, shift * (np.arange(shot.size[1]) / (shot.size[1] - 1) - 0.5))


def interlacing(shot: Shot, shift: float) -> Shot:
    """Odd lines displaced against even ones by this many px along u, about the true place."""
    return _rows_moved(shot, shift * (np.arange(shot.size[1]) % 2 - 0.5))


def _rows_moved(shot: Shot, offset: np.ndarray) -> Shot:
    """Every row displaced along u by its offset (H,) in px."""
    moved = lines_moved(torch.from_numpy(shot.picture)[None].double(), torch.from_numpy(offset)[None])
    return shot.seen(moved[0].numpy().astype(np.float32))


# sensor


def noise(shot: Shot, sigma: float) -> Shot:
    return replace(shot, sensor=shot.sensor | {"sigma": sigma})


def shot_noise(shot: Shot, full_well: float) -> Shot:
    """Electrons of a white pixel."""
    return replace(shot, sensor=shot.sensor | {"full_well": full_well})


def coarse_grey(shot: Shot, bits: float) -> Shot:
    return replace(shot, sensor=shot.sensor | {"bits": int(bits)})


def tone_curve(shot: Shot, gamma: float) -> Shot:
    """Stored grey is the power 1 / gamma of the light."""
    return replace(shot, sensor=shot.sensor | {"gamma": gamma})


# file


def dead_pixels(shot: Shot, share: float) -> Shot:
    """That share of the pixels is black or white."""
    chance = shot.rng.random(shot.picture.shape)
    return shot.seen(np.where(chance < share, np.where(chance < share / 2, 0, 255), shot.picture).astype(np.uint8))


def jpeg(shot: Shot, quality: float) -> Shot:
    code = cv2.imencode(".jpg", shot.picture, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])[1]
    return shot.seen(np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)))


def rescaling(shot: Shot, factor: float) -> Shot:
    """Reduced by area means, enlarged again bilinearly."""
    less = (round(factor * shot.size[0]), round(factor * shot.size[1]))  # the same ratios both ways: nothing moves
    small = cv2.resize(shot.picture, less, interpolation=cv2.INTER_AREA)
    return shot.seen(np.asarray(cv2.resize(small, shot.size, interpolation=cv2.INTER_LINEAR)))


def sharpening(shot: Shot, amount: float) -> Shot:
    """Unsharp mask of 1.5 px."""
    grey = shot.picture.astype(np.float32)
    sharper = grey + amount * (grey - cv2.GaussianBlur(grey, (0, 0), 1.5))
    return shot.seen(sharper.round().clip(0, 255).astype(np.uint8))


def _soft(apply: Callable[[Shot, Any], Shot], values: Any, unseen: tuple[float, ...] = ()) -> Corruption:
    return Corruption("light", values, apply, unseen, hidden=apply is coma, psf=BASE_PSF)


BLURS = {
    "gaussian blur": _soft(gaussian, (1.5, 3.0, 5.0), (5.0,)),
    "elliptic blur": _soft(elliptic, ((1.0, 1.2), (1.0, 1.6), (1.0, 3.0), (2.0, 4.0))),
    "motion": _soft(motion, (3.0, 6.0, 12.0), (12.0,)),
    "defocus": _soft(defocus, (2.0, 5.0, 9.0), (9.0,)),
    "coma": _soft(coma, (1.5, 3.0, 6.0)),
}
CORRUPTIONS = {
    "none": Corruption("scene", (0.0,), lambda shot, value: shot),
    **BLURS,
    "noise": Corruption("scene", (5.0, 15.0, 45.0), noise),
    "shot noise": Corruption("scene", (5000.0, 1000.0, 200.0), shot_noise),
    "dead pixels": Corruption("file", (0.001, 0.01, 0.05), dead_pixels),
    "column noise": Corruption("light", (2.0, 5.0, 15.0), banding),
    "low contrast": Corruption("light", (0.30, 0.15, 0.06), low_contrast),
    "over-exposure": Corruption("light", (1.3, 2.0, 4.0), exposure),
    "under-exposure": Corruption("light", (0.3, 0.1, 0.05), exposure),
    "coarse grey": Corruption("scene", (4.0, 3.0, 2.0), coarse_grey),
    "tone curve": Corruption("scene", (1.2, 1.8, 2.4), tone_curve),
    "jpeg": Corruption("file", (60.0, 30.0, 15.0), jpeg),
    "rescaling": Corruption("file", (0.7, 0.5, 0.3), rescaling, unseen=(0.3,)),
    "interlacing": Corruption("light", (1.0, 2.0, 4.0), interlacing),
    "rolling shutter": Corruption("light", (2.0, 5.0, 15.0), rolling_shutter, hidden=True),
    "sharpening": Corruption("file", (0.5, 1.0, 2.0), sharpening),
    "haze": Corruption("light", (0.3, 0.6, 0.85), haze),
    "shadow": Corruption("light", (0.5, 0.25, 0.12), shadow),
    "highlight": Corruption("light", (0.5, 1.0, 2.0), highlight),
    "light gradient": Corruption("light", (2.0, 5.0, 12.0), light_gradient),
    "vignetting": Corruption("light", (2.0, 4.0, 8.0), vignetting),
    "dust": Corruption("scene", (50.0, 200.0, 800.0), dust),
    "drops": Corruption("scene", (10.0, 30.0, 80.0), drops),
    "wires": Corruption("scene", (1.0, 2.0, 3.0), wires),
    "cover": Corruption("scene", (0.15, 0.30), cover),
    "discs": Corruption("scene", (100.0, 300.0, 1000.0), discs),
    "specks": Corruption("scene", (1000.0, 3000.0, 10000.0), specks),
    "page of text": Corruption("scene", (1.0, 2.0, 4.0), page_of_text, own_background=True),
    "checkers": Corruption("scene", (5.0, 15.0, 45.0), checkers, own_background=True),
    "moire": Corruption("scene", (2.3, 5.0, 12.0), moire, own_background=True),
}

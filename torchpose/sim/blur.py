"""Blur that is the same everywhere in a frame: an elliptic Gaussian, a box along a line, a disc, one after the other.

Pictures that are blurred along a line are averages of shifted pictures, so whatever `torchpose.sim.boundary.fill` does
not integrate in closed form is a set of weighted shifts of the boundary samples. A Gaussian of the covariance S is one
whose axes lie along rows and columns, averaged over shifts along one line:

    S = diag(sigma^2) + line line^T,  line = sqrt(|r|) (sqrt(S11), +-sqrt(S22)),  sigma^2 = (1 - |r|) (S11, S22)

with the correlation r = S12 / sqrt(S11 S22). The line is no function of S as far as derivatives are concerned: at a
round Gaussian it is zero and has none. Derivatives by S are those of the heat equation, dI/dS = grad grad^T I / 2,
which hold for any S: by the diagonal through ``sigma``, by S12 through ``cross``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import ConfigError, FrameError
from torchpose.geometry.quadrature import gauss_legendre
from torchpose.geometry.rows import Rows
from torchpose.sim.boundary import REACH, Boundary, Samples, nodes_across, on_chords

# an edge averaged by the trapezoidal rule over a Gaussian line: to 5e-6 of its contrast for lines of up to 30 sigma
_LINE_REACH, _LINE_NODES = 4.4, 6.6
_NO_CORRELATION = 1e-6  # of the Gaussian's two axes: leaves less than 1e-6 of an edge's contrast
Level = float | Tensor  # a number for all frames, or (B,)
Pair = Sequence[float] | Tensor  # two numbers for all frames, or (B, 2)


@dataclass(frozen=True, eq=False)
class Blur(Rows):
    """Blur of B frames, px; the pixel's own area comes on top.

    Attributes:
        sigma: standard deviations of the Gaussian along rows and columns.
        line: direction and standard deviation of the Gaussian along a line, on top of ``sigma``.
        smear: direction and full length of the box along a line.
        disc: radius.
        cross: 0 with the derivative of S12, px^2; None where S12 is not given.
    """

    sigma: Float[Tensor, "B 2"]
    line: Float[Tensor, "B 2"]
    smear: Float[Tensor, "B 2"]
    disc: Float[Tensor, " B"]
    cross: Float[Tensor, " B"] | None = None

    @property
    def finest(self) -> Float[Tensor, " B"]:
        """Smaller standard deviation, which the outlines' samples have to resolve."""
        return self.sigma.detach().amin(1)

    @property
    def margin(self) -> Float[Tensor, " B"]:
        """How far the blur reaches from the samples of `blurred`, but for the disc."""
        return 0.5 + REACH * self.sigma.detach().amax(1)

    @property
    def reach(self) -> Float[Tensor, " B"]:
        """How far the blur reaches from an outline, but for the disc."""
        shift = _LINE_REACH * self.line.norm(dim=1) + self.smear.detach().norm(dim=1) / 2
        return 0.5 + self.margin + shift


def blur_of(psf_sigma: Level, smear: Pair | None, disc: Level, like: Float[Tensor, "B 3"]) -> Blur:
    """The blur of B frames as `torchpose.sim.renderer.Imaging` gives it; of the dtype and device of ``like``.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0 or no covariance, ``disc`` is below 0. FrameError: shapes disagree.
    """
    sigma, line, cross = _gaussian(psf_sigma, like)
    radius = _checked("disc", disc, like, ())
    if not bool((radius >= 0).all()):
        raise ConfigError("disc: the radius must not be below 0 px; give 0 for none")
    box = like.new_zeros(len(like), 2) if smear is None else _checked("smear", smear, like, (2,))
    return Blur(sigma, line, box, radius, cross)


def start(edges: Boundary, pixel: Float[Tensor, "K N 2"], dv: Float[Tensor, "K N"], blur: Blur) -> Samples:
    """Samples of the outlines, blurred by the part of the Gaussian along rows and columns.

    Args:
        edges: N samples.
        pixel: their images at K instants.
        dv: v component of their steps, px, weighted.
        blur: of all frames.
    """
    frame, shape = edges.frame.repeat(len(pixel)), edges.shape.repeat(len(pixel))
    return Samples(frame, shape, pixel.flatten(0, 1), dv.flatten(), blur.sigma[frame])


def blurred(samples: Samples, blur: Blur, radius: Float[Tensor, " S"]) -> Samples:
    """Samples blurred by the rest of the Gaussian, by the smear and by the disc of each shape's radius in px."""
    offset, weight = shifts(blur)
    if len(weight) > 1:
        samples = _copies(samples, offset[:, samples.frame], weight[:, None])
    if bool(radius.detach().any()):
        along_v, half_chord, weight = on_chords(radius[samples.shape], samples.sigma[:, 1])
        offset = torch.stack([torch.zeros_like(along_v), along_v], -1)
        samples = replace(_copies(samples, offset, weight), half_chord=half_chord.flatten())
    return samples


def shifts(blur: Blur) -> tuple[Float[Tensor, "K B 2"], Float[Tensor, " K"]]:
    """Shifts in px of the frames whose weighted average has the line of the Gaussian and the smear."""
    normal, density = _normal_nodes(blur)
    along, weight = _box_nodes(blur)
    offset = normal[:, None, None, None] * blur.line + along[:, None, None] * blur.smear
    return offset.flatten(0, 1), (density[:, None] * weight).flatten()


def _normal_nodes(blur: Blur) -> tuple[Tensor, Tensor]:
    """Trapezoidal rule for the standard normal distribution; one node where no frame needs more.

    It converges geometrically; Gauss-Hermite nodes grow with the square of the ratio of line and sigma.
    """
    ratio = _greatest(blur.line / blur.sigma)
    if ratio == 0.0:
        return blur.sigma.new_zeros(1), blur.sigma.new_ones(1)
    nodes = 1 + math.ceil(_LINE_NODES * math.hypot(1.0, ratio))
    node = torch.linspace(-_LINE_REACH, _LINE_REACH, nodes, dtype=blur.sigma.dtype, device=blur.sigma.device)
    return node, (-0.5 * node.square()).softmax(0)


def _box_nodes(blur: Blur) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes on [-1/2, 1/2]; one where no frame is smeared."""
    ratio = _greatest(blur.smear / blur.sigma) / 2
    node, weight = gauss_legendre(nodes_across(ratio) if ratio > 0 else 1, blur.sigma)
    return node - 0.5, weight


def _greatest(vector: Tensor) -> float:
    """Length of the longest of vectors (B, 2)."""
    return float(vector.detach().norm(dim=1).max()) if len(vector) else 0.0


def _copies(samples: Samples, offset: Tensor, weight: Tensor) -> Samples:
    """K copies of N samples, shifted by offset (K, N, 2) and weighted by weight (K, N) or (K, 1)."""
    number = torch.arange(len(samples), device=offset.device).repeat(len(offset))
    pixel, dv = (samples.pixel + offset).flatten(0, 1), (weight * samples.dv).flatten()
    swept = None if samples.swept is None else (weight[..., None] * samples.swept).flatten(0, 1)
    return replace(samples[number], pixel=pixel, dv=dv, swept=swept)


def _gaussian(psf_sigma: Level, like: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Fields ``sigma``, ``line`` and ``cross`` of `Blur`, after a check of the blur's sign."""
    given = torch.as_tensor(psf_sigma, dtype=like.dtype, device=like.device)
    if given.ndim < 2:
        sigma = _checked("psf_sigma", given, like, ())
        if not bool((sigma > 0).all()):
            raise ConfigError("psf_sigma: the blur must be above 0 px; give for example 0.3 for a very sharp lens")
        return sigma[:, None].expand(-1, 2), torch.zeros_like(sigma.detach())[:, None].expand(-1, 2), None
    covariance = _checked("psf_sigma", given, like, (2, 2))
    variance, mixed = covariance.diagonal(dim1=1, dim2=2), covariance[:, 0, 1]
    determinant = variance.prod(1) - mixed.square()
    even = (mixed - covariance[:, 1, 0]).abs() <= 1e-9 * variance.abs().sum(1)
    if not bool(((variance > 0).all(1) & (determinant > 0) & even).all()):
        raise ConfigError("psf_sigma: the covariance must be symmetric and positive definite, px^2")
    scale = variance.detach().sqrt()
    correlation = mixed.detach() / scale.prod(1)
    size = torch.where(correlation.abs() < _NO_CORRELATION, 0.0, correlation.abs()).sqrt()
    line = size[:, None] * scale * torch.stack([torch.ones_like(size), correlation.sign()], 1)
    # by either half of S12: a derivative by one of two equal entries is half of that by both
    cross = (mixed + covariance[:, 1, 0]) / 2 - line.prod(1)
    return (variance - line.square()).sqrt(), line, cross


def _checked(name: str, value: Level | Pair, like: Tensor, each: tuple[int, ...]) -> Tensor:
    """(B, *each) of a value of one frame or of all."""
    given = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    shape = (len(like), *each)
    if given.shape not in (each, shape, (1, *each)):
        wanted = " or ".join(map(str, (each, shape) if each else (shape,)))
        raise FrameError(f"{name}: shape {tuple(given.shape)} is not {wanted} of {len(like)} poses")
    return given.expand(shape)

"""Analytic renderer: grey frames of a flat ring target, exact under perspective, lens distortion and blur.

What is modelled: the scene is piecewise constant (ink, paper, surround); its image is convolved with an isotropic
Gaussian point-spread function of standard deviation ``psf_sigma`` and with the unit square of the pixel (fill factor
1), both in the raw, distorted pixel frame; the sensor is linear. Nothing is rounded or clipped before `add_noise`.

How: the blurred indicator of a region is a boundary integral. With the separable kernel k(x) k(y), k = Gaussian * box,
and its antiderivative c, Green's theorem gives

    I(p) = integral over the region of k(u - p_u) k(v - p_v) du dv = - closed integral of c(p_u - u) k(p_v - v) dv .

The boundary is a closed analytic curve (a circle through pose, projection and distortion), so the trapezoidal rule
converges geometrically (Trefethen and Weideman 2014): steps of one ``psf_sigma`` leave about 2 exp(-2 pi^2) = 5e-9. No
tangent, chord or curvature approximation is made. Differences along a row have the support of the kernel, so every
boundary sample is scattered into a small patch and a running sum along rows fills the regions.
docs/decisions/0003-renderer.md compares it with supersampling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError, FrameError
from torchpose.target import Target

GREY_MAX = 255.0  # grey levels of rendered frames, whatever the bit depth of the sensor
REACH = 5.0  # the Gaussian is cut at this many standard deviations: 6e-7 of an edge's contrast
_COARSE = 72  # samples a circle from which its speed and extent in pixels are taken
_GAUSS_NODES = 8  # Gauss-Legendre nodes on each 4 sigma of a plate's side
_CHUNK_PIXELS = 1 << 24  # pixels rendered at a time: 128 MiB for each full-frame float64 buffer


@dataclass(frozen=True)
class Boundary:
    """Quadrature samples of region boundaries, fixed to the target; N in all, flat.

    Attributes:
        frame, marker: (N,) int64, index of the pose and of the marker (-1: the plate).
        point: (N, 3) float64, mm, on the boundary.
        step: (N, 3) float64, mm, tangent times quadrature weight; runs so that the region in the image is positive.
        sign: (N,) float64, +1 where crossing inwards enters the region, -1 for holes.
    """

    frame: Tensor
    marker: Tensor
    point: Tensor
    step: Tensor
    sign: Tensor

    @staticmethod
    def cat(a: Boundary, b: Boundary) -> Boundary:
        """Samples of both."""
        return Boundary(
            torch.cat([a.frame, b.frame]),
            torch.cat([a.marker, b.marker]),
            torch.cat([a.point, b.point]),
            torch.cat([a.step, b.step]),
            torch.cat([a.sign, b.sign]),
        )


def render(
    camera: Camera,
    target: Target,
    R: Tensor,
    t: Tensor,
    *,
    psf_sigma: float | Tensor = 0.7,
    dark: float | Tensor = 30.0,
    light: float | Tensor = 220.0,
    plate: tuple[float, float] | None = None,
    surround: float | Tensor = 90.0,
) -> Tensor:
    """Noise-free frames of a target, grey values 0..255, differentiable in pose, blur and grey levels.

    The target's rings are drawn with ``dark`` on ``light``, or the other way round where ``target.background`` is dark.
    A marker is drawn from either side, and not at all where it reaches behind the camera or beyond the radius up to
    which the distortion model is one-to-one.

    Args:
        camera: the camera; its width and height are those of the frames.
        target: the target.
        R, t: (B, 3, 3) and (B, 3), target to camera, mm.
        psf_sigma: Gaussian blur in px, above 0; the pixel's own area comes on top. A number or (B,).
        dark, light: grey levels; numbers or (B,).
        plate: width and height in mm of the plate, centred on the target's origin in its plane z = 0; None: it fills
            the frame.
        surround: grey level around the plate; a number or (B,).

    Returns:
        (B, H, W) float32.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0, or the plate reaches behind the camera.
        FrameError: shapes of R and t disagree.
    """
    R, t = check_poses(R, t)
    sigma = check_blur(psf_sigma, t)
    dark_, light_, around = (per_frame(x, t) for x in (dark, light, surround))
    ink, paper = (light_, dark_) if target.background == "dark" else (dark_, light_)
    frames = _frames_at_once(camera.width * camera.height)
    out = []
    for a in range(0, t.shape[0], frames):
        s = slice(a, a + frames)
        edges = ring_boundary(camera, target, R[s], t[s], sigma[s])
        contrast = (ink - paper)[s][edges.frame]
        base = paper[s]
        if plate is not None:
            rim = _plate_boundary(camera, plate, R[s], t[s], sigma[s])
            edges, contrast = Boundary.cat(edges, rim), torch.cat([contrast, (paper - around)[s][rim.frame]])
            base = around[s]
        position, dv = project(camera, edges, R[s], t[s])
        dv = dv * edges.sign * contrast
        size = (base.shape[0], camera.height, camera.width)
        canvas = fill(position, dv, sigma[s][edges.frame], kernel_reach(sigma[s]), edges.frame, *size)
        out.append((base[:, None, None] + canvas).float())
    return torch.cat(out) if out else t.new_zeros(0, camera.height, camera.width, dtype=torch.float32)


@torch.no_grad()
def ring_boundary(camera: Camera, target: Target, R: Tensor, t: Tensor, sigma: Tensor) -> Boundary:
    """Boundary samples of all rings of a target in view, at most one ``sigma`` px apart.

    Args:
        camera, target: as in `render`.
        R, t: (B, 3, 3), (B, 3) float64. sigma: (B,) float64, blur in px.
    """
    centers, radii = target.centers.to(t), target.radii.to(t)
    e1, e2 = _plane_axes(target.normals.to(t))
    angle = torch.arange(_COARSE, dtype=t.dtype, device=t.device) * (2 * math.pi / _COARSE)

    offset = angle.cos()[:, None] * e1[:, None] + angle.sin()[:, None] * e2[:, None]  # (M, A, 3)
    slope = angle.cos()[:, None] * e2[:, None] - angle.sin()[:, None] * e1[:, None]
    point = centers[:, None, None] + radii[..., None, None] * offset[:, None]  # (M, 2, A, 3)
    step = radii[..., None, None] * slope[:, None]
    rotation = R[:, None, None, None]
    pixel, tangent, valid = _image(
        camera,
        (rotation @ point[..., None]).squeeze(-1) + t[:, None, None, None],
        (rotation @ step[..., None]).squeeze(-1),
    )  # (B, M, 2, A, ...)
    reach = 1.0 + REACH * sigma[:, None, None]
    size = torch.tensor([camera.width, camera.height], dtype=t.dtype, device=t.device)
    low, high = pixel.amin((2, 3)), pixel.amax((2, 3))  # (B, M, 2)
    valid = valid.all(-1).all(-1) & ((high > -reach) & (low < size + reach)).all(-1)
    speed = tangent.square().sum(-1).amax(-1).sqrt()  # (B, M, 2) px/rad
    area = (pixel[..., 0] * tangent[..., 1] - pixel[..., 1] * tangent[..., 0]).sum(-1)
    turn = torch.where(area < 0, -1.0, 1.0).to(t)

    frame, marker, ring = valid[..., None].expand_as(speed).nonzero(as_tuple=True)
    pick = (frame, marker, ring)
    # 5 % of margin for the speed between the coarse samples
    count = (2 * math.pi * 1.05 * speed[pick] / sigma[frame]).ceil().clamp(min=24).long()
    sample = torch.arange(count.numel(), device=t.device).repeat_interleave(count)
    first = (count.cumsum(0) - count)[sample]
    theta = (torch.arange(sample.numel(), device=t.device) - first).to(t) * (2 * math.pi / count.to(t))[sample]
    frame, marker, ring = frame[sample], marker[sample], ring[sample]
    radius = radii[marker, ring][:, None]
    cos, sin = radius * theta.cos()[:, None], radius * theta.sin()[:, None]
    weight = (turn[pick] * 2 * math.pi / count.to(t))[sample][:, None]
    return Boundary(
        frame=frame,
        marker=marker,
        point=centers[marker] + cos * e1[marker] + sin * e2[marker],
        step=weight * (cos * e2[marker] - sin * e1[marker]),
        sign=1.0 - 2.0 * ring.to(t),
    )


@torch.no_grad()
def _plate_boundary(camera: Camera, plate: tuple[float, float], R: Tensor, t: Tensor, sigma: Tensor) -> Boundary:
    """Boundary samples of the plate: composite Gauss-Legendre along its sides, panels of at most 4 ``sigma`` px."""
    w, h = plate[0] / 2, plate[1] / 2
    corners = torch.tensor([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], dtype=t.dtype, device=t.device)
    sides = corners.roll(-1, 0) - corners
    fraction = torch.linspace(0, 1, _COARSE, dtype=t.dtype, device=t.device)
    coarse = corners[:, None] + fraction[:, None] * sides[:, None]  # (4, A, 3)
    rotation = R[:, None, None]
    pixel, tangent, valid = _image(
        camera,
        (rotation @ coarse[..., None]).squeeze(-1) + t[:, None, None],
        (rotation @ sides[:, None, :, None]).squeeze(-1).expand(-1, -1, _COARSE, -1),
    )
    seen = valid.all(-1).all(-1)  # (B,)
    if not bool(seen.all()):
        raise ConfigError(
            "plate: it reaches behind the camera or out of the distortion model; make it smaller or omit it"
        )
    p, dp = pixel, tangent
    turn = torch.where((p[..., 0] * dp[..., 1] - p[..., 1] * dp[..., 0]).sum((1, 2)) < 0, -1.0, 1.0).to(t)
    length = tangent.square().sum(-1).sqrt().amax((1, 2))
    panels = int((1.05 * length / (4 * sigma)).max().ceil()) if len(sigma) else 1
    node, weight = _gauss_legendre(_GAUSS_NODES, t)
    s = ((torch.arange(panels, device=t.device)[:, None] + node) / panels).reshape(-1)
    ds = (weight / panels).repeat(panels)
    batch = t.shape[0]
    shape = (batch, 4, s.numel(), 3)
    point = (corners[:, None] + s[:, None] * sides[:, None]).expand(shape)
    step = turn[:, None, None, None] * (ds[:, None] * sides[:, None])
    frame = torch.arange(batch, device=t.device)[:, None, None].expand(shape[:3]).reshape(-1)
    return Boundary(
        frame, torch.full_like(frame, -1), point.reshape(-1, 3), step.reshape(-1, 3), t.new_ones(len(frame))
    )


def project(camera: Camera, edges: Boundary, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, 2) of boundary samples and the v component (N,) of their quadrature steps, in px."""
    rotation = R[edges.frame]
    x = (rotation @ edges.point[:, :, None]).squeeze(-1) + t[edges.frame]
    pixel, tangent, _ = _image(camera, x, (rotation @ edges.step[:, :, None]).squeeze(-1))
    return pixel, tangent[:, 1]


def fill(
    position: Tensor, dv: Tensor, sigma: Tensor, reach: int, canvas: Tensor, count: int, height: int, width: int
) -> Tensor:
    """Blurred regions from their boundary samples: ``sum of - c(p_u - u) k(p_v - v) dv`` at every pixel p.

    Args:
        position: (N, 2) float64, px from the centre of the canvas' first pixel. dv: (N,), px, times any amplitude.
        sigma: (N,), blur, px. reach: `kernel_reach` of it. canvas: (N,) int64, which of the ``count`` canvases.
        count, height, width: size of the result. Samples may lie outside.

    Returns:
        (count, height, width), of the dtype of the positions.
    """
    offset = torch.arange(-reach, reach + 1, device=position.device)
    nearest = position.detach().round().long()
    column, row = nearest[:, :1] + offset, nearest[:, 1:] + offset  # (N, n)
    s = sigma[:, None]
    across = _box_gauss(row.to(position) - position[:, 1:], s)
    along = _box_gauss_integral(torch.cat([column[:, :1] - 1, column], 1).to(position) - position[:, :1], s).diff(dim=1)
    inside = ((row >= 0) & (row < height))[:, :, None] & (column < width)[:, None]
    # what starts left of the canvas has its full effect from the first column on
    index = (canvas[:, None, None] * height + row[:, :, None]) * width + column.clamp(min=0)[:, None]
    value = -dv[:, None, None] * across[:, :, None] * along[:, None]
    keep = inside.reshape(-1).nonzero().squeeze(1)
    increments = torch.zeros(count * height * width, dtype=position.dtype, device=position.device)
    increments = increments.index_add(0, index.reshape(-1)[keep], value.reshape(-1)[keep])
    return increments.view(count, height, width).cumsum(2)


def add_noise(
    frames: Tensor, sigma: float | Tensor, seed: int = 0, *, index: Tensor | None = None, bits: int = 8
) -> Tensor:
    """Frames as the sensor delivers them: white Gaussian noise, rounding to ``bits`` bits, clipping.

    The noise of a pixel depends on ``seed``, the frame's number and the pixel alone (a counter-based generator:
    SplitMix64 of Steele, Lea and Flood 2014 and the Box-Muller transform), so it is the same in any batch and on any
    device.

    Args:
        frames: (B, H, W), grey levels 0..255. sigma: noise in grey levels of 0..255; a number or (B,).
        seed: any integer. index: (B,) int64, the frames' numbers; 0 to B - 1 by default.
        bits: 1 to 16; white (255) becomes 2^bits - 1.

    Returns:
        (B, H, W) uint8 for up to 8 bits, else uint16.

    Raises:
        ConfigError: ``bits`` is out of range.
    """
    if not 1 <= bits <= 16:
        raise ConfigError(f"bits: {bits} is not a bit depth of this camera model; give 1 to 16")
    top, dtype = 2**bits - 1, torch.uint8 if bits <= 8 else torch.uint16
    number = torch.arange(frames.shape[0], device=frames.device) if index is None else index.to(frames.device)
    size = frames.shape[1] * frames.shape[2]
    sigma = torch.as_tensor(sigma, dtype=torch.float64, device=frames.device).expand(frames.shape[0])
    out = []
    for some, which, amplitude in zip(*(x.split(_frames_at_once(size)) for x in (frames, number, sigma)), strict=True):
        level = some + amplitude[:, None, None] * _normal(seed, which, size).view_as(some)
        out.append((level * (top / GREY_MAX)).round().clamp(0, top).to(dtype))
    return torch.cat(out)


def _frames_at_once(pixels: int) -> int:
    return max(1, _CHUNK_PIXELS // max(1, pixels))


def _normal(seed: int, number: Tensor, count: int) -> Tensor:
    """(B, count) float64 normal deviates of the frames numbered (B,)."""
    key = _mix64(_mix64(torch.full_like(number, seed % 2**62)) + number)
    pairs = (count + 1) // 2
    bits = _mix64(key[:, None] + torch.arange(pairs, device=number.device) * _GOLDEN)
    radius = (-2 * (((bits & 0xFFFFFFFF).double() + 0.5) * 2.0**-32).log()).sqrt()
    angle = ((bits >> 32).double() + 0.5) * (2 * math.pi * 2.0**-32)
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1).flatten(1)[:, :count]


_GOLDEN = 0x9E3779B97F4A7C15 - 2**64


def _mix64(x: Tensor) -> Tensor:
    """Output function of SplitMix64 on int64, which wraps around as the unsigned one does."""
    x = x + _GOLDEN
    x = (x ^ ((x >> 30) & (2**34 - 1))) * (0xBF58476D1CE4E5B9 - 2**64)
    x = (x ^ ((x >> 27) & (2**37 - 1))) * (0x94D049BB133111EB - 2**64)
    return x ^ ((x >> 31) & (2**33 - 1))


def _image(camera: Camera, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (..., 2) of camera points (..., 3), images (..., 2) of their steps, and which points are seen (...,)."""
    z = x[..., 2:]
    normalised = x[..., :2] / z
    d_normalised = (dx[..., :2] - normalised * dx[..., 2:]) / z
    tangent = (camera.J_distort(normalised) @ d_normalised[..., None]).squeeze(-1)
    valid = (x[..., 2] > 0) & (normalised.detach().norm(dim=-1) < camera.fold_radius)
    return camera.distort(normalised), tangent, valid


def _box_gauss(x: Tensor, s: Tensor) -> Tensor:
    """Gaussian of standard deviation s convolved with the unit box."""
    return torch.special.ndtr((x + 0.5) / s) - torch.special.ndtr((x - 0.5) / s)


def _box_gauss_integral(x: Tensor, s: Tensor) -> Tensor:
    """Integral of `_box_gauss` from minus infinity to x."""
    return s * (_normal_loss((x + 0.5) / s) - _normal_loss((x - 0.5) / s))


def _normal_loss(a: Tensor) -> Tensor:
    """Integral of the normal distribution function: a Phi(a) + phi(a)."""
    return a * torch.special.ndtr(a) + (-0.5 * a.square()).exp() / math.sqrt(2 * math.pi)


def _plane_axes(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (M, 3), (M, 3) that complete unit normals (M, 3) to orthonormal frames (Duff et al. 2017)."""
    x, y, z = normals.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    return torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1), torch.stack([b, sign + y * y * a, -y], -1)


def _gauss_legendre(order: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights (order,) on [0, 1] (Golub and Welsch 1969)."""
    k = torch.arange(1, order, dtype=like.dtype, device=like.device)
    off = k / (4 * k * k - 1).sqrt()
    node, vector = torch.linalg.eigh(off.diag(1) + off.diag(-1))
    return (node + 1) / 2, vector[0].square()


def per_frame(value: float | Tensor, like: Tensor) -> Tensor:
    """(B,) tensor of a number or a (B,) tensor, of the dtype and device of ``like`` (B, ...)."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape[0])


def check_blur(psf_sigma: float | Tensor, like: Tensor) -> Tensor:
    """(B,) blur in px, after a check of its sign."""
    sigma = per_frame(psf_sigma, like)
    if not bool((sigma > 0).all()):
        raise ConfigError("psf_sigma: the blur must be above 0 px; give for example 0.3 for a very sharp lens")
    return sigma


def kernel_reach(sigma: Tensor) -> int:
    """Pixels from the one nearest to a boundary sample up to which its blurred effect is drawn."""
    # half a pixel to the nearest centre and half a pixel of its area
    return math.ceil(1.0 + REACH * float(sigma.detach().max())) if len(sigma) else 1


def check_poses(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """R and t in float64, after a check of their shapes."""
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (R.shape[0], 3):
        raise FrameError(f"R, t: shapes {tuple(R.shape)} and {tuple(t.shape)} are not (B, 3, 3) and (B, 3)")
    return R.double(), t.double()

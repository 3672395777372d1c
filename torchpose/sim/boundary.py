"""Blurred regions as integrals along their boundaries: where the samples lie, and what each adds to the picture.

The blurred indicator of a region is a boundary integral. With a separable kernel k(x) l(y) and the antiderivative c of
k, Green's theorem gives

    I(p) = integral over the region of k(u - p_u) l(v - p_v) du dv = - closed integral of c(p_u - u) l(p_v - v) dv .

Circles are closed analytic curves through pose, projection and distortion, so the trapezoidal rule converges
geometrically (Trefethen and Weideman 2014): steps of one ``sigma`` leave about 2 exp(-2 pi^2) = 5e-9. Sides of polygons
get Gauss-Legendre panels. No tangent, chord or curvature approximation is made. Differences along a row have the
support of the kernel, so every sample is scattered into a small patch and a running sum along rows fills the region.
docs/decisions/0003-renderer.md compares it with supersampling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.sim.shapes import Shapes

REACH = 5.0  # the Gaussian is cut at this many standard deviations: 6e-7 of an edge's contrast
_COARSE_CIRCLE, _COARSE_SIDE = 72, 9  # samples from which speed and extent in pixels are taken
_MARGIN = 1.05  # for the speed between those samples
_NODES, _PANEL = 16, 11.0  # Gauss-Legendre nodes on each panel of at most so many sigma; leaves about 5e-9
_CHUNK_CELLS = 1 << 18  # pixels of patches computed at a time: they stay in the processor's cache
_MIN_CHORD = 1e-3  # px; chords below this blur by less than 1e-6 px^2, and differences over them would cancel


@dataclass(frozen=True, eq=False)
class Boundary:
    """Quadrature samples of region boundaries, fixed to the target; N in all, flat.

    Attributes:
        frame, shape: (N,) int64, index of the pose and of the shape.
        point: (N, 3) float64, mm, on the boundary.
        step: (N, 3) float64, mm, tangent times quadrature weight; runs so that the region in the image is positive.
    """

    frame: Tensor
    shape: Tensor
    point: Tensor
    step: Tensor


@dataclass(frozen=True, eq=False)
class Boxes:
    """Windows of whole pixels, one a shape: where it is drawn.

    Attributes:
        corner: (P, 2) int64, first column and row. size: (P, 2) int64, columns and rows.
    """

    corner: Tensor
    size: Tensor

    @property
    def stride(self) -> int:
        """Cells of a row: one more than the widest window has columns, which takes what lies right of the window."""
        return int(self.size[:, 0].amax()) + 1 if len(self.size) else 1

    @property
    def first_row(self) -> Tensor:
        """(P,) rows of the windows before each."""
        return self.size[:, 1].cumsum(0) - self.size[:, 1]

    @property
    def rows(self) -> int:
        """Rows of all windows."""
        return int(self.size[:, 1].sum())


@torch.no_grad()
def sample_boundary(camera: Camera, shapes: Shapes, R: Tensor, t: Tensor, sigma: Tensor) -> Boundary:
    """Boundary samples of the shapes that are in view, at most about one ``sigma`` px apart.

    A shape has none where it reaches behind the camera or beyond the radius up to which the distortion model is
    one-to-one, or where it lies outside of the frame.

    Args:
        camera: the camera. shapes: S shapes. R, t: (B, 3, 3), (B, 3) float64. sigma: (B,) float64, blur in px.
    """
    parameter = torch.arange(_COARSE_CIRCLE, dtype=t.dtype, device=t.device) * (2 * math.pi / _COARSE_CIRCLE)
    c_frame, s_frame = shapes.frame[shapes.circle_of], shapes.frame[shapes.side_of]
    offset, slope = _on_circle(shapes.circle_axes[:, None], parameter)
    c_pixel, c_tangent, c_valid = _posed(camera, R, t, c_frame, shapes.circle_center[:, None] + offset, slope)

    fraction = torch.linspace(0, 1, _COARSE_SIDE, dtype=t.dtype, device=t.device)
    first, along = shapes.side[:, :1], shapes.side[:, 1:] - shapes.side[:, :1]
    s_point = first + fraction[:, None] * along
    s_pixel, s_tangent, s_valid = _posed(camera, R, t, s_frame, s_point, along.expand_as(s_point))

    seen = _in_view(
        camera,
        torch.cat([shapes.circle_of, shapes.side_of]),
        torch.cat([c_pixel.amin(1), s_pixel.amin(1)]),
        torch.cat([c_pixel.amax(1), s_pixel.amax(1)]),
        torch.cat([c_valid.all(1), s_valid.all(1)]),
        sigma[shapes.frame],
    )
    c_speed, s_speed = _speed(c_tangent), _speed(s_tangent)
    c_turn = _sign(_area(c_pixel, c_tangent))
    s_area = s_pixel.new_zeros(len(shapes)).index_add(0, shapes.side_of, _area(s_pixel, s_tangent))
    s_turn = _sign(s_area)[shapes.side_of]

    # circles: the trapezoidal rule
    use = seen[shapes.circle_of].nonzero().squeeze(1)
    count = (2 * math.pi * _MARGIN * c_speed[use] / sigma[c_frame[use]]).ceil().clamp(min=24).long()
    item, number = ragged(count)
    theta = number.to(t) * (2 * math.pi / count.to(t))[item]
    c = use[item]
    offset, slope = _on_circle(shapes.circle_axes[c], theta)
    weight = (c_turn * shapes.circle_sign)[c] * (2 * math.pi / count.to(t))[item]
    circles = Boundary(
        c_frame[c],
        shapes.circle_of[c],
        shapes.circle_center[c] + offset,
        weight[:, None] * slope,
    )
    # sides of polygons: Gauss-Legendre panels
    use = seen[shapes.side_of].nonzero().squeeze(1)
    panels = (_MARGIN * s_speed[use] / (_PANEL * sigma[s_frame[use]])).ceil().clamp(min=1).long()
    item, number = ragged(panels)
    node, weight = gauss_legendre(_NODES, t)
    width = 1 / panels.to(t)[item]
    position = ((number[:, None] + node) * width[:, None]).reshape(-1)
    weight = (width[:, None] * weight).reshape(-1)
    s = use[item].repeat_interleave(_NODES)
    sides = Boundary(
        s_frame[s],
        shapes.side_of[s],
        shapes.side[s, 0] + position[:, None] * along[s, 0],
        (s_turn[s] * weight)[:, None] * along[s, 0],
    )
    return Boundary(
        torch.cat([circles.frame, sides.frame]),
        torch.cat([circles.shape, sides.shape]),
        torch.cat([circles.point, sides.point]),
        torch.cat([circles.step, sides.step]),
    )


def project(camera: Camera, edges: Boundary, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, 2) of boundary samples and the v component (N,) of their quadrature steps, in px."""
    rotation = R[edges.frame]
    x = (rotation @ edges.point[:, :, None]).squeeze(-1) + t[edges.frame]
    pixel, tangent, _ = _image(camera, x, (rotation @ edges.step[:, :, None]).squeeze(-1))
    return pixel, tangent[:, 1]


@torch.no_grad()
def boxes_around(pixel: Tensor, shape: Tensor, margin: Tensor, width: int, height: int) -> Boxes:
    """Window of every shape: its samples (N, 2) with ``margin`` (S,) px on every side, cut by the frame."""
    count = len(margin)
    index = shape[:, None].expand_as(pixel)
    low = pixel.new_full((count, 2), torch.inf).scatter_reduce(0, index, pixel, "amin")
    high = pixel.new_full((count, 2), -torch.inf).scatter_reduce(0, index, pixel, "amax")
    size = torch.tensor([width, height], device=pixel.device)
    last = size.to(pixel) - 1
    first = (low - margin[:, None]).floor().clamp(min=0).minimum(last).long()
    end = (high + margin[:, None]).ceil().minimum(last).clamp(min=-1).long() + 1
    return Boxes(first, (end - first).clamp(min=0))


def fill(
    pixel: Tensor, dv: Tensor, sigma: Tensor, shape: Tensor, boxes: Boxes, *, half_chord: Tensor | None = None
) -> Tensor:
    """Blurred regions from their boundary samples: ``sum of - c(p_u - u) k(p_v - v) dv`` at every pixel p.

    Args:
        pixel: (N, 2) float64, samples, which may lie outside of their window. dv: (N,), px.
        sigma: (N,), Gaussian blur, px. shape: (N,) int64, window of each sample.
        boxes: P windows.
        half_chord: (N,), px: blur along the rows by a box of twice this width besides, see `on_chords`.

    Returns:
        (boxes.rows, boxes.stride), of the dtype of the samples; the rows of all windows one below the other, 0 to
        rounding behind their ends.
    """
    if len(pixel) == 0:
        return pixel.new_zeros(boxes.rows, boxes.stride)
    reach = 1.0 + REACH * float(sigma.detach().max())
    beside = reach + (0.0 if half_chord is None else float(half_chord.detach().max()))
    rows = _offsets(math.floor(reach), math.floor(reach), pixel)
    # the sum along a row ends where the kernel does, which is a pixel further right than left
    columns = _offsets(math.floor(beside), math.ceil(beside), pixel)
    corner, size, first_row, stride = boxes.corner[shape], boxes.size[shape], boxes.first_row[shape], boxes.stride
    increments = pixel.new_zeros(boxes.rows * stride)
    # each chunk copies all windows where a derivative is wanted
    cells = _CHUNK_CELLS * (16 if torch.is_grad_enabled() else 1)
    chunk = max(1, cells // (len(rows) * len(columns)))
    for a in range(0, len(pixel), chunk):
        s = slice(a, a + chunk)
        nearest = pixel[s].detach().round()
        from_nearest = pixel[s] - nearest
        scale = sigma[s, None]
        across = _box_gauss(rows - from_nearest[:, 1:], scale)
        # differences from each column to the next; the first has the column before it as its neighbour
        x = torch.cat([columns[:1] - 1, columns]) - from_nearest[:, :1]
        along = (
            _box_gauss_integral(x, scale) if half_chord is None else _chord_integral(x, scale, half_chord[s, None])
        ).diff(dim=1)
        local = nearest.long() - corner[s]
        row, column = local[:, 1:] + rows.long(), local[:, :1] + columns.long()
        inside = (row >= 0) & (row < size[s, 1:])
        across = across * inside * -dv[s, None]
        # what begins left of the window has its full effect from the first column on
        column = column.clamp(min=0).minimum(size[s, :1])
        cell = (first_row[s, None] + torch.where(inside, row, 0)) * stride
        index = cell[:, :, None] + column[:, None]
        increments = accumulate(increments, index.view(-1), (across[:, :, None] * along[:, None]).view(-1))
    return increments.view(-1, stride).cumsum(1)


def on_chords(radius: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A disc-shaped blur as weighted horizontal chords: offsets along v (J, N), half lengths (J, N), weights (J, N).

    Gauss-Chebyshev quadrature of the second kind, whose weight is the chord's length: exact for polynomials up to
    degree 2 J - 1 in the offset. J grows with the largest radius / sigma, so that the Gaussian is resolved.

    Args:
        radius: (N,), px. sigma: (N,), px.
    """
    ratio = float((radius.detach() / sigma.detach()).max()) if len(radius) else 0.0
    nodes = nodes_across(ratio)
    angle = torch.arange(1, nodes + 1, dtype=radius.dtype, device=radius.device) * (math.pi / (nodes + 1))
    weight = angle.sin().square() * (2 / (nodes + 1))
    half = (angle.sin()[:, None] * radius).clamp(min=_MIN_CHORD)
    return angle.cos()[:, None] * radius, half, weight[:, None].expand_as(half)


def accumulate(total: Tensor, index: Tensor, values: Tensor) -> Tensor:
    """``total`` with ``values`` added at ``index``; in place where nobody differentiates: it may be a whole frame."""
    add = total.index_add if torch.is_grad_enabled() else total.index_add_
    return add(0, index, values)


def ragged(count: Tensor) -> tuple[Tensor, Tensor]:
    """Item (sum of count,) and the running number within the item."""
    item = torch.arange(count.numel(), device=count.device).repeat_interleave(count)
    return item, torch.arange(item.numel(), device=count.device) - (count.cumsum(0) - count)[item]


def nodes_across(ratio: float) -> int:
    """Nodes of a Gauss rule that average an edge over an interval of half the length ``ratio`` sigma to 1e-5."""
    return 2 + math.ceil(1.9 * ratio)


def _posed(
    camera: Camera, R: Tensor, t: Tensor, frame: Tensor, point: Tensor, step: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    rotation = R[frame].mT
    return _image(camera, point @ rotation + t[frame, None], step @ rotation)


def _image(camera: Camera, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (..., 2) of camera points (..., 3), images (..., 2) of their steps, and which points are seen (...,)."""
    z = x[..., 2:]
    normalised = x[..., :2] / z
    d_normalised = (dx[..., :2] - normalised * dx[..., 2:]) / z
    tangent = (camera.J_distort(normalised) @ d_normalised[..., None]).squeeze(-1)
    valid = (x[..., 2] > 0) & (normalised.detach().norm(dim=-1) < camera.fold_radius)
    return camera.distort(normalised), tangent, valid


def _on_circle(axes: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Points (..., 3) of circles of radii ``axes`` (..., 2, 3) about the origin, and derivatives by angle (...)."""
    a, b = axes.unbind(-2)
    cos, sin = angle.cos()[..., None], angle.sin()[..., None]
    return cos * a + sin * b, cos * b - sin * a


def _in_view(camera: Camera, shape: Tensor, low: Tensor, high: Tensor, valid: Tensor, sigma: Tensor) -> Tensor:
    """(S,) bool, shapes whose outlines with extents low, high (L, 2) are valid (L,) and touch the frame."""
    count = len(sigma)
    index = shape[:, None].expand_as(low)
    low = low.new_full((count, 2), torch.inf).scatter_reduce(0, index, low, "amin")
    high = high.new_full((count, 2), -torch.inf).scatter_reduce(0, index, high, "amax")
    reach = 1.0 + REACH * sigma[:, None]
    size = torch.tensor([camera.width, camera.height], dtype=low.dtype, device=low.device)
    broken = torch.zeros(count, dtype=torch.bool, device=low.device)
    broken[shape[~valid]] = True
    return ~broken & ((high > -reach) & (low < size + reach)).all(-1)


def _area(pixel: Tensor, tangent: Tensor) -> Tensor:
    """Signed area (L,) that outlines sampled at (L, A, 2) contribute, up to a positive factor."""
    return (pixel[..., 0] * tangent[..., 1] - pixel[..., 1] * tangent[..., 0]).sum(-1)


def _speed(tangent: Tensor) -> Tensor:
    return tangent.square().sum(-1).amax(-1).sqrt()


def _sign(x: Tensor) -> Tensor:
    return torch.where(x < 0, -1.0, 1.0).to(x)


def _offsets(before: int, behind: int, like: Tensor) -> Tensor:
    return torch.arange(-before, behind + 1, dtype=like.dtype, device=like.device)


def gauss_legendre(order: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights (order,) on [0, 1] (Golub and Welsch 1969)."""
    k = torch.arange(1, order, dtype=like.dtype, device=like.device)
    off = k / (4 * k * k - 1).sqrt()
    node, vector = torch.linalg.eigh(off.diag(1) + off.diag(-1))
    return (node + 1) / 2, vector[0].square()


def _box_gauss(x: Tensor, s: Tensor) -> Tensor:
    """Gaussian of standard deviation s convolved with the unit box."""
    return torch.special.ndtr((x + 0.5) / s) - torch.special.ndtr((x - 0.5) / s)


def _box_gauss_integral(x: Tensor, s: Tensor) -> Tensor:
    """Integral of `_box_gauss` from minus infinity to x."""
    return s * (_normal_loss((x + 0.5) / s) - _normal_loss((x - 0.5) / s))


def _chord_integral(x: Tensor, s: Tensor, w: Tensor) -> Tensor:
    """Integral from minus infinity to x of `_box_gauss` convolved with a box of the half width w and the area 1."""

    def twice(y: Tensor) -> Tensor:
        return _normal_loss_integral((y + 0.5) / s) - _normal_loss_integral((y - 0.5) / s)

    return s * s * (twice(x + w) - twice(x - w)) / (2 * w)


def _normal_loss(a: Tensor) -> Tensor:
    """Integral of the normal distribution function: a Phi(a) + phi(a)."""
    return a * torch.special.ndtr(a) + (-0.5 * a.square()).exp() / math.sqrt(2 * math.pi)


def _normal_loss_integral(a: Tensor) -> Tensor:
    """Integral of `_normal_loss`: ((a^2 + 1) Phi(a) + a phi(a)) / 2."""
    density = (-0.5 * a.square()).exp() / math.sqrt(2 * math.pi)
    return 0.5 * ((a.square() + 1) * torch.special.ndtr(a) + a * density)

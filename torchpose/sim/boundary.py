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

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.quadrature import disc_chords, gauss_legendre
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import ragged_arange
from torchpose.sim.shapes import Shapes

REACH = 5.0  # the Gaussian is cut at this many standard deviations: 6e-7 of an edge's contrast
_COARSE_CIRCLE, _COARSE_SIDE = 72, 9  # samples from which speed and extent in pixels are taken
_MARGIN = 1.05  # for the speed between those samples
_NODES, _PANEL = 16, 11.0  # Gauss-Legendre nodes on each panel of a side of so many sigma; leaves about 5e-9
_CHUNK_CELLS = 1 << 18  # pixels of patches computed at a time: they stay in the processor's cache
_MIN_CHORD = 1e-3  # px; chords below this blur by less than 1e-6 px^2, and differences over them would cancel


@dataclass(frozen=True, eq=False)
class Boundary(Rows):
    """Quadrature samples of region boundaries, fixed to the target: pose, shape, point in mm.

    ``step`` is the tangent times the quadrature weight, mm; it runs so that the region in the image is positive.
    """

    frame: Int[Tensor, " N"]
    shape: Int[Tensor, " N"]
    point: Float[Tensor, "N 3"]
    step: Float[Tensor, "N 3"]


@dataclass(frozen=True, eq=False)
class Boxes(Rows):
    """Windows of whole pixels, one a shape, where it is drawn: first column and row; columns and rows."""

    corner: Int[Tensor, "P 2"]
    size: Int[Tensor, "P 2"]

    @property
    def stride(self) -> int:
        """Cells of a row: one more than the widest window has columns, which takes what lies right of the window."""
        return int(self.size[:, 0].amax()) + 1 if len(self) else 1

    @property
    def rows(self) -> int:
        """Rows of all windows."""
        return int(self.size[:, 1].sum())


@dataclass(frozen=True, eq=False)
class Samples(Rows):
    """Images of boundary samples and what blurs each of them, px.

    Attributes:
        frame: pose.
        shape: window.
        pixel: position, which may lie outside of the window.
        dv: v component of the quadrature step.
        sigma: standard deviations of the Gaussian along rows and columns.
        half_chord: blur along the rows by a box of twice this width besides, see `on_chords`.
        swept: what the step sweeps by each of M numbers that move the boundary, see `fill_moved`.
    """

    frame: Int[Tensor, " N"]
    shape: Int[Tensor, " N"]
    pixel: Float[Tensor, "N 2"]
    dv: Float[Tensor, " N"]
    sigma: Float[Tensor, "N 2"]
    half_chord: Float[Tensor, " N"] | None = None
    swept: Float[Tensor, "N M"] | None = None


@dataclass(frozen=True, eq=False)
class _Curves(Rows):
    """Images of L boundary curves at A parameters each, with derivatives by the parameter, px."""

    frame: Int[Tensor, " L"]
    shape: Int[Tensor, " L"]
    pixel: Float[Tensor, "L A 2"]
    tangent: Float[Tensor, "L A 2"]
    valid: Bool[Tensor, "L A"]

    @property
    def area(self) -> Float[Tensor, " L"]:
        """Signed area that the curves contribute to their shapes, up to a positive factor."""
        return (self.pixel[..., 0] * self.tangent[..., 1] - self.pixel[..., 1] * self.tangent[..., 0]).sum(-1)

    @property
    def speed(self) -> Float[Tensor, " L"]:
        """Largest speed, px by the parameter's unit."""
        return self.tangent.square().sum(-1).amax(-1).sqrt()


@torch.no_grad()
def sample_boundary(
    camera: Camera,
    shapes: Shapes,
    R: Float[Tensor, "B 3 3"],
    t: Float[Tensor, "B 3"],
    sigma: Float[Tensor, " B"],
    reach: Float[Tensor, " S"],
) -> Boundary:
    """Boundary samples of the shapes that are in view, at most about one ``sigma`` px apart.

    A shape has none where it reaches behind the camera or beyond the radius up to which the distortion model is
    one-to-one, or where it lies further than ``reach`` px outside of the frame.
    """
    angle = torch.arange(_COARSE_CIRCLE, dtype=t.dtype, device=t.device) * (2 * math.pi / _COARSE_CIRCLE)
    offset, slope = _on_circle(shapes.circles.axes[:, None], shapes.circles.bend[:, None], angle)
    round_ = _posed(camera, R, t, shapes, shapes.circles.of, (shapes.circles.center[:, None] + offset, slope))
    fraction = torch.linspace(0, 1, _COARSE_SIDE, dtype=t.dtype, device=t.device)[:, None]
    first, last = shapes.sides.ends[:, :1], shapes.sides.ends[:, 1:]
    along = (last - first).expand(-1, _COARSE_SIDE, 3)
    straight = _posed(camera, R, t, shapes, shapes.sides.of, (first + fraction * along, along))
    seen = _in_view(camera, shapes, (round_, straight), reach)

    # circles: the trapezoidal rule
    trapezoidal = t.new_zeros(1), t.new_ones(1)
    use, angle, weight = _quadrature(round_, seen, sigma, 2 * math.pi, 1.0, 24, trapezoidal)
    circles = shapes.circles[use]
    offset, slope = _on_circle(circles.axes, circles.bend, angle)
    weight = (_sign(round_.area) * shapes.circles.sign)[use] * weight
    arcs = Boundary(shapes.frame[circles.of], circles.of, circles.center + offset, weight[:, None] * slope)
    # sides of polygons, which turn as the whole polygon does
    turn = _sign(t.new_zeros(len(shapes)).index_add(0, straight.shape, straight.area))
    use, fraction, weight = _quadrature(straight, seen, sigma, 1.0, _PANEL, 1, gauss_legendre(_NODES, t))
    of, (start, end) = shapes.sides.of[use], shapes.sides.ends[use].unbind(1)
    step = (turn[of] * weight)[:, None] * (end - start)
    return Boundary.cat([arcs, Boundary(shapes.frame[of], of, start + fraction[:, None] * (end - start), step)])


def _quadrature(
    curves: _Curves, seen: Tensor, sigma: Tensor, period: float, panel: float, least: int, rule: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Curve, parameter from 0 to ``period`` and weight of each sample of the curves of the shapes that are seen (S,).

    Nodes and weights of ``rule`` on panels of at most ``panel`` sigma, at least ``least`` panels.
    """
    use = seen[curves.shape].nonzero().squeeze(1)
    count = (period * _MARGIN * curves.speed[use] / (panel * sigma[curves.frame[use]])).ceil().clamp(min=least).long()
    item, number = ragged_arange(count)
    width = (period / count.to(sigma))[item, None]
    chosen = use[item].repeat_interleave(len(rule[0]))
    return chosen, ((number[:, None] + rule[0]) * width).reshape(-1), (width * rule[1]).reshape(-1)


def project(
    camera: Camera, edges: Boundary, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, " N"]]:
    """Pixels of boundary samples and the v component of their quadrature steps, in px."""
    rotation = R[edges.frame]
    x = (rotation @ edges.point[:, :, None]).squeeze(-1) + t[edges.frame]
    pixel, tangent, _ = _image(camera, x, (rotation @ edges.step[:, :, None]).squeeze(-1))
    return pixel, tangent[:, 1]


def swept_by_pose(
    camera: Camera, edges: Boundary, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]
) -> Float[Tensor, "N 6"]:
    """What boundary samples sweep a mm of translation and a rad about the camera's axes, see `fill_moved`."""
    rotation = R[edges.frame]
    arm = (rotation @ edges.point[:, :, None]).squeeze(-1)
    step = (rotation @ edges.step[:, :, None]).squeeze(-1)
    axes = torch.eye(3, dtype=t.dtype, device=t.device)
    shift, turn = axes[:, None].expand(-1, *arm.shape), torch.linalg.cross(axes[:, None], arm[None])
    x = arm + t[edges.frame]
    _, moved, _ = _image(camera, x.expand(7, -1, 3), torch.cat([shift, turn, step[None]]))
    velocity, (du, dv) = moved[:6], moved[6].unbind(-1)
    return (velocity[..., 0] * dv - velocity[..., 1] * du).mT


@torch.no_grad()
def boxes_around(
    pixel: Float[Tensor, "N 2"], shape: Int[Tensor, " N"], margin: Float[Tensor, " S"], camera: Camera
) -> Boxes:
    """Window of every shape: its samples with ``margin`` px on every side, cut by the frame."""
    low, high = _extent(pixel, pixel, shape, len(margin))
    last = _frame_size(camera, pixel) - 1
    first = (low - margin[:, None]).floor().clamp(min=0).minimum(last).long()
    end = (high + margin[:, None]).ceil().minimum(last).clamp(min=-1).long() + 1
    return Boxes(first, (end - first).clamp(min=0))


def fill(
    samples: Samples, boxes: Boxes, derivative: tuple[int, int] = (0, 0), *, reach: float = REACH
) -> Float[Tensor, "H W"]:
    """Blurred regions from their boundary samples: ``sum of - c(p_u - u) k(p_v - v) dv`` at every pixel p.

    Args:
        samples: of all regions.
        boxes: their windows.
        derivative: how often it is differentiated by p_u and by p_v, up to twice, per px or px^2.
        reach: standard deviations at which the Gaussian is cut.

    Returns:
        (boxes.rows, boxes.stride), of the dtype of the samples; the rows of all windows one below the other, 0 to
        rounding behind their ends.
    """
    increments = samples.pixel.new_zeros(boxes.rows * boxes.stride)
    for part, across, along, index in _patches(samples, boxes, derivative, reach):
        across = across * -samples.dv[part, None]
        increments = accumulate(increments, index.view(-1), (across[:, :, None] * along[:, None]).view(-1))
    return increments.view(-1, boxes.stride).cumsum(1)


def fill_moved(samples: Samples, boxes: Boxes, *, reach: float = REACH) -> Float[Tensor, "H W M"]:
    """How the regions of `fill` change with the M numbers that move their boundaries.

    By Reynolds' transport theorem that is the integral of the kernel along the boundary, times the area that each of
    its steps sweeps: ``V_u dv - V_v du`` where it moves by V px a unit of the number.
    """
    swept = samples.swept
    assert swept is not None
    increments = swept.new_zeros(boxes.rows * boxes.stride, swept.shape[1])
    for part, across, along, index in _patches(samples, boxes, (1, 0), reach):
        patch = (across[:, :, None] * along[:, None])[..., None] * swept[part, None, None]
        increments.index_add_(0, index.view(-1), patch.flatten(0, 2))
    return increments.view(-1, boxes.stride, swept.shape[1]).cumsum(1)


def _patches(
    samples: Samples, boxes: Boxes, derivative: tuple[int, int], reach: float
) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
    """What samples add to the windows, as products of a column (N, h) and a row (N, w) of differences from pixel to
    pixel along the rows, with the cells (N, h, w) that they belong to: chunk by chunk of the samples.
    """
    pixel, chord = samples.pixel, samples.half_chord
    if len(pixel) == 0:
        return
    beside, above = (1.0 + reach * samples.sigma.detach().amax(0)).tolist()
    beside += 0.0 if chord is None else float(chord.detach().max())
    rows = torch.arange(-math.floor(above), math.floor(above) + 1).to(pixel)
    # the sum along a row ends where the kernel does, which is a pixel further right than left
    columns = torch.arange(-math.floor(beside), math.ceil(beside) + 1).to(pixel)
    corner, size, stride = boxes.corner[samples.shape], boxes.size[samples.shape], boxes.stride
    first_row = (boxes.size[:, 1].cumsum(0) - boxes.size[:, 1])[samples.shape]
    # each chunk copies all windows where a derivative is wanted
    cells = _CHUNK_CELLS * (16 if torch.is_grad_enabled() else 1)
    together = max(1, cells // (len(rows) * len(columns)))
    for start in range(0, len(pixel), together):
        part = slice(start, start + together)
        nearest = pixel[part].detach().round()
        from_nearest = pixel[part] - nearest
        across = _on_pixel(1 - derivative[1], rows - from_nearest[:, 1:], samples.sigma[part, 1:])
        # differences from each column to the next; the first has the column before it as its neighbour
        x = torch.cat([columns[:1] - 1, columns]) - from_nearest[:, :1]
        half = None if chord is None else chord[part, None]
        along = _row_integral(2 - derivative[0], x, samples.sigma[part, :1], half).diff(dim=1)
        local = nearest.long() - corner[part]
        row, column = local[:, 1:] + rows.long(), local[:, :1] + columns.long()
        inside = (row >= 0) & (row < size[part, 1:])
        # what begins left of the window has its full effect from the first column on
        column = column.clamp(min=0).minimum(size[part, :1])
        cell = (first_row[part, None] + torch.where(inside, row, 0)) * stride
        yield part, across * inside, along, cell[:, :, None] + column[:, None]


def on_chords(
    radius: Float[Tensor, " N"], sigma: Float[Tensor, " N"]
) -> tuple[Float[Tensor, "J N"], Float[Tensor, "J N"], Float[Tensor, "J N"]]:
    """A disc-shaped blur of a radius (px) as J weighted horizontal chords: offsets along v, half lengths, weights.

    Gauss-Chebyshev quadrature of the second kind, whose weight is the chord's length: exact for polynomials up to
    degree 2 J - 1 in the offset. J grows with the largest radius / sigma, so that the Gaussian is resolved.
    """
    ratio = float((radius.detach() / sigma.detach()).max()) if len(radius) else 0.0
    nodes = nodes_across(ratio)
    place, weight = disc_chords(nodes, radius)
    half = ((1 - place.square()).sqrt()[:, None] * radius).clamp(min=_MIN_CHORD)
    return place[:, None] * radius, half, weight[:, None].expand_as(half)


def accumulate(total: Tensor, index: Tensor, values: Tensor) -> Tensor:
    """``total`` with ``values`` added at ``index``; in place where nobody differentiates: it may be a whole frame."""
    add = total.index_add if torch.is_grad_enabled() else total.index_add_
    return add(0, index, values)


def nodes_across(ratio: float) -> int:
    """Nodes of a Gauss rule that average an edge over an interval of half the length ``ratio`` sigma to 1e-5."""
    return 2 + math.ceil(1.9 * ratio)


def _posed(camera: Camera, R: Tensor, t: Tensor, shapes: Shapes, of: Tensor, points: tuple[Tensor, Tensor]) -> _Curves:
    """Images of curves of the shapes ``of`` (L,): points and steps (L, A, 3) of the target."""
    frame = shapes.frame[of]
    rotation = R[frame].mT
    return _Curves(frame, of, *_image(camera, points[0] @ rotation + t[frame, None], points[1] @ rotation))


def _image(camera: Camera, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (..., 2) of camera points (..., 3), images (..., 2) of their steps, and which points are seen (...,)."""
    z = x[..., 2:]
    normalised = x[..., :2] / z
    d_normalised = (dx[..., :2] - normalised * dx[..., 2:]) / z
    tangent = (camera.J_distort(normalised) @ d_normalised[..., None]).squeeze(-1)
    valid = (x[..., 2] > 0) & (normalised.detach().norm(dim=-1) < camera.fold_radius)
    return camera.distort(normalised), tangent, valid


def _on_circle(axes: Tensor, bend: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Points (..., 3) of circles of radii ``axes`` (..., 2, 3) about the origin, and derivatives by angle (...).

    They leave their plane by ``bend`` (..., 3, 3), see `torchpose.sim.shapes.Circles`.
    """
    a, b = axes.unbind(-2)
    cos, sin = angle.cos()[..., None], angle.sin()[..., None]
    point, slope = cos * a + sin * b, cos * b - sin * a
    if not bool(bend.any()):
        return point, slope
    across, mixed, along = bend.unbind(-2)
    point = point + cos.square() * across + cos * sin * mixed + sin.square() * along
    return point, slope + 2 * cos * sin * (along - across) + (cos.square() - sin.square()) * mixed


def _in_view(camera: Camera, shapes: Shapes, curves: Sequence[_Curves], reach: Tensor) -> Tensor:
    """(S,) bool, shapes whose outlines are all valid and come within reach (S,) of the frame."""
    shape = torch.cat([c.shape for c in curves])
    low, high = (torch.cat([c.pixel.amin(1) for c in curves]), torch.cat([c.pixel.amax(1) for c in curves]))
    low, high = _extent(low, high, shape, len(shapes))
    whole = torch.ones(len(shapes), dtype=torch.bool, device=low.device)
    whole[shape[~torch.cat([c.valid.all(1) for c in curves])]] = False
    return whole & ((high > -reach[:, None]) & (low < _frame_size(camera, low) + reach[:, None])).all(-1)


def _extent(low: Tensor, high: Tensor, index: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Least of low (N, 2) and greatest of high (N, 2) by index (N,): (count, 2) each, infinite where there is none."""
    to = index[:, None].expand_as(low)
    return (
        low.new_full((count, 2), torch.inf).scatter_reduce(0, to, low, "amin"),
        low.new_full((count, 2), -torch.inf).scatter_reduce(0, to, high, "amax"),
    )


def _frame_size(camera: Camera, like: Tensor) -> Tensor:
    return torch.tensor([camera.width, camera.height], dtype=like.dtype, device=like.device)


def _sign(x: Tensor) -> Tensor:
    return torch.where(x < 0, -1.0, 1.0).to(x)


def _on_pixel(order: int, x: Tensor, sigma: Tensor) -> Tensor:
    """Difference over the pixel about x of a Gaussian's antiderivative: the first with ``order`` 1, and so on."""
    function = _ANTIDERIVATIVES[order]
    difference = function((x + 0.5) / sigma) - function((x - 0.5) / sigma)
    return difference if order == 1 else sigma ** (order - 1) * difference


def _row_integral(order: int, x: Tensor, sigma: Tensor, half: Tensor | None) -> Tensor:
    """As `_on_pixel`, of the Gaussian convolved with a box of a half width and the area 1."""
    if half is None:
        return _on_pixel(order, x, sigma)
    return (_on_pixel(order + 1, x + half, sigma) - _on_pixel(order + 1, x - half, sigma)) / (2 * half)


def _density_slope(x: Tensor) -> Tensor:
    """Derivative of the density of the normal distribution."""
    return -x * _density(x)


def _density(x: Tensor) -> Tensor:
    """Density phi(x) of the normal distribution."""
    return (-0.5 * x.square()).exp() / math.sqrt(2 * math.pi)


def _normal_loss(x: Tensor) -> Tensor:
    """Integral of the normal distribution function: x Phi(x) + phi(x)."""
    return x * torch.special.ndtr(x) + _density(x)


def _normal_loss_integral(x: Tensor) -> Tensor:
    """Integral of `_normal_loss`: ((x^2 + 1) Phi(x) + x phi(x)) / 2."""
    return 0.5 * ((x.square() + 1) * torch.special.ndtr(x) + x * _density(x))


# of the normal density, by their order, each the antiderivative of the one before
_ANTIDERIVATIVES: dict[int, Callable[[Tensor], Tensor]] = {
    -1: _density_slope,
    0: _density,
    1: torch.special.ndtr,
    2: _normal_loss,
    3: _normal_loss_integral,
}

"""Centres of printed marks of several shapes, each by a sub-pixel method of its own, on the same edge points.

For the comparison of shapes (paper, section III-A). Every mark is localised from a rough outline, as detection would
give it; edges are Zernike edges for all shapes. Polygons become straight lines by weighted total least squares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.geometry.least_squares import geman_mcclure
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import segment_sum
from torchpose.rings import ideal_pixels, zernike

_REACH = 2.0  # px on either side of the rough outline
_LEAST_STEP = 40.0  # grey levels
_LEAST_SLOPE = 0.3  # of measured offsets over true ones: a wider blur stays uncorrected
_LEAST_POINTS = 6  # of a line or a circle
_SCALES = (1.0, 0.3, 0.3, 0.3)  # px, of the robust weights


@dataclass(frozen=True, eq=False)
class EdgePoints(Rows):
    """Sub-pixel edges near outlines, px."""

    points: Float[Tensor, "P 2"]
    curve: Int[Tensor, " P"]  # frame times E plus the curve's number
    count: int = shared()  # frames times E


def edge_points(frames: Tensor, outline: Tensor, blur: float, camera: Camera | None = None) -> EdgePoints:
    """Zernike edges at the pixels near rough outlines.

    Args:
        frames: (B, H, W) grey.
        outline: (B, E, S, 2) px, S points along each of E curves, a pixel apart or so.
        blur: px, of the point-spread function; the edges are freed from what it does to their offsets.
        camera: takes its distortion off the points; None leaves them as they are.
    """
    batch, curves, _, _ = outline.shape
    height, width = frames.shape[-2:]
    normal, _ = _sides(torch.cat([outline, 2 * outline[:, :, -1:] - outline[:, :, -2:-1]], 2))
    offset = torch.arange(-_REACH, _REACH + 0.1, 0.5, dtype=outline.dtype, device=outline.device)[:, None]
    pixel = (outline[..., None, :] + offset * normal[..., None, :]).round().long().flatten(2, 3)
    curve = torch.arange(batch * curves, device=pixel.device).view(batch, curves, 1).expand(pixel.shape[:-1])
    margin = zernike.MASK // 2
    clear = ((pixel >= margin) & (pixel < pixel.new_tensor([width - margin, height - margin]))).all(-1)
    key = ((curve * height + pixel[..., 1]) * width + pixel[..., 0])[clear].unique()
    pixels = torch.stack([key % width, key // width % height], -1)
    curve = key // (width * height)
    edges = zernike.locate(frames.contiguous(), curve // curves, pixels)
    relative = 2 * math.sqrt(blur * blur + 1 / 12) / zernike.MASK
    slope = torch.full_like(edges.offset, max(1 - 3 * relative * relative, _LEAST_SLOPE))
    shift = zernike.deblur(edges.offset, slope)[:, None] * edges.normal
    keep = (shift.abs() <= 0.5).all(-1) & (edges.step > _LEAST_STEP)
    points = (pixels + shift)[keep]
    return EdgePoints(points if camera is None else ideal_pixels(camera, points), curve[keep], batch * curves)


def _sides(points: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals (..., S - 1, 2) and lengths (..., S - 1, 1) of the steps along curves (..., S, 2)."""
    step = points.diff(dim=-2)
    length = step.norm(dim=-1, keepdim=True)
    return torch.stack([-step[..., 1], step[..., 0]], -1) / length, length


def fit_lines(edges: EdgePoints) -> tuple[Tensor, Tensor]:
    """Straight lines (L, 3) homogeneous, n x + n y + c = 0 with unit n, and the number of points that count (L,).

    Total least squares with Geman-McClure weights of falling scale; NaN where fewer than `_LEAST_POINTS` count.
    """
    weight = torch.ones_like(edges.points[:, 0])
    for scale in (*_SCALES, 0.0):
        total = segment_sum(weight, edges.curve, edges.count)
        mean = segment_sum(weight[:, None] * edges.points, edges.curve, edges.count) / total.clamp_min(1e-9)[:, None]
        away = edges.points - mean[edges.curve]
        spread = segment_sum(weight[:, None, None] * away[:, :, None] * away[:, None], edges.curve, edges.count)
        normal = torch.linalg.eigh(spread).eigenvectors[:, :, 0]
        if scale:
            weight = geman_mcclure((away * normal[edges.curve]).sum(-1) / scale)
    line = torch.cat([normal, -(normal * mean).sum(-1, keepdim=True)], -1)
    return torch.where(total[:, None] > _LEAST_POINTS, line, torch.nan), total


def meet(a: Tensor, b: Tensor) -> Tensor:
    """Intersections (..., 2) of homogeneous lines (..., 3)."""
    x = torch.linalg.cross(a, b)
    return x[..., :2] / x[..., 2:]


def diagonals(sides: Tensor) -> Tensor:
    """Centre (..., 2) of a square seen in perspective: where the diagonals of its sides (..., 4, 3) meet."""
    corner = torch.nn.functional.pad(meet(sides, sides.roll(-1, -2)), (0, 1), value=1.0)
    return meet(*torch.linalg.cross(corner[..., :2, :], corner[..., 2:, :]).unbind(-2))


def fit_circles(edges: EdgePoints, outline: Tensor) -> Tensor:
    """Ellipses (B, E, 5) px of circles from a rough outline (B, E, S, 2); NaN where too few points follow."""
    index = torch.arange(edges.count, device=outline.device).repeat_interleave(outline.shape[2])
    rough = ellipse.fit(outline.reshape(-1, 2), index, edges.count)
    found, keep = ellipse.fit_robust(edges.points, edges.curve, edges.count, start=rough)
    many = segment_sum(keep.double(), edges.curve, edges.count) > _LEAST_POINTS
    return torch.where(many[:, None], found, torch.nan).unflatten(0, (-1, outline.shape[1]))


def by_circles(edges: EdgePoints, outline: Tensor, radii: Sequence[float]) -> Tensor:
    """Centres (B, 2) of discs (one radius: the ellipse's centre) or rings (two: compensated by eq. (7))."""
    center = fit_circles(edges, outline)[..., :2]
    if len(radii) == 1:
        return center[:, 0]
    outer, inner = (radius**2 for radius in radii)
    return (outer * center[:, 1] - inner * center[:, 0]) / (outer - inner)


def by_diagonals(edges: EdgePoints) -> Tensor:
    """Centres (B, 2) of squares from their four sides."""
    return diagonals(fit_lines(edges)[0].unflatten(0, (-1, 4)))


def by_cross(edges: EdgePoints, bar: float) -> Tensor:
    """Centres (B, 2) of crosses: of the square where the bars meet and of the square around.

    Curves: the four lines along the bars' sides, then the four ends. Both centres are weighted by the information of
    their corners (derived): with n points on lines of the extent E, a corner of the inner square has the variance
    (1 + 3 b^2 / (1 + b + b^2)) / n, one of the outer square, to which the short ends are extended, (1 + 3 / b^2) / n.

    Args:
        bar: b, width of the bars over their extent.
    """
    lines, points = fit_lines(edges)
    inner, outer = lines.unflatten(0, (-1, 2, 4)).unbind(1)
    spread = points.new_tensor([1 + 3 * bar**2 / (1 + bar + bar**2), 1 + 3 / bar**2])
    total = (points.unflatten(0, (-1, 2, 4)).sum(-1) / spread)[..., None]
    centers = torch.stack([diagonals(inner), diagonals(outer)], 1)
    weight = torch.where(centers.isnan(), 0.0, total)
    return (weight * centers.nan_to_num(nan=0.0)).sum(1) / weight.sum(1)


def by_corner(frames: Tensor, start: Tensor, half: int) -> Tensor:
    """Chessboard vertices (B, 2) by `cv2.cornerSubPix`, from ``start``, in a window of 2 ``half`` + 1 px."""
    found = start.clone()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
    for k, frame in enumerate(frames.cpu().numpy()):
        at = start[k].cpu().numpy().astype(np.float32).reshape(1, 1, 2)
        found[k] = torch.from_numpy(cv2.cornerSubPix(frame, at, (half, half), (-1, -1), criteria)[0, 0].astype(float))
    return found


def by_centroid(frames: Tensor, start: Tensor, half: float, dark: float, light: float) -> Tensor:
    """Centres (B, 2): darkness-weighted means of a round window of the radius ``half`` px that follows them."""
    height, width = frames.shape[-2:]
    u = torch.arange(width, dtype=start.dtype, device=start.device)
    v = torch.arange(height, dtype=start.dtype, device=start.device)[:, None]
    darkness = (light - frames.double()) / (light - dark)
    center = start.clone()
    for _ in range(8):
        inside = (half + 0.5 - torch.hypot(u - center[:, :1, None], v - center[:, 1:, None])).clamp(0, 1)
        weight = inside * darkness
        center = torch.stack([(weight * u).sum((1, 2)), (weight * v).sum((1, 2))], -1) / weight.sum((1, 2))[:, None]
    return center


def centre_bound(outline: Tensor, edge_noise: float) -> Tensor:
    """(B,) px, root mean square per axis of the least error of a centre, from all edges of a known shape.

    Inverse of the information sum n n^T ds / e^2 of edges whose position over 1 px of length has the standard deviation
    e (`torchpose.analysis.edge_noise`).

    Args:
        outline: (B, E, S, 2) px.
        edge_noise: e, px.
    """
    normal, length = _sides(outline)
    length = torch.where(length > 3 * length.median(2, keepdim=True).values, 0.0, length)  # a gap between two edges
    information = (length[..., None] * normal[..., :, None] * normal[..., None, :]).sum((1, 2)) / edge_noise**2
    return (torch.linalg.inv(information).diagonal(dim1=1, dim2=2).sum(-1) / 2).sqrt()

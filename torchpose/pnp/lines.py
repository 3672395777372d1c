"""Pose from lines (PnL): a linear start (Pribyl, Zemcik, Cadik, CVIU 161, 2017), then the maximum-likelihood estimate.

A point of an object line lies in the plane through the camera centre and the image line: one linear equation in the
entries of [R t] for each of two points of every line. The refinement minimises the distances, in the image, of the
projected end points of the object lines from the observed lines.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.pnp.candidates import Candidates
from torchpose.pnp.dlt import least_eigenvectors, nearest_rotation
from torchpose.pnp.iterative import minimise
from torchpose.pnp.normal_equations import Observations
from torchpose.pnp.planar import COLLINEARITY, FLATNESS, plane_frame


def lines(
    object_lines: Tensor, image_lines: Tensor, mask: Tensor | None = None, *, max_iterations: int = 30
) -> Candidates:
    """Pose of straight lines.

    Args:
        object_lines: (N, 2, 3) or (B, N, 2, 3), two points of each line; N >= 4 lines in a plane, N >= 6 otherwise, not
            all through one point nor all parallel.
        image_lines: (B, N, 2, 2), two points of the image of each line, undistorted normalised coordinates; they need
            not be the images of the object points.
        mask: (B, N) bool, True where a line was seen.
        max_iterations: of the refinement; 0 returns the linear start.

    Returns:
        `Candidates` with S = 1. ``rms`` is that of the distances of projected object points from the image lines; NaN
        where the lines do not fix the pose or the refinement does not converge.

    Raises:
        ValueError: the shapes do not fit.
    """
    if image_lines.ndim != 4 or image_lines.shape[2:] != (2, 2):
        raise ValueError(f"image_lines has shape {tuple(image_lines.shape)}; expected (B, N, 2, 2)")
    batch, count = image_lines.shape[:2]
    if object_lines.shape not in ((count, 2, 3), (batch, count, 2, 3)):
        raise ValueError(
            f"object_lines has shape {tuple(object_lines.shape)}; expected ({count}, 2, 3) or ({batch}, {count}, 2, 3)"
        )
    if mask is not None and mask.shape != (batch, count):
        raise ValueError(f"mask has shape {tuple(mask.shape)}; expected ({batch}, {count})")
    ends = image_lines.double().permute(3, 2, 1, 0)  # (2, end, N, B)
    points = object_lines.to(ends).expand(batch, count, 2, 3).permute(3, 2, 1, 0)  # (3, end, N, B)
    if mask is not None:
        points, ends = torch.where(mask.T, points, 0.0), torch.where(mask.T, ends, 0.0)
    dx, dy = ends[:, 1] - ends[:, 0]
    normal = torch.stack([-dy, dx]) / (dx.square() + dy.square()).sqrt()  # (2, N, B)
    points, foot = points.flatten(1, 2), ends[:, :1].expand(2, 2, count, batch).flatten(1, 2)
    weight = None
    if mask is not None:
        normal = torch.where(mask.T, normal, 0.0)
        weight = torch.cat([mask.T, mask.T]).to(points)
    normal = torch.cat([normal, normal], 1)  # (2, 2N, B)

    frame, center, extent = plane_frame(points, weight)
    offset = (points - center[:, None]) / extent[2]
    if weight is not None:
        offset = offset * weight
    plane = torch.stack([(frame[k, :, None] * offset).sum(0) for k in range(3)])
    flat = extent[0] <= FLATNESS * extent[2]
    # the image line as a plane through the camera centre: n . (x, y, 1) = 0
    n = torch.cat([normal, -(normal * foot).sum(0, keepdim=True)])
    ones = torch.ones_like(n[:1]) if weight is None else weight[None]
    r, t = (torch.full((3, *shape), torch.nan, dtype=n.dtype, device=n.device) for shape in ((3, batch), (batch,)))
    for planar, rows in ((True, flat.nonzero().squeeze(1)), (False, (~flat).nonzero().squeeze(1))):
        if len(rows):
            coordinates = torch.cat([plane[:2] if planar else plane, ones])[..., rows]
            r[..., rows], t[:, rows] = _linear(coordinates, n[..., rows])
    r = (r[:, :, None] * frame).sum(1)
    r = torch.where(extent[1] > COLLINEARITY * extent[2], r, torch.nan)

    # distance from a line: the component of the residual along its normal
    whitening = torch.stack([normal, torch.zeros_like(normal)])
    observed = Observations(offset, foot, whitening)
    valid = torch.ones_like(flat)
    if max_iterations > 0:
        estimate = minimise(observed, torch.cat([r, t[:, None]], 1), max_iterations=max_iterations)
        r, t, valid = estimate.pose[:, :3], estimate.pose[:, 3], estimate.converged
    x, y, z = r[:, 0, None] * offset[0] + r[:, 1, None] * offset[1] + r[:, 2, None] * offset[2] + t[:, None]
    distance = n[0] * x / z + n[1] * y / z + n[2]
    seen = 2 * count if weight is None else weight.sum(0)
    rms = (distance.square().sum(0) / seen).sqrt()
    valid = valid & (z > 0).all(0) & rms.isfinite()
    t = t * extent[2] - (r * center).sum(1)
    r, t, rms = (torch.where(valid, v, torch.nan)[..., None, :] for v in (r, t, rms))
    return Candidates(r.permute(3, 2, 0, 1), t.permute(2, 1, 0), rms.T)


def _linear(coordinates: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """R (3, 3, B) and t (3, B) with the least sum of (n . [R t] X)^2, X (3|4, 2N, B) homogeneous, n (3, 2N, B)."""
    width = coordinates.shape[0]
    row = (n[:, None] * coordinates).flatten(0, 1)
    p = least_eigenvectors((row[:, None] * row).sum(2))[:, :, 0].unflatten(1, (3, width))  # (B, 3, width)
    p = p * torch.where(p[:, 2:, -1:] < 0, -1.0, 1.0)
    m = p[:, :, :-1]
    if width == 3:  # a plane: the third column follows from the first two, of about equal length
        length = (m[:, :, 0].norm(dim=1) * m[:, :, 1].norm(dim=1)).sqrt()[:, None, None]
        m = m / length
        m = torch.cat([m, torch.linalg.cross(m[:, :, 0], m[:, :, 1])[:, :, None]], 2)
        t = p[:, :, -1] / length[:, 0]
    else:
        t = p[:, :, -1] / torch.linalg.det(m).abs().pow(1 / 3)[:, None]
        m = m * torch.linalg.det(m).sign()[:, None, None]
    return nearest_rotation(m).permute(1, 2, 0), t.T

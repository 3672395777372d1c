"""Pose from lines (PnL): a linear start (Pribyl, Zemcik, Cadik, CVIU 161, 2017), then the maximum-likelihood estimate.

A point of an object line lies in the plane through the camera centre and the image line: one linear equation in the
entries of [R t] for each of two points of every line. The refinement minimises the distances, in the image, of the
projected end points of the object lines from the observed lines.
"""

import torch
from torch import Tensor

from torchpose.errors import ArgumentError
from torchpose.geometry.arguments import one_device
from torchpose.pnp.candidates import Candidates, expect, expect_mask
from torchpose.pnp.dlt import least_eigenvectors, nearest_rotation
from torchpose.pnp.iterative import minimise
from torchpose.pnp.normal_equations import Observations
from torchpose.pnp.planar import Frame, plane_frame


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
        ArgumentError: the shapes do not fit.
    """
    points, foot, n, weight = _constraints(object_lines, image_lines, mask)
    frame = plane_frame(points, weight)
    unit = frame.extent[2]
    offset = (points - frame.center[:, None]) / unit
    if weight is not None:
        offset = offset * weight
    pose = _start(frame, offset, n, weight)
    valid = torch.ones_like(frame.flat)
    if max_iterations > 0:
        # distance from a line: the component of the residual along its normal
        observed = Observations(offset, foot, torch.stack([n[:2], torch.zeros_like(n[:2])]))
        estimate = minimise(observed, pose, max_iterations=max_iterations)
        pose, valid = estimate.pose, estimate.converged
    r = pose[:, :3]
    x, y, z = r[:, 0, None] * offset[0] + r[:, 1, None] * offset[1] + r[:, 2, None] * offset[2] + pose[:, 3, None]
    distance = n[0] * x / z + n[1] * y / z + n[2]
    rms = (distance.square().sum(0) / (len(distance) if weight is None else weight.sum(0))).sqrt()
    valid = valid & (z > 0).all(0) & rms.isfinite()
    t = pose[:, 3] * unit - (r * frame.center).sum(1)
    r, t, rms = (torch.where(valid, v, torch.nan)[..., None, :] for v in (r, t, rms))
    return Candidates(r.permute(3, 2, 0, 1), t.permute(2, 1, 0), rms.T)


def _constraints(
    object_lines: Tensor, image_lines: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Points (3, 2N, B) of the object lines, of each a point (2, 2N, B) of its image line, the plane through this and
    the camera centre, n . (x, y, 1) = 0 (3, 2N, B), and weights (2N, B)."""
    if image_lines.ndim != 4 or image_lines.shape[2:] != (2, 2):
        raise ArgumentError(f"image_lines: has shape {tuple(image_lines.shape)}; give (B, N, 2, 2)")
    batch, count = image_lines.shape[:2]
    expect("object_lines", object_lines, (count, 2, 3), (batch, count, 2, 3))
    expect_mask(mask, (batch, count))
    one_device(image_lines=image_lines, object_lines=object_lines, mask=mask)
    ends = image_lines.double().permute(3, 2, 1, 0)  # (2, end, N, B)
    points = object_lines.to(ends).expand(batch, count, 2, 3).permute(3, 2, 1, 0)  # (3, end, N, B)
    if mask is not None:
        points, ends = torch.where(mask.T, points, 0.0), torch.where(mask.T, ends, 0.0)
    dx, dy = ends[:, 1] - ends[:, 0]
    normal = torch.stack([-dy, dx]) / (dx.square() + dy.square()).sqrt()  # (2, N, B)
    foot = ends[:, :1].expand_as(ends).flatten(1, 2)
    if mask is not None:
        normal = torch.where(mask.T, normal, 0.0)
    normal = torch.cat([normal, normal], 1)
    n = torch.cat([normal, -(normal * foot).sum(0, keepdim=True)])
    return points.flatten(1, 2), foot, n, None if mask is None else torch.cat([mask.T, mask.T]).to(points)


def _start(frame: Frame, offset: Tensor, n: Tensor, weight: Tensor | None) -> Tensor:
    """Linear poses (3, 4, B) of points (3, 2N, B), NaN where these lie on a line."""
    plane, flat = frame.local(offset), frame.flat
    ones = torch.ones_like(n[:1]) if weight is None else weight[None]
    pose = n.new_full((3, 4, n.shape[2]), torch.nan)
    for axes, rows in ((2, flat.nonzero().squeeze(1)), (3, (~flat).nonzero().squeeze(1))):
        if len(rows):
            pose[..., rows] = _linear(torch.cat([plane[:axes], ones])[..., rows], n[..., rows])
    r = (pose[:, :3, None] * frame.axes).sum(1)
    return torch.cat([torch.where(frame.wide, r, torch.nan), pose[:, 3:]], 1)


def _linear(coordinates: Tensor, n: Tensor) -> Tensor:
    """[R | t] (3, 4, B) with the least sum of (n . [R t] X)^2, X (3|4, 2N, B) homogeneous, n (3, 2N, B)."""
    width = coordinates.shape[0]
    row = (n[:, None] * coordinates).flatten(0, 1)
    p = least_eigenvectors((row[:, None] * row).sum(2))[:, :, 0].unflatten(1, (3, width))  # (B, 3, width)
    p = p * torch.where(p[:, 2:, -1:] < 0, -1.0, 1.0)
    m, t = p[:, :, :-1], p[:, :, -1:]
    if width == 3:  # a plane: the third column follows from the first two, of about equal length
        length = (m[:, :, 0].norm(dim=1) * m[:, :, 1].norm(dim=1)).sqrt()[:, None, None]
        m, t = m / length, t / length
        m = torch.cat([m, torch.linalg.cross(m[:, :, 0], m[:, :, 1])[:, :, None]], 2)
    else:
        det = torch.linalg.det(m)[:, None, None]
        m, t = m * det.sign(), t / det.abs().pow(1 / 3)
    return torch.cat([nearest_rotation(m), t], 2).permute(1, 2, 0)

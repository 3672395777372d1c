"""Centres of a grid's marks by the grey values, with a camera that is known well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import pnp
from torchpose.calibration.grids.marks import Marks, find_marks
from torchpose.calibration.intrinsics import MIN_POINTS
from torchpose.calibration.tone import Sizes, scale_at
from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.geometry import conics
from torchpose.geometry.least_squares import Pose
from torchpose.geometry.projection import image_by_point
from torchpose.grids import Grid
from torchpose.refine import LEAST_KEPT, Refined, Sight, refine_photometric
from torchpose.rings import mapped
from torchpose.target import Target

_HELD = 1e12  # information about the rotation of a mark: as good as known
_SIZE = (
    0.03  # of the marks' size: what is not flat, printed unevenly, or the pose's depth; dots of 6 px tell it no better
)
_OPEN = 1.0  # the same where the size itself is asked for
_SIZED = 300  # discs whose size is measured, about
_NEAR = 0.25  # of the outer semi-minor axis, and a pixel besides: how far a fit may move from where it starts
_UNSEEN = 3.0  # times the usual standard deviation of the batch: of a mark that was not found before, the most
_DISC = -3.0  # inner radius over the outer one, of a ring that has no hole: its inner edge is nowhere


def measure_marks(names: Sequence[str], frames: Tensor, marks: Marks, grid: Grid, camera: Camera) -> Views:
    """Views of a grid by a camera that is known well: centres of single marks, fitted to the grey values.

    As `torchpose.calibration.rings.measure_centers`: every mark is moved as a whole, its tilt held at that of the
    board's pose. Its size is that of the marks seen, not that of the file, and it may come closer or move away: so
    neither dot gain nor a wrong radius moves a centre. Marks of the board that were not found are looked for where the
    pose puts them.

    Args:
        names: of the B frames.
        frames: (B, H, W) uint8 or uint16.
        marks: found in these frames, see `torchpose.calibration.grids.find_marks`.
        grid: the board.
        camera: with distortion.
    """
    known, view, point, sight, start = mark_sight(frames, marks, grid, camera)
    refined = fit_alone(sight, start)
    xy = refined.t[:, :2] / refined.t[:, 2:]
    jacobian = camera.J_distort(xy) @ image_by_point(xy, refined.t[:, 2])
    covariance = jacobian @ refined.covariance[:, :3, :3] @ jacobian.mT
    pixels = camera.distort(xy)
    moved = torch.linalg.vector_norm(pixels - camera.project(start.t), dim=-1)
    good = refined.good & (refined.kept > LEAST_KEPT) & (moved < _NEAR * sight.rings[:, 0, 0, 3] + 1)
    sigma = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    good &= known | (sigma < _UNSEEN * sigma[good & known].nanmedian())
    points = grid.points.to(pixels)[point]
    return Views(view, point, points, pixels, covariance, tuple(names))[good]


def mark_sight(frames: Tensor, marks: Marks, grid: Grid, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Sight, Pose]:
    """What `measure_marks` fits: whether a mark was found, its view and number, rows of one mark each, their starts."""
    R, t, posed = _poses(marks, grid, camera)
    marks = marks[posed[marks.view]]
    radius = _radius(marks, grid, camera, R, t)
    known, view, point, start = _starts(marks, grid, camera, R, t)
    one = torch.ones_like(start[:, :1])
    nominal = _DISC if grid.discs or grid.radii is None else grid.radii[1] / grid.radii[0]
    measured = _DISC if grid.discs else float(marks.ratio.nanmedian())
    shape = torch.tensor([1.0, nominal if math.isnan(measured) else measured]).to(start)
    ellipse = _predicted(camera, R[view], start, radius)
    inner = ellipse if grid.discs else torch.cat([ellipse[:, :2], ellipse[:, 2:4] * shape[1], ellipse[:, 4:]], -1)
    sight = Sight(
        view,
        one > 0,
        torch.stack([ellipse, inner], 1)[:, None],
        one * marks.polarity.nanmedian(),
        torch.zeros_like(start)[:, None],
        start.new_tensor([0.0, 0.0, 1.0]).expand_as(start)[:, None],
        (radius * shape).expand(len(start), 2)[:, None],
        frames,
        camera,
        marks.blur.nanmedian(0).values.expand(len(start), 1, 3),
    )
    return known, view, point, sight, Pose(R[view], start)


def nominal_board(marks: Marks, grid: Grid, camera: Camera) -> Target:
    """The board as it is named, of marks as large as they look, dark or light.

    Args:
        marks: of all views, whose ellipses are in linear frames.
        grid: the board.
        camera: about right.
    """
    R, t, posed = _poses(marks, grid, camera)
    marks = marks[posed[marks.view]]
    outer = float(_radius(marks, grid, camera, R, t))
    ratio = 0.0 if grid.discs else float(marks.ratio.nanmedian())
    if math.isnan(ratio) and grid.radii is not None:
        ratio = grid.radii[1] / grid.radii[0]
    target = Target.of_grid(replace(grid, radii=(outer, ratio * outer)), "light" if _dark(marks) else "dark")
    return replace(target, grid=grid)


def _dark(marks: Marks) -> bool:
    return float(marks.polarity.nanmedian()) > 0


def sizes_of_marks(frames: Tensor, names: Sequence[str], grid: Grid, camera: Camera) -> Sizes:
    """Sizes of a grid's marks, see `torchpose.calibration.tone`: discs by the grey values, rings by their edges."""
    marks = find_marks(names, frames, grid, camera)
    R, t, posed = _poses(marks, grid, camera)
    marks = marks[posed[marks.view]]
    at = _at(grid.points.to(t)[marks.point], R, t, marks.view)
    scale = scale_at(camera, R[marks.view], at)
    outer = marks.ellipse[:, 2:4].prod(-1).sqrt()
    inner = torch.where(marks.ratio > 0, marks.ratio * outer, torch.nan)
    if grid.discs and len(marks):
        known, _, _, sight, start = mark_sight(frames, marks, grid, camera)
        some = known.nonzero()[:, 0]
        some = some[:: len(some) // _SIZED + 1]
        refined = fit_alone(sight[some], start[some], _OPEN)
        scale = scale_at(camera, refined.R, start.t[some])
        # the radius is the same for all: what is seen larger has come closer
        outer = scale * sight.radii[some, 0, 0] * start.t[some].norm(dim=-1) / refined.t.norm(dim=-1)
        inner = torch.full_like(outer, torch.nan)
    radii = [(size / scale).nanmedian() for size in (outer, inner)]
    return Sizes(scale, outer, inner, torch.stack(radii).expand(len(scale), 2))


def fit_alone(sight: Sight, start: Pose, size: float = _SIZE) -> Refined:
    """Rows of one mark fitted to the grey values: tilts are held, sizes to a relative standard deviation."""
    held = torch.diag(start.t.new_tensor([0.0, 0, 0, _HELD, _HELD, _HELD])).repeat(len(start.t), 1, 1)
    # a size is a distance; the centre does not move along the ray
    ray = start.t / (start.t.square().sum(-1, keepdim=True) * size)
    held[:, :3, :3] += ray[:, :, None] * ray[:, None]
    return refine_photometric(sight, start.R, start.t, prior=held, alike=True)


def _poses(marks: Marks, grid: Grid, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (B, 3, 3), (B, 3) of the board, and which views have one."""
    seen = marks.views(grid)
    if len(marks) == 0:
        none = marks.center.new_zeros(len(seen), 3)
        return none[:, None].expand(-1, 3, 3), none, none[:, 0] > 0
    points, pixels, mask = seen.padded()
    poses = pnp.solve(points, pixels, camera, mask=mask)
    good = poses.R.isfinite().all(-1).all(-1) & (poses.t[:, 2] > 0) & (seen.counts >= MIN_POINTS)
    return poses.R, poses.t, good


def _at(points: Tensor, R: Tensor, t: Tensor, view: Tensor) -> Tensor:
    """Points (K, 3) in the camera."""
    return (R[view] @ points[..., None])[..., 0] + t[view]


def _radius(marks: Marks, grid: Grid, camera: Camera, R: Tensor, t: Tensor) -> Float[Tensor, ""]:
    """Outer radius of the marks, mm: the median of those that the areas of their ellipses tell."""
    at = _at(grid.points.to(t)[marks.point], R, t, marks.view)
    xy = at[:, :2] / at[:, 2:]
    by_plane = camera.J_distort(xy) @ image_by_point(xy, at[:, 2]) @ R[marks.view][..., :2]
    return (marks.ellipse[:, 2:4].prod(-1) / by_plane.det().abs()).sqrt().median()


def _starts(marks: Marks, grid: Grid, camera: Camera, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Every mark to be fitted: whether it was found, its view and number, and where it starts in the camera, mm.

    Marks that were found start where they were seen, at the depth that the pose gives them.
    """
    found = torch.zeros(len(R), len(grid.points), dtype=torch.int64, device=t.device).fill_(-1)
    found[marks.view, marks.point] = torch.arange(len(marks), device=t.device)
    posed = (found >= 0).any(1)
    view, point = posed[:, None].expand_as(found).nonzero().unbind(-1)
    at, mark = _at(grid.points.to(t)[point], R, t, view), found[view, point]
    xy = camera.undistort_points(marks.center[mark.clamp_min(0)])
    seen = torch.cat([xy, torch.ones_like(xy[:, :1])], -1) * at[:, 2:]
    start = torch.where((mark >= 0)[:, None], seen, at)
    pixels = camera.project(start)
    limit = pixels.new_tensor([camera.width - 1, camera.height - 1])
    in_view = ((pixels > 0) & (pixels < limit)).all(-1) & (start[:, 2] > 0)
    in_view &= (start[:, :2] / start[:, 2:]).norm(dim=-1) < camera.fold_radius
    return (mark >= 0)[in_view], view[in_view], point[in_view], start[in_view]


def _predicted(camera: Camera, R: Tensor, center: Tensor, radius: Tensor) -> Tensor:
    """Ellipses (K, 5), raw px, of circles that lie as the board does, in planes turned by R (K, 3, 3)."""
    k, normal = camera.matrix, R.new_tensor([0.0, 0.0, 1.0]).expand(len(R), 3)
    ideal = conics.circle_ellipse(k, R, center, normal, radius.expand(len(R)))
    return mapped(ideal, lambda points: camera.distort((points - k[:2, 2]) / k.diagonal()[:2]))

"""Views of ring targets: markers found with a rough camera, then their centres from the grey values."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchpose.calibration.plate import GAIN_SIGMA
from torchpose.calibration.views import Rims, Views
from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.detect import find_candidates
from torchpose.geometry.least_squares import solve_scaled
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.robust import LEAST_KEPT
from torchpose.geometry.rotations import plane_axes
from torchpose.identify import MarkerTable, drawn_radii, identify
from torchpose.pipeline import Method, PoseEstimator
from torchpose.pose import common_center, raw_centers
from torchpose.refine import Refined, Sight, refine_photometric
from torchpose.results import Status
from torchpose.rings import measure_rings
from torchpose.target import Target

_HELD = 1e12  # information about the rotation of a marker: as good as known
_TURNED = 3e-3  # rad: a plate out of flat by 40 um turns its markers by so much against the plane of the file
_GAIN_OPEN = 1e-8  # information about the edge gain, mm^-2: none
_RIM_POINTS = 24  # of a circle: sums over it are exact up to the perspective's high orders
_LEAST_TURN = 1e-6  # px^2 of displacement a rad^2 that a turn must make to count: one about the normal makes none


def find_rings(names: Sequence[str], frames: Tensor, cameras: Sequence[Camera], target: Target) -> list[Views]:
    """Views of a target by cameras that are rough guesses: the exact common centres of each ring's two ellipses.

    Args:
        names: of the B frames.
        frames: (B, H, W), see `torchpose.PoseEstimator`.
        cameras: to identify the markers with, one after the other; if there are several, all without distortion.

    Returns:
        The views of each camera. Which ring is which depends little on the camera, the centres hardly at all.
    """
    candidates = find_candidates(_grey(frames))
    table = MarkerTable.of([target])
    candidates = candidates[torch.isin(candidates.polarity, table.polarity)]
    rings = measure_rings(_grey(frames), candidates, cameras[0])
    every = []
    for camera in cameras:
        ring = identify(rings, table, camera, len(frames), 1).ring
        view, marker = (ring >= 0).nonzero().unbind(-1)
        at = ring[view, marker]
        center, covariance = common_center(rings.outer[at], rings.inner[at], target.printed_radii[marker])
        # ellipses are in the pixels of the first camera without its distortion
        pixels, covariance = raw_centers(cameras[0], center, covariance)
        every.append(Views(view, target.ids[marker], target.centers[marker], pixels, covariance, tuple(names)))
    return every


def _grey(frames: Tensor) -> Tensor:
    return 255.0 * frames if frames.is_floating_point() else frames


def measure_centers(
    names: Sequence[str],
    frames: Tensor,
    camera: Camera,
    target: Target,
    *,
    tilts: Literal["held", "open"] = "held",
) -> Views:
    """Views of a target by a camera that is known well: centres of single markers, fitted to the grey values.

    Every marker is moved as a whole, its tilt held at that of the target's pose and its edges moved by an edge gain of
    its own, until its rendered rings agree with the pixels around them; its centre then projects to the point seen. So
    no ellipse is fitted, and no centre is compensated. Errors of the camera enter through the small tilt and distortion
    across one marker only.

    Args:
        tilts: open: what the rims tell is asked for, too, and the tilt of every marker is known to a few mrad only.
    """
    rims = tilts == "open"
    # a board's many centres tell its pose well enough to start from
    method: Method = "photometric" if target.grid is None else "centers"
    poses = PoseEstimator(camera, target.upright(), method=method)(frames)
    found = poses.detections
    usable = (poses.status == Status.OK) | (poses.status == Status.AMBIGUOUS)
    found = found[usable[found.frame]]
    marker = (found.marker[:, None] == target.ids).long().argmax(1)
    points, rotation = target.centers[marker], poses.R[found.frame]
    arm = (rotation @ points[..., None])[..., 0]
    radii = drawn_radii(target)[marker]
    gain: Tensor | float = _GAIN_OPEN if rims else (GAIN_SIGMA * (radii[:, 0] - radii[:, 1])) ** -2
    if target.discs:  # a larger disc, or a nearer one
        gain = _HELD
    prior = points.new_zeros(len(points), 7)
    prior[:, 3:6], prior[:, 6] = _TURNED**-2 if rims else _HELD, gain
    one = torch.ones_like(points[:, :1])
    sight = Sight(
        found.frame,
        one > 0,
        torch.stack([found.outer, found.outer if target.discs else found.inner], 1)[:, None],
        one if target.background == "light" else -one,
        torch.zeros_like(points)[:, None],
        target.normals[marker][:, None],
        radii[:, None],
        _grey(frames),
        camera,
    )
    start = arm + poses.t[found.frame]
    refined = refine_photometric(sight, rotation, start, prior=torch.diag_embed(prior), alike=True)
    xy = refined.t[:, :2] / refined.t[:, 2:]
    jacobian = camera.J_distort(xy) @ image_by_point(xy, refined.t[:, 2])
    covariance = jacobian @ refined.covariance[:, :3, :3] @ jacobian.mT
    pixels = camera.distort(xy)
    good = refined.good & (refined.kept > LEAST_KEPT) & pixels.isfinite().all(-1)
    shapes = _rims(refined, sight) if rims else None
    return Views(found.frame, found.marker, points, pixels, covariance, tuple(names), shapes)[good]


def _rims(refined: Refined, sight: Sight) -> Rims:
    """What the rims of K rings tell, each a row with one marker; their blurs are unknown."""
    assert refined.gain is not None  # asked for by the prior
    information, pull = refined.normals.information[:, 0], refined.normals.right[:, 0]
    asked = [*range(6), information.shape[-1] - 1]
    blur = [k for k in range(information.shape[-1]) if k not in asked]
    mixed = information[:, asked][:, :, blur]
    columns = torch.cat([mixed.mT, pull[:, blur, None]], -1)
    taken = mixed @ solve_scaled(information[:, blur][:, :, blur], columns)
    information, pull = information[:, asked][:, :, asked] - taken[..., :-1], pull[:, asked] - taken[..., -1]
    gain = sight.polarity * refined.gain[:, None]
    radii = sight.radii[:, 0] + gain * gain.new_tensor([1.0, -1.0])
    by_camera = rims_by_camera(sight.camera, refined.R, refined.t, sight.normals[:, 0], radii)
    by_camera[:, 6] *= sight.polarity  # its gain is that of the rings, not of what is dark
    information = 0.5 * (information + information.mT)
    return Rims(refined.R, refined.t, refined.gain, information, pull, by_camera, (sight.camera,))


def rims_by_camera(camera: Camera, R: Tensor, t: Tensor, normals: Tensor, radii: Tensor) -> Tensor:
    """How place, turn and edge gain of K rings, fitted to their rims, follow the intrinsics (K, 7, n).

    Args:
        R: (K, 3, 3), of the target's frame.
        t: (K, 3), centres, mm.
        normals: (K, 3), in the frame of the target.
        radii: (K, 2).
    """
    jacobian, by_camera = rim_derivatives(camera, R, t, normals, radii)
    held = torch.nn.functional.pad(t.new_full((3,), _LEAST_TURN), (3, 1))
    return torch.linalg.solve(jacobian.mT @ jacobian + torch.diag(held), jacobian.mT @ by_camera)


def rim_derivatives(camera: Camera, R: Tensor, t: Tensor, normals: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements of rims across themselves, times the root of their length in px, at points all along them.

    Returns:
        By place, turn and edge gain (K, E, 7), and by the intrinsics (K, E, n).
    """
    angle = torch.arange(_RIM_POINTS, dtype=t.dtype, device=t.device) * (2 * math.pi / _RIM_POINTS)
    one, two = ((R @ axis[..., None]).squeeze(-1)[:, None, None] for axis in plane_axes(normals))
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    out, around = cos * one + sin * two, cos * two - sin * one  # (K, 1, E, 3)
    arm = radii[..., None, None] * out
    at = (arm + t[:, None, None]).flatten(1, 2)
    xy = at[..., :2] / at[..., 2:]
    by_point = camera.J_distort(xy) @ image_by_point(xy, at[..., 2])
    tangent = (by_point @ (radii[..., None, None] * around).flatten(1, 2)[..., None]).squeeze(-1)
    length = tangent.norm(dim=-1, keepdim=True) * (2 * math.pi / _RIM_POINTS)
    across = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / tangent.norm(dim=-1, keepdim=True)
    across = (across * length.sqrt())[..., None, :]
    outwards = (out * radii.new_tensor([1.0, -1.0])[:, None, None]).flatten(1, 2)[..., None]
    by_ring = torch.cat([by_pose(by_point, arm.flatten(1, 2)), by_point @ outwards], -1)
    return (across @ by_ring).squeeze(-2), (across @ by_intrinsics(camera, xy)).squeeze(-2)

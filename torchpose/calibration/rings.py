"""Views of ring targets: markers found with a rough camera, then their centres from the grey values."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.detect import find_candidates
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.robust import LEAST_KEPT
from torchpose.identify import MarkerTable, identify
from torchpose.pipeline import PoseEstimator
from torchpose.pose import common_center, raw_centers
from torchpose.refine import Sight, refine_photometric
from torchpose.results import Status
from torchpose.rings import measure_rings
from torchpose.target import Target

_HELD = 1e12  # information about the rotation of a marker: as good as known


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


def measure_centers(names: Sequence[str], frames: Tensor, camera: Camera, target: Target) -> Views:
    """Views of a target by a camera that is known well: centres of single markers, fitted to the grey values.

    Every marker is moved as a whole, its tilt held at that of the target's pose, until its rendered rings agree with
    the pixels around them; its centre then projects to the point seen. So no ellipse is fitted, and no centre is
    compensated. Errors of the camera enter through the small tilt and distortion across one marker only.
    """
    poses = PoseEstimator(camera, target)(frames)
    found = poses.detections
    usable = (poses.status == Status.OK) | (poses.status == Status.AMBIGUOUS)
    found = found[usable[found.frame]]
    marker = (found.marker[:, None] == target.ids).long().argmax(1)
    points, rotation = target.centers[marker], poses.R[found.frame]
    arm = (rotation @ points[..., None])[..., 0]
    held = torch.diag(points.new_tensor([0.0, 0, 0, _HELD, _HELD, _HELD])).expand(len(marker), 6, 6)
    one = torch.ones_like(points[:, :1])
    sight = Sight(
        found.frame,
        one > 0,
        torch.stack([found.outer, found.inner], 1)[:, None],
        one if target.background == "light" else -one,
        torch.zeros_like(points)[:, None],
        target.normals[marker][:, None],
        target.printed_radii[marker][:, None],
        _grey(frames),
        camera,
    )
    refined = refine_photometric(sight, rotation, arm + poses.t[found.frame], prior=held)
    xy = refined.t[:, :2] / refined.t[:, 2:]
    jacobian = camera.J_distort(xy) @ image_by_point(xy, refined.t[:, 2])
    covariance = jacobian @ refined.covariance[:, :3, :3] @ jacobian.mT
    pixels = camera.distort(xy)
    good = refined.good & (refined.kept > LEAST_KEPT) & pixels.isfinite().all(-1)
    return Views(found.frame, found.marker, points, pixels, covariance, tuple(names))[good]

"""Stage: candidates where the last poses put the rings, for sequences; the rest of the frames is not looked at.

Each marker gets a window, as wide as its ring and what it may have moved since. The windows are searched as frames of
their own, on the pixels that the whole frame would be reduced to: the same ellipses come out, at the cost of the rings
instead of that of all that is in sight.
"""

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Candidates, Wanted, find_coarse, merge_duplicates, reduction_factor
from torchpose.geometry.arguments import checked
from torchpose.identify.scene import Scene

MOST_MOVE = 20.0  # px between two frames (convention): 0.1 m/s at 1 m, 50 frames/s and a 12 mm lens
_OBLIQUE = 1.2  # of a ring's semi-axis f r / z: perspective and distortion within the ring (convention)
_GROUND = 6  # coarse pixels beside a ring: its edge, and ground to tell the noise from


@checked
def find_near(scene: Scene, R: Tensor, t: Tensor, wanted: Wanted) -> Candidates | None:
    """What `detect.find_coarse` would find near the markers; None where looking at all of the frames costs less.

    Args:
        scene: a row for every frame and target.
        R: (N, 3, 3), the last pose of each row, NaN where it is not known.
        t: (N, 3), the same, mm.
        wanted: as for `detect.find_coarse`.
    """
    height, width = scene.frames.shape[-2:]
    factor = reduction_factor(height, width)
    grid = 2 * factor  # corners on it, so that windows are reduced as their frames are
    row, middle, radius = _places(scene, R, t)
    if row.numel() == 0:
        return None
    half = _OBLIQUE * radius.amax() + MOST_MOVE + _GROUND * grid
    side = grid * int((2 * half / grid).ceil())
    if side > min(height, width) - grid or row.numel() * side**2 > len(scene.frames) * height * width:
        return None
    most = (middle.new_tensor([width, height]) - side) / grid
    corner = (((middle - 0.5 * side) / grid).round().clamp_min(0).minimum(most.floor()) * grid).long()
    frame, along = scene.frame[row], torch.arange(side, device=middle.device)
    x, y = (corner[:, axis, None] + along for axis in range(2))
    windows = scene.frames[frame[:, None, None], y[:, :, None], x[:, None]]
    found = find_coarse(windows, factor, wanted=wanted, float_range=255.0, among=height * width)
    ellipse = torch.cat([found.ellipse[:, :2] + corner[found.frame], found.ellipse[:, 2:]], -1)
    return merge_duplicates(replace(found, frame=frame[found.frame], ellipse=ellipse))


def _places(scene: Scene, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Row (P,), middle (P, 2) px and semi-axis (P,) px of every ring that the poses put into the frames."""
    camera: Camera = scene.camera
    markers = scene.table[scene.target]
    center = markers.centers @ R.mT + t[:, None]
    pixel = camera.project(center)
    limit = pixel.new_tensor([camera.width, camera.height])
    seen = markers.valid & ((pixel > 0) & (pixel < limit)).all(-1)  # NaN is not
    row, marker = seen.nonzero().unbind(-1)
    focal = camera.matrix.diagonal()[:2].amax()
    return row, pixel[row, marker], focal * markers.radii[row, marker, 0] / center[row, marker, 2]

"""Whether intrinsics can be those of a camera, in px: what a wrong unit or a wrong lens would make of them."""

import math

import torch
from torch import Tensor

from torchpose.camera.model import Camera, Model
from torchpose.errors import ConfigError

# Of the frame's farthest corner, in focal lengths. Rectilinear lenses see up to 135 degrees across the diagonal, and
# barrel distortion draws corners nearer (convention: tan 67.5 degrees, 2.4, and some air)
_FARTHEST_CORNER: dict[Model, float] = {"brown_conrady": 3.0, "kannala_brandt": 6.0}
# ... a fisheye of 220 degrees whose circle fills the short side of a frame of 16:9 has 1.9 x 2.04 (derived), and the
# polynomial may bend that
_NARROWEST = 1e-5  # half the frame over the focal length: a telescope of 2 m on pixels of 2 um has 1e-3 (convention)
# px from the frame to the principal point: a window at the rim of the largest sensors, 14,200 px wide, is closer
# (convention)
_FARTHEST_CENTER = 10_000.0
# of the rays of points, in focal lengths: 84 degrees off the axis. Of the median, as points may be astray (convention)
_FARTHEST_POINTS = 10.0
_POINTS_LOOKED_AT = 4096  # of a batch (convention)
_GRID = 65  # pixels along a side of the frame at which rays are looked for (convention)
_UNIT = "write fx fy cx cy in px of this frame"


def check_intrinsics(matrix: Tensor, width: int, height: int, model: Model = "brown_conrady") -> None:
    """Refuses a matrix (3, 3) that cannot be that of frames of this size.

    Raises:
        ConfigError: normalised, in mm or of another frame: an impossible field of view or principal point.
    """
    (fx, _, cx), (_, fy, cy), _ = matrix.detach().tolist()
    for name, focal, size in (("fx", fx, width), ("fy", fy, height)):
        if not 0.5 * size / focal >= _NARROWEST:
            raise ConfigError(
                f"camera_matrix: {name} is {focal:.6g} for {size} px, an impossibly narrow field of view; {_UNIT}"
            )
    for name, center, size in (("cx", cx, width), ("cy", cy, height)):
        if not -_FARTHEST_CENTER <= center <= size - 1 + _FARTHEST_CENTER:
            raise ConfigError(f"camera_matrix: {name} is {center:.6g}, far outside the frame of {size} px; {_UNIT}")
    corner = max(abs(edge - cx) for edge in (0, width - 1)) / fx, max(abs(edge - cy) for edge in (0, height - 1)) / fy
    radius = (corner[0] ** 2 + corner[1] ** 2) ** 0.5
    if not radius <= _FARTHEST_CORNER[model]:
        raise ConfigError(
            f"camera_matrix: fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g} put a corner of the frame of "
            f"{width} x {height} px {radius:.3g} focal lengths off the axis, an impossible field of view; {_UNIT}"
        )


def check_pinhole(matrix: Tensor, pixels: Tensor, seen: Tensor | None = None) -> None:
    """Refuses pinhole matrices (3, 3) or (B, 3, 3) that cannot belong to their image points (B, N, 2).

    No frame is known here, and a matrix of normalised coordinates is as good as one in px where the points are
    normalised too. So the points tell: most of them lie within the field of view of some lens.

    Args:
        matrix: what is not finite is left to others.
        pixels: image points, in the unit of the matrix.
        seen: (B, N) or (N,), those that count.

    Raises:
        ConfigError: it is no pinhole matrix, or most points lie impossibly far off its axis.
    """
    matrix, pixels = matrix.detach(), pixels.detach()
    if _plainly_right(matrix, pixels):
        return
    lowest = matrix.new_tensor([0.0, 0.0, 1.0])
    finite = matrix.isfinite().flatten(-2).all(-1)
    if bool((finite & ((matrix[..., 2, :] != lowest).any(-1) | (matrix[..., 1, 0] != 0))).any()):
        raise ConfigError("camera: is no pinhole matrix; write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    focal = matrix.diagonal(dim1=-2, dim2=-1)[..., :2]
    if bool((finite & (focal <= 0).any(-1)).any()):
        raise ConfigError("camera: a focal length is not positive; write fx and fy in the unit of image_points")
    step = len(pixels) // _POINTS_LOOKED_AT + 1
    rows = slice(None, None, step)
    center = matrix[..., :2, 2]
    if matrix.ndim == 3:
        focal, center = focal[rows, None], center[rows, None]
    radius = ((pixels[rows] - center) / focal).norm(dim=-1)
    counts = radius.isfinite()
    if seen is not None:
        counts = counts & (seen if seen.ndim == 1 else seen[rows]).bool()
    radius = radius[counts]
    if len(radius) and bool((median := radius.median()) > _FARTHEST_POINTS):
        raise ConfigError(
            f"camera: half of the image points lie {float(median):.3g} focal lengths and more off the axis, an"
            " impossible field of view; give the matrix in the unit of image_points, px as a rule"
        )


def _plainly_right(matrix: Tensor, pixels: Tensor) -> bool:
    """Whether one matrix is that of a pinhole, and all points lie well in view: then nothing else need be asked."""
    if matrix.ndim > 2 or pixels.numel() == 0:
        return False
    (fx, _, cx), (below, fy, cy), lowest = matrix.tolist()
    if not (fx > 0 and fy > 0 and below == 0 and lowest == [0.0, 0.0, 1.0]):
        return False
    low, high = (end.tolist() for end in pixels.flatten(0, 1).aminmax(dim=0))  # not a number where one point has none
    u, v = ((max(abs(a - c), abs(b - c)) / f) for a, b, c, f in zip(low, high, (cx, cy), (fx, fy), strict=True))
    return math.hypot(u, v) <= _FARTHEST_POINTS


def share_without_ray(camera: Camera) -> float:
    """Share of the frame whose pixels no ray of the lens model reaches; of a grid of pixels, corners included."""
    if not camera.distorts:
        return 0.0
    u, v = (torch.linspace(0, size - 1, _GRID, dtype=torch.float64) for size in (camera.width, camera.height))
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    weight = torch.ones(_GRID, dtype=torch.float64)
    weight[[0, -1]] = 0.5  # the rim stands for half as much of the frame
    with torch.no_grad():
        without = ~camera.undistort_points(grid).isfinite().all(-1)
    return float(weight @ without.double() @ weight) / (_GRID - 1) ** 2

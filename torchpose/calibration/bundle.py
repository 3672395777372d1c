"""Joint least squares of a camera's intrinsics and the poses of all views (bundle adjustment of a known target)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.errors import ConfigError
from torchpose.geometry import least_squares
from torchpose.geometry.least_squares import Code, Eliminated, Normal, Pose, Unknowns, Vector
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.segments import segment_sum

_ITERATIONS = 200
_DAMPING = 1e-3  # to begin with
_RELATIVE = 1e-10  # decrease that a step must promise, of the cost


@dataclass(frozen=True, eq=False)
class Bundle:
    """Least-squares estimate of n intrinsics (fx, fy, cx, cy, then the distortion) and N poses, target to camera."""

    camera: Camera
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]  # mm
    residual: Float[Tensor, "K 2"]  # seen - predicted, px
    chi2: Float[Tensor, " K"]  # in the covariances of the points
    information: Float[Tensor, "n n"]  # about the intrinsics, the poses being unknown
    pose_covariance: Float[Tensor, "N 6 6"]  # translation (mm), rotation about the camera axes; for exact intrinsics
    gain: Float[Tensor, "N 6 n"]  # d pose / d intrinsics at the optimum
    converged: bool  # whether the last step promised next to nothing


def adjust(views: Views, camera: Camera, R: Tensor, t: Tensor, *, free: bool = True) -> Bundle:
    """Levenberg-Marquardt over intrinsics and poses, the latter eliminated; residuals are whitened.

    Args:
        views: with regular covariances.
        camera: to start from; its model and number of coefficients stay.
        R: (N, 3, 3), to start from.
        t: (N, 3), to start from, mm.
        free: whether the intrinsics are unknown; otherwise only poses are found.

    Raises:
        ConfigError: the start puts points behind the camera, or the points of a view leave its pose open.
    """
    whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
    own = {"intrinsics": Vector(views.pixels.new_zeros(1, 4 + len(camera.distortion)))} if free else {}
    start = Unknowns(own, {"pose": Pose(R, t)}, views.view.new_zeros(len(views)))

    def bent(unknowns: Unknowns) -> Camera | None:
        return moved_camera(camera, unknowns.values("intrinsics")[0]) if free else camera

    def problem(unknowns: Unknowns) -> Normal:
        moved = bent(unknowns)
        if moved is None:
            return replace(problem(start), cost=views.pixels.new_full((1,), torch.inf))
        return _normal(views, moved, unknowns.pose, whiten, free)

    found = least_squares.minimise(problem, start, _ITERATIONS, damping=_DAMPING, adaptive=True, tolerance=_RELATIVE)
    moved, pose = bent(found.unknowns), found.unknowns.pose
    normal = found.normal if free or moved is None else _normal(views, moved, pose, whiten, True)
    part = normal.eliminated
    if moved is None or part is None or not bool(normal.cost.isfinite().all()):
        raise ConfigError("INPUT: a view has points behind the camera that calibration starts from; remove --camera")
    covariance, determined = least_squares.scaled_inverse(part.information)
    if not bool(determined.all()):
        raise ConfigError("INPUT: the points of a view leave its pose open; use targets whose points are not on a line")
    residual = views.pixels - moved.project(_placed(views, pose)[1])
    chi2 = (whiten @ residual[..., None]).square().sum((-1, -2))
    gain, converged = -covariance @ part.mixed.mT, int(found.code) == Code.CONVERGED
    # without the trace of a diagonal that steps are solved with: whether the views tell is decided by this
    information = normal.information[0] - (part.mixed @ covariance @ part.mixed.mT).sum(0)
    return Bundle(moved, pose.R, pose.t, residual, chi2, information, covariance, gain, converged)


def moved_camera(camera: Camera, step: Tensor) -> Camera | None:
    """The camera with intrinsics changed by ``step`` (n,); None where that is no camera."""
    matrix = camera.matrix.clone()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    if not bool(step.isfinite().all()) or float(matrix.diagonal()[:2].min()) <= 0:
        return None
    return replace(camera, matrix=matrix, distortion=camera.distortion + step[4:])


def _placed(views: Views, pose: Pose) -> tuple[Tensor, Tensor]:
    """Points about the target's origin (K, 3), and in the camera (K, 3), camera axes."""
    arm = (pose.R[views.view] @ views.points[..., None])[..., 0]
    return arm, arm + pose.t[views.view]


def _normal(views: Views, camera: Camera, pose: Pose, whiten: Tensor, free: bool) -> Normal:
    """Normal equations, of infinite cost where a point is behind the camera or beyond the lens model."""
    arm, at = _placed(views, pose)
    depth, xy = at[:, 2], at[:, :2] / at[:, 2:]
    possible = (depth > 0).all() & (xy.norm(dim=-1) < camera.fold_radius).all()
    residual = whiten @ (views.pixels - camera.distort(xy))[..., None]
    by_view = whiten @ by_pose(camera.J_distort(xy) @ image_by_point(xy, depth), arm)
    by_camera = whiten @ (by_intrinsics(camera, xy) if free else xy.new_zeros(len(xy), 2, 0))

    def of_views(values: Tensor) -> Tensor:
        return segment_sum(values, views.view, len(views))

    return Normal(
        (by_camera.mT @ by_camera).sum(0, keepdim=True),
        (by_camera.mT @ residual).sum(0)[None, :, 0],
        torch.where(possible, residual.square().sum(), torch.inf)[None],
        Eliminated(
            of_views(by_camera.mT @ by_view),
            of_views(by_view.mT @ by_view),
            of_views((by_view.mT @ residual)[..., 0]),
            views.view.new_zeros(len(views)),
        ),
    )

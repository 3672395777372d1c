"""Joint least squares of a camera's intrinsics, the poses of all views and what is unknown of the target."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose.calibration.plate import Plate
from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.errors import ConfigError
from torchpose.geometry import least_squares, rotations
from torchpose.geometry.least_squares import Code, Eliminated, Normal, Pose, Unknowns, Vector
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.segments import segment_sum

_ITERATIONS = 200
_DAMPING = 1e-3  # to begin with
Linear = tuple[Tensor, Tensor, list[Tensor]]
_RELATIVE = 1e-10  # decrease that a step must promise, of the cost


@dataclass(frozen=True, eq=False)
class Bundle:
    """Least-squares estimate of n intrinsics (fx, fy, cx, cy, then the distortion), k unknowns of the plate, N poses.

    Poses are target to camera. What is said of the intrinsics is said whether they were unknown or not; k is 0 where
    the plate is known.
    """

    camera: Camera
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]  # mm
    residual: Float[Tensor, "K 2"]  # seen - predicted, px
    chi2: Float[Tensor, " K"]  # in the covariances of the points
    information: Float[Tensor, "u u"]  # about these u = n + k unknowns, the poses being unknown, with what is known
    pose_covariance: Float[Tensor, "N 6 6"]  # translation (mm), rotation about the camera axes; for exact intrinsics
    gain: Float[Tensor, "N 6 u"]  # d pose / d intrinsics and plate at the optimum
    converged: bool  # whether the last step promised next to nothing
    plate: Float[Tensor, " k"]  # unknowns of the plate
    # of what is predicted, by the fit alone: of the pixels (d = 2), or of what the rims tell (d = 7)
    predicted: Float[Tensor, "K d d"]
    rims: Float[Tensor, "K r"]  # what rims tell less what is predicted (r = 7); none where they were not asked


def adjust(
    views: Views,
    camera: Camera,
    R: Tensor,
    t: Tensor,
    *,
    free: bool = True,
    plate: Plate | None = None,
    start: Tensor | None = None,
) -> Bundle:
    """Levenberg-Marquardt over intrinsics, plate and poses, the latter eliminated; residuals are whitened.

    Args:
        views: with regular covariances.
        camera: to start from; its model and number of coefficients stay.
        R: (N, 3, 3), to start from.
        t: (N, 3), to start from, mm.
        free: whether the intrinsics are unknown.
        plate: what is unknown of the plate, None for nothing: then the points of the views count.
        start: (k,), unknowns of the plate to start from.

    Raises:
        ConfigError: the start puts points behind the camera, or the points of a view leave its pose open.
    """
    problem = _Problem(views, camera, plate, free)
    own = {"intrinsics": Vector(views.pixels.new_zeros(1, 4 + len(camera.distortion)))} if free else {}
    if plate is not None:
        own["plate"] = Vector((plate.known.new_zeros(len(plate)) if start is None else start)[None])
    first = Unknowns(own, {"pose": Pose(R, t)}, views.view.new_zeros(len(views)))
    found = least_squares.minimise(problem, first, _ITERATIONS, damping=_DAMPING, adaptive=True, tolerance=_RELATIVE)
    unknowns = found.unknowns
    moved, pose = problem.camera_at(unknowns), unknowns.pose
    normal = found.normal if free or moved is None else problem.normal(unknowns, moved, by_camera=True)
    part = normal.eliminated
    if moved is None or part is None or not bool(normal.cost.isfinite().all()):
        raise ConfigError("INPUT: a view has points behind the camera that calibration starts from; remove --camera")
    covariance, determined = least_squares.scaled_inverse(part.information)
    if not bool(determined.all()):
        raise ConfigError("INPUT: the points of a view leave its pose open; use targets whose points are not on a line")
    residual = problem.of_pixels(unknowns, moved)
    whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
    chi2 = (whiten @ residual[..., None]).square().sum((-1, -2))
    gain, converged = -covariance @ part.mixed.mT, int(found.code) == Code.CONVERGED
    # without the trace of a diagonal that steps are solved with: whether the views tell is decided by this
    information = normal.information[0] - (part.mixed @ covariance @ part.mixed.mT).sum(0)
    z = residual.new_zeros(0) if plate is None else unknowns.values("plate")[0]
    found_at = (moved, pose.R, pose.t, residual, chi2, information, covariance, gain, converged)
    unknown = 0 if free else 4 + len(camera.distortion)
    predicted = problem.predicted(unknowns, moved, information, covariance, gain, unknown)
    return Bundle(*found_at, z, predicted, problem.of_rims(unknowns, moved))


def moved_camera(camera: Camera, step: Tensor) -> Camera | None:
    """The camera with intrinsics changed by ``step`` (n,); None where that is no camera."""
    matrix = camera.matrix.clone()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    if not bool(step.isfinite().all()) or float(matrix.diagonal()[:2].min()) <= 0:
        return None
    return replace(camera, matrix=matrix, distortion=camera.distortion + step[4:])


def intrinsics_between(camera: Camera, other: Camera) -> Tensor:
    """Intrinsics (n,) of a camera less those of another."""
    one, two = (torch.cat([c.matrix.diagonal()[:2], c.matrix[:2, 2], c.distortion]) for c in (camera, other))
    return one - two


class _Problem:
    """The normal equations of K observations: pixels, or all that rims tell where the plate has unknowns for it."""

    def __init__(self, views: Views, camera: Camera, plate: Plate | None, free: bool) -> None:
        self.views, self.plate, self.free = views, plate, free
        self.start = camera
        self.point = views.point if plate is None else plate.index(views.point)
        self.rims = views.rims if plate is not None and plate.rims else None
        if self.rims is None:
            self.whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
        else:
            self.whiten, self.best = self.rims.roots, self.rims.best

    def __call__(self, unknowns: Unknowns) -> Normal:
        moved = self.camera_at(unknowns)
        if moved is None:
            normal = self.normal(unknowns, self.start, by_camera=self.free)
            return replace(normal, cost=torch.full_like(normal.cost, torch.inf))
        return self.normal(unknowns, moved, by_camera=self.free)

    def camera_at(self, unknowns: Unknowns) -> Camera | None:
        return moved_camera(self.start, unknowns.values("intrinsics")[0]) if self.free else self.start

    def placed(self, unknowns: Unknowns) -> tuple[Tensor, Tensor]:
        """Points about the target's origin (K, 3), and in the camera (K, 3), camera axes."""
        pose, view = unknowns.pose, self.views.view
        points = self.views.points
        if self.plate is not None:
            points = self.plate.at(unknowns.values("plate")[0]).places[self.point]
        arm = (pose.R[view] @ points[..., None])[..., 0]
        return arm, arm + pose.t[view]

    def of_pixels(self, unknowns: Unknowns, camera: Camera) -> Tensor:
        """Seen less predicted (K, 2)."""
        _, at = self.placed(unknowns)
        return self.views.pixels - camera.distort(at[:, :2] / at[:, 2:])

    def of_rims(self, unknowns: Unknowns, camera: Camera) -> Tensor:
        """What the rims tell less what is predicted (K, 7); (K, 0) where they are not asked."""
        if self.rims is None or self.plate is None:
            return self.views.pixels[:, :0]
        _, at = self.placed(unknowns)
        layout = self.plate.at(unknowns.values("plate")[0]).of(self.point)
        rims, turn = self.rims, unknowns.pose.R[self.views.view] @ rotations.exp(layout.turns)
        ring = torch.cat(
            [
                rims.t - at * torch.exp(-layout.sizes)[:, None],
                rotations.log(rims.R @ turn.mT),
                (rims.gain - layout.gain)[:, None],
            ],
            -1,
        )
        return ring + self.best - rims.by_camera @ intrinsics_between(camera, rims.camera)

    def normal(self, unknowns: Unknowns, camera: Camera, *, by_camera: bool) -> Normal:
        """Normal equations, of infinite cost where a point is behind the camera or beyond the lens model."""
        views = self.views
        arm, at = self.placed(unknowns)
        depth, xy = at[:, 2], at[:, :2] / at[:, 2:]
        possible = (depth > 0).all() & (xy.norm(dim=-1) < camera.fold_radius).all()
        residual, by_view, columns = self._linear(unknowns, camera, arm, at)
        own = torch.cat(columns if by_camera else columns[1:], -1) if by_camera or columns[1:] else by_view[..., :0]
        residual, by_view, own = self.whiten @ residual[..., None], self.whiten @ by_view, self.whiten @ own

        def of_views(values: Tensor) -> Tensor:
            return segment_sum(values, views.view, len(views))

        normal = Normal(
            (own.flatten(0, 1).mT @ own.flatten(0, 1))[None],
            (own.mT @ residual).sum(0)[None, :, 0],
            torch.where(possible, residual.square().sum(), torch.inf)[None],
            Eliminated(
                of_views(own.mT @ by_view),
                of_views(by_view.mT @ by_view),
                of_views((by_view.mT @ residual)[..., 0]),
                views.view.new_zeros(len(views)),
            ),
        )
        if self.plate is None:
            return normal
        before = own.shape[-1] - len(self.plate)
        prior, moved = (pad(values, (before, 0)) for values in (self.plate.known, unknowns.values("plate")))
        return normal.with_prior(torch.diag(prior)[None], moved)

    def predicted(
        self, unknowns: Unknowns, camera: Camera, information: Tensor, poses: Tensor, gain: Tensor, known: int
    ) -> Tensor:
        """Covariance (K, d, d) of what is predicted, from that of the fit; the first intrinsics are not unknown."""
        arm, at = self.placed(unknowns)
        _, by_view, columns = self._linear(unknowns, camera, arm, at)
        view = self.views.view
        by_own = torch.cat(columns, -1)[..., known:] + by_view @ gain[view][..., known:]
        own, _ = least_squares.scaled_inverse(information[known:, known:])
        return by_own @ own @ by_own.mT + by_view @ poses[view] @ by_view.mT

    def _linear(self, unknowns: Unknowns, camera: Camera, arm: Tensor, at: Tensor) -> Linear:
        return (self._by_rims if self.rims is not None else self._by_pixels)(unknowns, camera, arm, at)

    def _by_pixels(self, unknowns: Unknowns, camera: Camera, arm: Tensor, at: Tensor) -> Linear:
        """Residuals (K, 2), derivatives of what is predicted by the pose, and by the camera and the plate."""
        xy = at[:, :2] / at[:, 2:]
        by_point = camera.J_distort(xy) @ image_by_point(xy, at[:, 2])
        columns = [by_intrinsics(camera, xy)]
        if self.plate is not None:
            columns.append(by_point @ unknowns.pose.R[self.views.view] @ self.plate.places[self.point])
        return self.of_pixels(unknowns, camera), by_pose(by_point, arm), columns

    def _by_rims(self, unknowns: Unknowns, camera: Camera, arm: Tensor, at: Tensor) -> Linear:
        """The same of the rims, (K, 7)."""
        assert self.rims is not None
        assert self.plate is not None
        plate, rotation = self.plate, unknowns.pose.R[self.views.view]
        smaller = torch.exp(-self.plate.at(unknowns.values("plate")[0]).sizes[self.point])[:, None, None]
        eye = torch.eye(3, dtype=at.dtype, device=at.device).expand(len(at), 3, 3)
        turning = pad(eye, (3, 0))
        by_view = pad(torch.cat([by_pose(smaller * eye, arm), turning], 1), (0, 0, 0, 1))
        sizes = plate.sizes[self.point][:, None]
        places = smaller * (rotation @ plate.places[self.point] - at[..., None] * sizes)
        turns = rotation @ plate.turns[self.point]
        gain = plate.gain.expand(len(at), 1, -1)
        residual = self.of_rims(unknowns, camera)
        return residual, by_view, [self.rims.by_camera, torch.cat([places, turns, gain], 1)]

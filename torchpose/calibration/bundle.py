"""Joint least squares of cameras' intrinsics and places, the poses of all views and what is unknown of the target.

A view is what one camera sees at a time, or what all cameras of a rig do: its pose is that in the first one.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose.calibration import lenses
from torchpose.calibration.hand_eye import Transform
from torchpose.calibration.plate import Plate
from torchpose.calibration.robot import CHAIN, Closure, Settled, WithoutRobot, shown_noise
from torchpose.calibration.views import Views
from torchpose.camera import Camera, CameraRig
from torchpose.errors import ConfigError
from torchpose.geometry import least_squares, rotations
from torchpose.geometry.least_squares import Code, Eliminated, Normal, Pose, Unknowns, Vector
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import segment_sum

_ITERATIONS = 200
_DAMPING = 1e-3  # to begin with
Linear = tuple[Tensor, Tensor, list[Tensor]]
_RELATIVE = 1e-10  # decrease that a step must promise, of the cost


@dataclass(frozen=True, eq=False)
class Places(Rows):
    """Where the C - 1 other cameras of a rig are; steps are a translation, then a rotation from the left, of each."""

    R: Float[Tensor, "1 c 3 3"]
    t: Float[Tensor, "1 c 3"]

    @property
    def size(self) -> int:
        return 6 * self.t.shape[1]

    def moved(self, step: Tensor) -> Self:
        shift, turn = step.unflatten(-1, (-1, 6)).split(3, -1)
        return replace(self, R=rotations.exp(turn) @ self.R, t=self.t + shift)


@dataclass(frozen=True, eq=False)
class Bundle:
    """Least-squares estimate of n intrinsics (of each camera fx, fy, cx, cy, then the distortion), of the places of the
    other cameras of a rig (6 each), of X and Z of a robot's chain (12) where there is one, of k unknowns of the plate,
    and of N poses.

    Poses are target to (first) camera. What is said of the intrinsics is said whether they were unknown or not; k is 0
    where the plate is known.
    """

    rig: CameraRig
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]  # mm
    residual: Float[Tensor, "K 2"]  # seen - predicted, px
    chi2: Float[Tensor, " K"]  # in the covariances of the points
    # about these u = n + 6 (C - 1) + k (+ 12) unknowns, the poses being unknown, with what is known
    information: Float[Tensor, "u u"]
    pose_covariance: Float[Tensor, "N 6 6"]  # translation (mm), rotation about the camera axes; for exact intrinsics
    gain: Float[Tensor, "N 6 u"]  # d pose / d intrinsics and plate at the optimum
    converged: bool  # whether the last step promised next to nothing
    plate: Float[Tensor, " k"]  # unknowns of the plate
    # of what is predicted, by the fit alone: of the pixels (d = 2), or of what the rims tell (d = 7)
    predicted: Float[Tensor, "K d d"]
    rims: Float[Tensor, "K r"]  # what rims tell less what is predicted (r = 7); none where they were not asked
    robot: Settled | None = None

    @property
    def camera(self) -> Camera:
        """The one there is, or the first."""
        return self.rig.cameras[0]


def adjust(
    views: Views,
    camera: Camera | CameraRig,
    R: Tensor,
    t: Tensor,
    *,
    free: bool = True,
    plate: Plate | None = None,
    start: Tensor | None = None,
) -> Bundle:
    """Levenberg-Marquardt over intrinsics, places, plate and poses, the last eliminated; residuals are whitened.

    Args:
        views: with regular covariances; with a robot its chain closes, too.
        camera: to start from; its model and number of coefficients stay. Of a rig the places of the others are unknown.
        R: (N, 3, 3), to start from.
        t: (N, 3), to start from, mm.
        free: whether the intrinsics are unknown.
        plate: what is unknown of the plate, None for nothing: then the points of the views count.
        start: (k,), unknowns of the plate to start from.

    Raises:
        ConfigError: the start puts points behind the camera, or the points of a view leave its pose open.
    """
    rig = CameraRig.of(camera)
    problem, count = _Problem(views, rig, plate, free), lenses.count(rig.cameras)
    own: dict[str, Vector | Places | Pose] = {"intrinsics": Vector(views.pixels.new_zeros(1, count))} if free else {}
    if len(rig) > 1:
        own["places"] = Places(rig.R[None, 1:], rig.t[None, 1:])
    if views.robot is not None:
        own |= {name: Pose(x[0][None], x[1][None]) for name, x in (("x", views.robot.x), ("z", views.robot.z))}
    if plate is not None:
        own["plate"] = Vector((plate.known.new_zeros(len(plate)) if start is None else start)[None])
    first = Unknowns(own, {"pose": Pose(R, t)}, views.view.new_zeros(len(views)))
    found = least_squares.minimise(problem, first, _ITERATIONS, damping=_DAMPING, adaptive=True, tolerance=_RELATIVE)
    unknowns = found.unknowns
    moved, pose = problem.rig_at(unknowns), unknowns.pose
    normal = found.normal if free or moved is None else problem.normal(unknowns, moved, by_camera=True)
    part = normal.eliminated
    if moved is None or part is None or not bool(normal.cost.isfinite().all()):
        raise ConfigError("INPUT: a view has points behind the camera that calibration starts from; remove --camera")
    covariance, determined = least_squares.scaled_inverse(part.information)
    if not bool(determined.all()):
        raise ConfigError("INPUT: the points of a view leave its pose open; use targets whose points are not on a line")
    placed = problem.placed(unknowns, moved)
    residual = problem.of_pixels(moved, placed)
    whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
    chi2 = (whiten @ residual[..., None]).square().sum((-1, -2))
    gain, converged = -covariance @ part.mixed.mT, int(found.code) == Code.CONVERGED
    # without the trace of a diagonal that steps are solved with: whether the views tell is decided by this
    information = normal.information[0] - (part.mixed @ covariance @ part.mixed.mT).sum(0)
    z = residual.new_zeros(0) if plate is None else unknowns.values("plate")[0]
    found_at = (moved, pose.R, pose.t, residual, chi2, information, covariance, gain, converged)
    unknown = 0 if free else count
    predicted = problem.predicted(unknowns, moved, information, covariance, gain, unknown)
    robot = problem.settled(unknowns, normal, unknown)
    return Bundle(*found_at, z, predicted, problem.of_rims(unknowns, moved, placed), robot)


class Placed(NamedTuple):
    """K points as the cameras that saw them have them: turn of the target, arm from its origin, and place, mm."""

    R: Float[Tensor, "K 3 3"]
    arm: Float[Tensor, "K 3"]
    at: Float[Tensor, "K 3"]

    @property
    def xy(self) -> Float[Tensor, "K 2"]:
        """Normalised coordinates."""
        return self.at[:, :2] / self.at[:, 2:]


class _Problem:
    """The normal equations of K observations: pixels, or all that rims tell where the plate has unknowns for it."""

    def __init__(self, views: Views, rig: CameraRig, plate: Plate | None, free: bool) -> None:
        self.views, self.plate, self.free, self.lens = views, plate, free, views.lens
        self.start, self.robot = rig, views.robot
        self.point = views.point if plate is None else plate.index(views.point)
        self.rims = views.rims if plate is not None and plate.rims else None
        if self.rims is None:
            self.whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
        else:
            self.whiten, self.best = self.rims.roots, self.rims.best

    def __call__(self, unknowns: Unknowns) -> Normal:
        moved = self.rig_at(unknowns)
        if moved is None:
            normal = self.normal(unknowns, self.start, by_camera=self.free)
            return replace(normal, cost=torch.full_like(normal.cost, torch.inf))
        return self.normal(unknowns, moved, by_camera=self.free)

    def rig_at(self, unknowns: Unknowns) -> CameraRig | None:
        """The cameras and their places; None where an intrinsic is impossible."""
        rig = self.start
        cameras = lenses.moved_cameras(rig.cameras, unknowns.values("intrinsics")[0]) if self.free else rig.cameras
        if cameras is None or "places" not in unknowns.own:
            return rig if cameras is rig.cameras else None if cameras is None else CameraRig.alone(cameras[0])
        places = cast(Places, unknowns.own["places"])
        if not bool(places.t.isfinite().all() & places.R.isfinite().all()):
            return None
        R, t = torch.cat([rig.R[:1], places.R[0]]), torch.cat([rig.t[:1], places.t[0]])
        return CameraRig(cameras, R, t, names=rig.names)

    def placed(self, unknowns: Unknowns, rig: CameraRig) -> Placed:
        """The points as their cameras have them."""
        pose, view = unknowns.pose, self.views.view
        points = self.views.points
        if self.plate is not None:
            points = self.plate.at(unknowns.values("plate")[0]).places[self.point]
        if len(rig) == 1:
            R, t = pose.R[view], pose.t[view]
        else:
            R, t = rotations.compose(rig.R[self.lens], rig.t[self.lens], pose.R[view], pose.t[view])
        arm = (R @ points[..., None])[..., 0]
        return Placed(R, arm, arm + t)

    def of_pixels(self, rig: CameraRig, placed: Placed) -> Tensor:
        """Seen less predicted (K, 2)."""
        return self.views.pixels - lenses.distorted(rig.cameras, self.lens, placed.xy)

    def of_rims(self, unknowns: Unknowns, rig: CameraRig, placed: Placed) -> Tensor:
        """What the rims tell less what is predicted (K, 7); (K, 0) where they are not asked."""
        if self.rims is None or self.plate is None:
            return self.views.pixels[:, :0]
        layout = self.plate.at(unknowns.values("plate")[0]).of(self.point)
        rims, turn = self.rims, placed.R @ rotations.exp(layout.turns)
        ring = torch.cat(
            [
                rims.t - placed.at * torch.exp(-layout.sizes)[:, None],
                rotations.log(rims.R @ turn.mT),
                (rims.gain - layout.gain)[:, None],
            ],
            -1,
        )
        return ring + self.best - rims.by_camera @ lenses.intrinsics_between(rig.cameras, rims.cameras)

    def normal(self, unknowns: Unknowns, rig: CameraRig, *, by_camera: bool) -> Normal:
        """Normal equations, of infinite cost where a point is behind the camera or beyond the lens model."""
        views = self.views
        placed = self.placed(unknowns, rig)
        fold = lenses.folds(rig.cameras, placed.at)[self.lens]
        possible = (placed.at[:, 2] > 0).all() & (placed.xy.norm(dim=-1) < fold).all()
        residual, by_view, columns = self._linear(unknowns, rig, placed)
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
        normal = self._with_robot(normal, unknowns)
        if self.plate is None:
            return normal
        before = own.shape[-1] - len(self.plate)
        prior, moved = (pad(values, (before, 0)) for values in (self.plate.known, unknowns.values("plate")))
        return normal.with_prior(torch.diag(prior)[None], moved)

    def _x_and_z(self, unknowns: Unknowns) -> tuple[Transform, Transform]:
        x, z = (cast(Pose, unknowns.own[name]) for name in ("x", "z"))
        return (x.R[0], x.t[0]), (z.R[0], z.t[0])

    def _chain(self, unknowns: Unknowns, normal: Normal) -> tuple[Closure, Tensor]:
        """The robot's chain, and derivatives (N, 6, n) of the predicted poses by the own unknowns of the equations."""
        assert self.robot is not None
        closure = self.robot.closed(*self._x_and_z(unknowns), unknowns.pose.R, unknowns.pose.t)
        after = 0 if self.plate is None else len(self.plate)
        return closure, pad(closure.by_chain, (normal.right.shape[-1] - after - CHAIN, after))

    def _with_robot(self, normal: Normal, unknowns: Unknowns) -> Normal:
        """With the residuals of the robot's chain, where there is one."""
        if self.robot is None:
            return normal
        (closure, by_own), part = self._chain(unknowns, normal), normal.eliminated
        assert part is not None
        weighted, residual = closure.weight[..., None], closure.residual[..., None]
        by_view = weighted * closure.by_view
        return replace(
            normal,
            information=normal.information + (by_own.mT @ (weighted * by_own)).sum(0),
            right=normal.right + (by_own.mT @ (weighted * residual)).sum(0)[None, :, 0],
            cost=normal.cost + (closure.weight * closure.residual.square()).sum(),
            eliminated=replace(
                part,
                mixed=part.mixed + by_own.mT @ by_view,
                information=part.information + closure.by_view.mT @ by_view,
                right=part.right + (by_view.mT @ residual)[..., 0],
            ),
        )

    def settled(self, unknowns: Unknowns, normal: Normal, known: int) -> Settled | None:
        """The robot's chain as it was found, where there is one; the first intrinsics were held."""
        if self.robot is None:
            return None
        closure, by_own = self._chain(unknowns, normal)
        part = normal.eliminated
        assert part is not None
        weighted = closure.weight[..., None] * closure.by_view
        own = normal.information[0] - (by_own.mT @ (closure.weight[..., None] * by_own)).sum(0)
        mixed, views = part.mixed - by_own.mT @ weighted, part.information - closure.by_view.mT @ weighted
        rest = WithoutRobot(own[known:, known:], mixed[:, known:], views)
        x, z = self._x_and_z(unknowns)
        shown = shown_noise(self.robot, closure, by_own[..., known:], rest)
        return Settled(replace(self.robot, x=x, z=z), closure.residual, shown)

    def predicted(
        self, unknowns: Unknowns, rig: CameraRig, information: Tensor, poses: Tensor, gain: Tensor, known: int
    ) -> Tensor:
        """Covariance (K, d, d) of what is predicted, from that of the fit; the first intrinsics are not unknown."""
        _, by_view, columns = self._linear(unknowns, rig, self.placed(unknowns, rig))
        view = self.views.view
        by_own = torch.cat(columns, -1)[..., known:] + by_view @ gain[view][..., known:]
        own, _ = least_squares.scaled_inverse(information[known:, known:])
        return by_own @ own @ by_own.mT + by_view @ poses[view] @ by_view.mT

    def _linear(self, unknowns: Unknowns, rig: CameraRig, placed: Placed) -> Linear:
        """Residuals (K, d), derivatives of what is predicted by the pose; by intrinsics, places and plate."""
        of = self._by_rims if self.rims is not None else self._by_pixels
        residual, by_pose_seen, columns = of(unknowns, rig, placed)
        if self.robot is not None:  # whose chain pixels tell nothing of
            columns.insert(1, residual.new_zeros(*residual.shape, CHAIN))
        if len(rig) == 1:
            return residual, by_pose_seen, columns
        turn = rig.R[self.lens]
        by_view = torch.cat([by_pose_seen[..., :3] @ turn, by_pose_seen[..., 3:] @ turn], -1)
        # turning a camera turns all about its own origin, from which the target's is t away
        away = placed.at - placed.arm - rig.t[self.lens]
        by_place = torch.cat(
            [by_pose_seen[..., :3], by_pose_seen[..., 3:] - by_pose_seen[..., :3] @ rotations.skew(away)], -1
        )
        # of the other cameras each has its own six columns
        own = torch.nn.functional.one_hot(self.lens, len(rig))[:, 1:].to(by_place)
        by_places = (own[:, None, :, None] * by_place[:, :, None]).flatten(2)
        return residual, by_view, [columns[0], by_places, *columns[1:]]

    def _by_pixels(self, unknowns: Unknowns, rig: CameraRig, placed: Placed) -> Linear:
        """Residuals (K, 2), derivatives by the pose as the camera sees it, and by the intrinsics and the plate."""
        xy = placed.xy
        by_point = lenses.slopes(rig.cameras, self.lens, xy) @ image_by_point(xy, placed.at[:, 2])
        columns = [lenses.by_all_intrinsics(rig.cameras, self.lens, xy)]
        if self.plate is not None:
            columns.append(by_point @ placed.R @ self.plate.places[self.point])
        return self.of_pixels(rig, placed), by_pose(by_point, placed.arm), columns

    def _by_rims(self, unknowns: Unknowns, rig: CameraRig, placed: Placed) -> Linear:
        """The same of the rims, (K, 7)."""
        assert self.rims is not None
        assert self.plate is not None
        plate, at = self.plate, placed.at
        smaller = torch.exp(-self.plate.at(unknowns.values("plate")[0]).sizes[self.point])[:, None, None]
        eye = torch.eye(3, dtype=at.dtype, device=at.device).expand(len(at), 3, 3)
        turning = pad(eye, (3, 0))
        by_view = pad(torch.cat([by_pose(smaller * eye, placed.arm), turning], 1), (0, 0, 0, 1))
        sizes = plate.sizes[self.point][:, None]
        places = smaller * (placed.R @ plate.places[self.point] - at[..., None] * sizes)
        turns = placed.R @ plate.turns[self.point]
        gain = plate.gain.expand(len(at), 1, -1)
        residual = self.of_rims(unknowns, rig, placed)
        return residual, by_view, [self.rims.by_camera, torch.cat([places, turns, gain], 1)]

"""Targets measured by the camera, against known truth: errors, whether the covariances are right, and the joint bound.

    python scripts/measured_target_statistics.py --sets 200
    python scripts/measured_target_statistics.py --rendered 3

Every set has a random print of a built-in target (places off by --print mm in all directions and a bow of --bow mm,
rings turned by 2 mrad, edge gain --gain mm), a random camera and random views: --views to calibrate, --tests for
poses. The estimator knows the nominal file, with what it states of the print, and starts from a focal length
0.25 % off and no distortion.

--sets: what a ring's grey values tell of its place, turn and edge gain is drawn with exact noise, of the covariance
that both of its rims give. --rendered: frames are rendered, and everything is as `torchpose calibrate --measure-target`
and `torchpose estimate` do it.

Motions are between consecutive test frames; missing: share of them without a pose at either end.

NEES: squared errors in units of their covariance over their number, 1 is right: marker places, intrinsics, poses of
later frames (from their centres); lengths are in the scale of the nominal places. bound: that of the joint problem, all
pixels along all rims with intrinsics, poses, places, tilts, sizes and edge gain unknown; its information is formed here
by finite differences. claimed: the deviations that the files state over this bound; by_centers: those that the same
adjustment of the centres alone, without sizes and tilts of the rings, would state. stated: the camera alone, calibrated
by the nominal file with what it states of the print.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

import torchpose as tp
from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.bundle import adjust
from torchpose.calibration.lenses import moved_camera
from torchpose.calibration.measured import measured_target
from torchpose.calibration.plate import free_plate, motions, stated_plate
from torchpose.calibration.rings import rim_derivatives, rims_by_camera
from torchpose.calibration.session import measure_target
from torchpose.calibration.views import Rims
from torchpose.geometry import rotations
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.rotations import plane_axes
from torchpose.io.writers import write_rows
from torchpose.sim import add_noise, render

F64 = torch.float64
LENS, COEFFICIENTS = "brown4", 4
RIM = 24  # points of a rim
EDGE_SIGMA = 0.017  # px, of a pixel's length of edge: noise 2, contrast 190, blur 0.76 px
TURNED = 2e-3  # rad, by which the rings of a print are turned out of its plane


@dataclass(frozen=True, eq=False)
class Scene:
    """A print (as a target), its nominal file, a camera, and poses (N, 3, 3), (N, 3) to calibrate and to test."""

    nominal: tp.Target
    printed: tp.Target
    camera: tp.Camera
    start: tp.Camera
    views: tuple[Tensor, Tensor]
    tests: tuple[Tensor, Tensor]


def random_scene(options: argparse.Namespace, seed: int) -> Scene:
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=g, dtype=F64))

    nominal = tp.Target.load(options.targets[seed % len(options.targets)])
    width, height = options.size
    focal = uniform(0.6, 1.1) * width
    matrix = [[focal, 0, (width - 1) / 2 + uniform(-20, 20)], [0, 1.001 * focal, (height - 1) / 2 + uniform(-20, 20)]]
    bend = [uniform(-0.1, 0.05), uniform(-0.03, 0.03), uniform(-3e-4, 3e-4), uniform(-3e-4, 3e-4)]
    camera = tp.Camera(width, height, torch.tensor([*matrix, [0, 0, 1]], dtype=F64), torch.tensor(bend, dtype=F64))
    start = replace(camera, matrix=camera.matrix * torch.tensor([[1.0025], [1.0025], [1]]))
    start = replace(start, distortion=torch.zeros(COEFFICIENTS, dtype=F64))
    off = options.print * torch.randn(len(nominal), 3, generator=g, dtype=F64)
    reach = nominal.centers.norm(dim=-1).max()
    a, b, c = torch.randn(3, generator=g, dtype=F64) / 3**0.5
    x, y, _ = (nominal.centers / reach).unbind(-1)
    off[:, 2] += options.bow * (a * (x * x - y * y) + 2 * b * x * y + c * (x * x + y * y))
    gain = options.gain * float(torch.randn((), generator=g, dtype=F64))
    turns = TURNED * torch.randn(len(nominal), 3, generator=g, dtype=F64) * torch.tensor([1.0, 1.0, 0.0])
    normals = (rotations.exp(turns) @ nominal.normals[..., None])[..., 0]
    printed = replace(nominal, centers=nominal.centers + off, normals=normals, edge_gain=gain)
    sigma = torch.full((len(nominal), 3), options.print, dtype=F64)
    sigma[:, 2] = math.hypot(options.print, options.bow)
    stated = torch.diag(torch.cat([sigma.flatten(), torch.tensor([options.gain])]).square())
    nominal = replace(nominal, covariance=stated.double())
    poses = random_poses(camera, nominal, options.views + options.tests, g)
    cut = options.views
    return Scene(nominal, printed, camera, start, (poses[0][:cut], poses[1][:cut]), (poses[0][cut:], poses[1][cut:]))


def random_poses(camera: tp.Camera, target: tp.Target, count: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3), t (N, 3): tilted by 10 to 40 degrees, all rings in view, a third to three quarters of the height."""
    u = torch.rand(80 * count, 6, dtype=F64, generator=g)
    angle, azimuth, roll = (10 + 30 * u[:, 0]).deg2rad(), 2 * math.pi * u[:, 1], 2 * math.pi * u[:, 2]
    zero = torch.zeros_like(angle)
    r = rotations.exp(angle[:, None] * torch.stack([azimuth.cos(), azimuth.sin(), zero], -1))
    r = r @ rotations.exp(torch.stack([zero, zero, roll], -1))
    extent = 2 * float((target.centers.norm(dim=-1) + target.radii[:, 0]).max())
    share = 0.45 + 0.35 * u[:, 3]
    depth = float(camera.matrix[1, 1]) * extent / (share * camera.height)
    size = torch.tensor([camera.width, camera.height], dtype=F64)
    xy = camera.undistort_points(u[:, 4:] * size)
    t = torch.cat([xy, torch.ones_like(xy[:, :1])], -1) * depth[:, None]
    rims = rim_points(target.centers, target.normals, target.printed_radii[:, :1])
    uv = camera.project((r[:, None, None, None] @ rims[..., None])[..., 0] + t[:, None, None, None])
    inside = ((uv > 8) & (uv < size - 9)).all(-1).flatten(1).all(-1)
    chosen = inside.nonzero()[:count, 0]
    if len(chosen) < count:
        raise RuntimeError("too few poses in view")
    return r[chosen], t[chosen]


def rim_points(centers: Tensor, normals: Tensor, radii: Tensor) -> Tensor:
    """Points (M, L, RIM, 3) of circles (M, L)."""
    angle = 2 * math.pi * torch.arange(RIM, dtype=F64) / RIM
    one, two = (axis[:, None, None] for axis in plane_axes(normals))
    circle = angle.cos()[:, None] * one + angle.sin()[:, None] * two
    return centers[:, None, None] + radii[..., None, None] * circle


class Joint:
    """All pixels along all rims as functions of everything unknown; information by differences.

    Unknowns: intrinsics n, edge gain 1, places 3M, sizes M, tilts 2M, then 6 of every view.
    """

    def __init__(self, scene: Scene, poses: tuple[Tensor, Tensor]) -> None:
        self.scene, self.poses, self.target = scene, poses, scene.printed
        self.n, self.m = 4 + COEFFICIENTS, len(scene.printed)

    def pixels(self, step: Tensor, R: Tensor, t: Tensor) -> Tensor:
        """(N, M, 2, RIM, 2) with the common unknowns moved by ``step``."""
        n, m = self.n, self.m
        camera = moved_camera(self.scene.camera, step[:n])
        assert camera is not None
        gain, places = step[n], step[n + 1 : n + 1 + 3 * m].view(m, 3)
        sizes, tilts = step[n + 1 + 3 * m : n + 1 + 4 * m], step[n + 1 + 4 * m :].view(m, 2)
        one, two = plane_axes(self.target.normals)
        normals = self.target.normals + tilts[:, :1] * one + tilts[:, 1:] * two
        normals = normals / normals.norm(dim=-1, keepdim=True)
        radii = self.target.printed_radii * sizes.exp()[:, None] + gain * torch.tensor([1.0, -1.0], dtype=F64)
        rims = rim_points(self.target.centers + places, normals, radii)
        return camera.project((R[:, None, None, None] @ rims[..., None])[..., 0] + t[:, None, None, None])

    def jacobians(self) -> tuple[Tensor, Tensor]:
        """Displacements across the rims in deviations, by the common unknowns (N, E, u) and by the poses (N, E, 6)."""
        R, t = self.poses
        none = torch.zeros(self.n + 1 + 6 * self.m, dtype=F64)
        at = self.pixels(none, R, t)
        ahead = torch.roll(at, -1, -2) - torch.roll(at, 1, -2)
        length = ahead.norm(dim=-1) / 2  # chords of two steps: the sum of all is that of the rim to 1 %
        normal = torch.stack([-ahead[..., 1], ahead[..., 0]], -1) / (2 * length[..., None])
        weight = length.sqrt() / EDGE_SIGMA

        def across(change: Tensor) -> Tensor:
            return ((change * normal).sum(-1) * weight).flatten(1)

        h = 1e-5
        common = []
        for k in range(len(none)):
            step = torch.zeros_like(none)
            step[k] = h
            common.append(across((self.pixels(step, R, t) - self.pixels(-step, R, t)) / (2 * h)))
        own = []
        for k in range(6):
            step = torch.zeros(6, dtype=F64)
            step[k] = h
            plus, minus = (
                self.pixels(none, rotations.exp(s * step[3:].expand(len(t), 3)) @ R, t + s * step[:3]) for s in (1, -1)
            )
            own.append(across((plus - minus) / (2 * h)))
        return torch.stack(common, -1), torch.stack(own, -1)

    def covariance(self) -> Tensor:
        """Of the common unknowns, in the gauge of the nominal places; the scale is exact."""
        common, own = self.jacobians()
        mixed, inner = common.mT @ own, own.mT @ own
        reduced = (common.mT @ common - mixed @ torch.linalg.solve(inner, mixed.mT)).sum(0)
        basis = torch.eye(len(reduced), dtype=F64)
        gauge = torch.zeros(len(reduced), 7, dtype=F64)
        gauge[self.n + 1 : self.n + 1 + 3 * self.m] = motions(self.scene.nominal.centers)
        free = torch.linalg.qr(torch.cat([gauge, basis], 1)).Q[:, 7:]
        # a turn of a marker about its own normal is not among the unknowns, and tilts of a circle are all told
        scaled = free.mT @ reduced @ free
        return free @ torch.linalg.inv(scaled) @ free.mT


def drawn_views(scene: Scene, poses: tuple[Tensor, Tensor], g: torch.Generator) -> Views:
    """What the rings of frames at these poses tell, with noise; points are the nominal ones."""
    (R, t), printed = poses, scene.printed
    count, m = len(t), len(printed)
    view, marker = torch.arange(count).repeat_interleave(m), torch.arange(m).repeat(count)
    rotation = R[view]
    at = (rotation @ printed.centers[marker][..., None])[..., 0] + t[view]
    normals, radii = printed.normals[marker], printed.printed_radii[marker]
    across, _ = rim_derivatives(scene.camera, rotation, at, normals, radii)
    information = across.mT @ across / EDGE_SIGMA**2
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, None] * scale[..., None])
    told = values > 1e-9
    noise = torch.randn(len(at), 7, generator=g, dtype=F64) * torch.where(told, values.clamp_min(1e-12).rsqrt(), 0.0)
    off = scale * (vectors @ noise[..., None])[..., 0]
    # the file's plane: how far the print turns a ring out of it is for the adjustment to find
    flat = scene.nominal.normals[marker]
    turn = rotations.exp(torch.linalg.cross(flat, normals))
    rims = Rims(
        rotations.exp(off[:, 3:6]) @ rotation @ turn,
        at + off[:, :3],
        printed.edge_gain + off[:, 6],
        information,
        torch.zeros_like(off),
        rims_by_camera(scene.camera, rotation, at, normals, radii),
        (scene.camera,),
    )
    xy = rims.t[:, :2] / rims.t[:, 2:]
    by_place = scene.camera.J_distort(xy) @ image_by_point(xy, rims.t[:, 2])
    covariance = by_place @ rims.covariance[:, :3, :3] @ by_place.mT
    names = tuple(f"{k}.png" for k in range(count))
    nominal = scene.nominal
    return Views(view, nominal.ids[marker], nominal.centers[marker], scene.camera.distort(xy), covariance, names, rims)


def intrinsics(camera: tp.Camera) -> Tensor:
    return torch.cat([camera.matrix.diagonal()[:2], camera.matrix[:2, 2], camera.distortion])


def nees(error: Tensor, covariance: Tensor) -> float:
    """Over the number of directions in which the covariance is not zero."""
    scale = covariance.diagonal().sqrt().clamp_min(1e-30)
    values, vectors = torch.linalg.eigh(covariance / scale[:, None] / scale)
    told = values > 1e-9 * values[-1]
    along = (vectors.mT @ (error / scale))[told]
    return float((along.square() / values[told]).mean())


def without_scale(covariance: Tensor, nominal: tp.Target) -> Tensor:
    """Covariance of places (3M, 3M) for a scale that is known."""
    arm = (nominal.centers - nominal.centers.mean(0)).flatten()
    keep = torch.eye(len(arm), dtype=F64) - torch.outer(arm, arm) / (arm @ arm)
    return keep @ covariance @ keep.mT


def true_frame(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Places of the print in the frame that fits the nominal ones best, and that frame in the print's: R, t."""
    a, b = scene.nominal.centers, scene.printed.centers
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, _, v = torch.linalg.svd((a - mean_a).mT @ (b - mean_b))
    sign = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))], dtype=F64))
    r = (u @ sign @ v).mT  # nominal frame to print
    return (b - mean_b) @ r + mean_a, r, mean_b - r @ mean_a


def print_scale(scene: Scene) -> float:
    """Of the print over the nominal places, as these fit it best."""
    a, b = scene.nominal.centers, true_frame(scene)[0]
    a, b = a - a.mean(0), b - b.mean(0)
    return float((a * b).sum() / a.square().sum())


def pose_errors(scene: Scene, R: Tensor, t: Tensor, found: tuple[Tensor, Tensor]) -> Tensor:
    """(N, 6) of poses of the measured target: translation, then rotation from the left; in its own scale."""
    _, r0, t0 = true_frame(scene)
    true_r, true_t = R @ r0, (R @ t0[:, None])[..., 0] + t
    return torch.cat([found[1] - true_t / print_scale(scene), rotations.log(found[0] @ true_r.mT)], -1)


def motion_errors(scene: Scene, found: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Of consecutive test poses: errors of the distances between them, mm, and of the turns, degrees.

    The scale of the print, which no view tells, is taken as known: as with an exact ``--distance``.
    """
    _, r0, t0 = true_frame(scene)
    R, t = scene.tests
    true = R @ r0, (R @ t0[:, None])[..., 0] + t

    def of(pose: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        return (pose[1][1:] - pose[1][:-1]).norm(dim=-1), pose[0][1:] @ pose[0][:-1].mT

    (length, turn), (true_length, true_turn) = of(found), of(true)
    return length * print_scale(scene) - true_length, rotations.log(turn @ true_turn.mT).norm(dim=-1).rad2deg()


def drawn_set(options: argparse.Namespace, seed: int) -> dict[str, float]:
    scene = random_scene(options, seed)
    g = torch.Generator().manual_seed(seed + 100_000)
    views, tests = drawn_views(scene, scene.views, g), drawn_views(scene, scene.tests, g)
    nominal = scene.nominal
    plate = free_plate(nominal.ids, nominal.centers, nominal.normals)
    started = time.process_time()
    found = calibrate_intrinsics(views, [scene.start], lens=LENS, plate=plate)
    target, camera = measured_target(found, nominal)
    seconds = time.process_time() - started
    places, *_ = true_frame(scene)
    error = (target.centers - places).flatten()
    assert target.covariance is not None
    assert target.cross_covariance is not None
    of_camera = intrinsics(camera) - intrinsics(scene.camera)
    unscaled = without_scale(target.covariance[:-1, :-1], nominal)
    bound = Joint(scene, scene.views).covariance()
    n, m = 4 + COEFFICIENTS, len(nominal)
    in_bound = bound[n + 1 : n + 1 + 3 * m, n + 1 : n + 1 + 3 * m]
    # without the scale, which no view tells
    arm = (nominal.centers - nominal.centers.mean(0)).flatten()
    shape = error - arm * (arm @ error) / (arm @ arm)
    thin = centers_alone(scene, views)
    row = {
        "places_nees": nees(shape, target.covariance[:-1, :-1]),
        "intrinsics_nees": nees(of_camera, found.covariance),
        "places_by_centers": math.sqrt(float(thin[0] / in_bound.diagonal().sum())),
        "focal_by_centers": math.sqrt(float(thin[1] / bound.diagonal()[:2].sum())),
        "places_um2": 1e6 * float(shape.square().mean()),
        "places_bound_um2": 1e6 * float(in_bound.diagonal().mean()),
        "focal_px2": float(of_camera[:2].square().mean()),
        "focal_bound_px2": float(bound.diagonal()[:2].mean()),
        "places_claimed": math.sqrt(float(unscaled.diagonal().sum() / in_bound.diagonal().sum())),
        "focal_claimed": math.sqrt(float(found.covariance.diagonal()[:2].sum() / bound.diagonal()[:2].sum())),
        "gain_nees": float((target.edge_gain - scene.printed.edge_gain) ** 2 / target.covariance[-1, -1]),
        "seconds": seconds,
    }
    return row | of_stated(scene, views) | later_poses(scene, tests, target, camera, found.covariance)


def of_stated(scene: Scene, views: Views) -> dict[str, float]:
    """The camera alone, calibrated by the nominal file with what it states of the print."""
    found = calibrate_intrinsics(views, [scene.start], lens=LENS, plate=stated_plate(scene.nominal))
    error = intrinsics(found.camera) - intrinsics(scene.camera)
    return {
        "stated_nees": nees(error, found.covariance),
        "stated_focal_px2": float(error[:2].square().mean()),
        "stated_claimed_px2": float(found.covariance.diagonal()[:2].mean()),
    }


def centers_alone(scene: Scene, views: Views) -> tuple[Tensor, Tensor]:
    """Variances, summed, of places and of both focal lengths that the centres alone give, sizes and tilts unused."""
    plate = free_plate(scene.nominal.ids, scene.nominal.centers)
    found = calibrate_intrinsics(replace(views, rims=None), [scene.start], lens=LENS, plate=plate)
    rows, n = plate.places.flatten(0, 1), len(found.covariance)
    return (rows @ found.joint[n:, n:] * rows).sum(), found.covariance.diagonal()[:2].sum()


def later_poses(
    scene: Scene, tests: Views, target: tp.Target, camera: tp.Camera, of_camera: Tensor
) -> dict[str, float]:
    """Poses from the centres of later frames with the measured files, whose covariance is carried through."""
    seen = replace(tests, points=target.centers.repeat(len(tests), 1), rims=None)
    _, r0, t0 = true_frame(scene)
    start = scene.tests[0] @ r0, (scene.tests[0] @ t0[:, None])[..., 0] + scene.tests[1]
    fit = adjust(seen, camera, *start, free=False)
    n, m = len(of_camera), len(target)
    by_place = pose_by_places(seen, camera, fit.R, fit.t, m)
    assert target.covariance is not None
    assert target.cross_covariance is not None
    gain = torch.cat([fit.gain[..., :n], by_place], -1)
    of_target, cross = target.covariance[:-1, :-1], target.cross_covariance[:-1]
    joint = torch.cat([torch.cat([of_camera, cross.mT], 1), torch.cat([cross, of_target], 1)])
    covariance = fit.pose_covariance + gain @ joint @ gain.mT
    error = pose_errors(scene, *scene.tests, (fit.R, fit.t))
    every = [nees(e, c) for e, c in zip(error, covariance, strict=True)]
    length, turn = motion_errors(scene, (fit.R, fit.t))
    return {
        "poses_nees": sum(every) / len(every),
        "distance_um2": 1e6 * float(length.square().mean()),
        "turn_deg2": float(turn.square().mean()),
    }


def pose_by_places(views: Views, camera: tp.Camera, R: Tensor, t: Tensor, markers: int) -> Tensor:
    """How the poses (N, 6) follow the places (N, 6, 3M), by differences of their least-squares fit."""
    change = []
    for k in range(3 * markers):
        step = torch.zeros(markers, 3, dtype=F64)
        step[k // 3, k % 3] = 1e-3
        moved = replace(views, points=views.points + step.repeat(len(views), 1))
        again = adjust(moved, camera, R, t, free=False)
        change.append(torch.cat([again.t - t, rotations.log(again.R @ R.mT)], -1) / 1e-3)
    return torch.stack(change, -1)


def rendered_set(options: argparse.Namespace, seed: int) -> dict[str, float]:
    """The whole of it on frames, and the same without measuring."""
    scene = random_scene(options, seed)
    frames, tests = (
        add_noise(render(scene.camera, scene.printed, *poses), options.noise, seed=seed)
        for poses in (scene.views, scene.tests)
    )
    names = [f"{k}.png" for k in range(len(frames))]
    started = time.process_time()
    found = measure_target(lambda: [(names, frames)], scene.nominal, scene.start, lens=LENS)
    seconds = time.process_time() - started
    places, *_ = true_frame(scene)
    error = (found.target.centers - places).flatten()
    assert found.target.covariance is not None
    of_camera = intrinsics(found.camera) - intrinsics(scene.camera)
    poses = tp.PoseEstimator(found.camera, found.target)(tests)
    arm = (scene.nominal.centers - scene.nominal.centers.mean(0)).flatten()
    shape = error - arm * (arm @ error) / (arm @ arm)
    length, turn = motion_errors(scene, (poses.R, poses.t))
    nominal_length, nominal_turn = motions_without(scene, names, frames, tests)
    return {
        "places_nees": nees(shape, found.target.covariance[:-1, :-1]),
        "intrinsics_nees": nees(of_camera, found.calibration.covariance),
        "places_um2": 1e6 * float(shape.square().mean()),
        "focal_px2": float(of_camera[:2].square().mean()),
        "gain_um2": 1e6 * (found.target.edge_gain - scene.printed.edge_gain) ** 2,
        "reduced_chi2": found.calibration.reduced_chi2,
        "seconds": seconds,
        "distance_um2": 1e6 * float(length.square().nanmean()),
        "turn_deg2": float(turn.square().nanmean()),
        "missing": float(length.isnan().double().mean()),
        "nominal_missing": float(nominal_length.isnan().double().mean()),
        "nominal_distance_um2": 1e6 * float(nominal_length.square().nanmean()),
        "nominal_turn_deg2": float(nominal_turn.square().nanmean()),
    }


def motions_without(scene: Scene, names: list[str], frames: Tensor, tests: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of motions with the nominal target, and a camera calibrated with it."""
    from torchpose.calibration.session import calibrate_camera

    nominal = replace(scene.nominal, covariance=None)
    camera = calibrate_camera(lambda: [(names, frames)], nominal, scene.start, guess=False, lens=LENS).camera
    poses = tp.PoseEstimator(camera, nominal)(tests)
    return motion_errors(scene, (poses.R, poses.t))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=0, help="sets of drawn centres")
    parser.add_argument("--rendered", type=int, default=0, help="sets of rendered frames")
    parser.add_argument("--targets", nargs="+", default=["quad40", "hexa50"])
    parser.add_argument("--views", type=int, default=28)
    parser.add_argument("--tests", type=int, default=14)
    parser.add_argument("--size", type=int, nargs=2, default=(912, 608), help="of the frames, px")
    parser.add_argument("--noise", type=float, default=2.0)
    parser.add_argument("--print", type=float, default=0.02, help="mm")
    parser.add_argument("--bow", type=float, default=0.04, help="mm")
    parser.add_argument("--gain", type=float, default=0.015, help="mm")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="CSV file, one row a set")
    options = parser.parse_args()
    for count, one in ((options.sets, drawn_set), (options.rendered, rendered_set)):
        rows = []
        for k in range(count):
            rows.append(one(options, 1000 * options.seed + k))
            if options.out:  # a run that is stopped keeps what it has
                write_rows(options.out, rows, dict.fromkeys(rows[0], float))
        if rows:
            report(rows)


def report(rows: list[dict[str, float]]) -> None:
    print(f"{len(rows)} sets; squares are means, their roots follow")
    for name in rows[0]:
        values = torch.tensor([row[name] for row in rows], dtype=F64)
        mean = float(values.mean())
        root = f"   root {mean**0.5:.4g}" if name.endswith("2") and "chi2" not in name else ""
        print(f"{name:>24} {mean:.4g} +- {float(values.std()) / len(rows) ** 0.5:.2g}{root}")
    for name in ("places", "focal"):
        unit = "um2" if name == "places" else "px2"
        if f"{name}_bound_{unit}" in rows[0]:
            ours, least = (sum(row[key] for row in rows) for key in (f"{name}_{unit}", f"{name}_bound_{unit}"))
            print(f"{name}: RMS over the joint bound {math.sqrt(ours / least):.3f}")


if __name__ == "__main__":
    main()

"""Plan files of simulated data sets: which frames there are, under which conditions they were taken."""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera, CameraRig
from torchpose.config import beside, example, read_yaml, validate, within
from torchpose.datasets.plan_file import MOST_FRAMES, PlanFile, Random
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows, shared
from torchpose.io.sources import find_sources
from torchpose.io.truth import read_truth
from torchpose.sim import Disturbances, PrintErrors, Prints, Texture, faults_of, printed
from torchpose.sim.fields import keys_of
from torchpose.target import Target

_APART = 1_000_003  # between the seeds of a rig's cameras (convention: a prime)
_HALTON_BASES = (2, 3, 5, 7, 11, 13)
_CHUNK = 500  # poses whose markers are looked for at once: half a MB a plane, which stays in the cache
_HOPELESS = 20_000  # poses without one in view, after which no more are drawn
_TRIES = 50  # random poses drawn for one that keeps the target in view


@dataclass(frozen=True, eq=False)
class Conditions(Rows):
    """What every frame has its own value of: blur, read noise and grey levels of 0..255.

    Attributes:
        psf_sigma: smaller standard deviation of the Gaussian, px.
        psf_ratio: the larger one over it.
        psf_deg: direction of the larger one, from u towards v.
        smear_px: length of the motion in the image.
        smear_deg: its direction.
        disc_px: radius of the disc.
    """

    psf_sigma: Float[Tensor, " N"]
    dark: Float[Tensor, " N"]
    light: Float[Tensor, " N"]
    surround: Float[Tensor, " N"]
    noise: Float[Tensor, " N"]
    psf_ratio: Float[Tensor, " N"]
    psf_deg: Float[Tensor, " N"]
    smear_px: Float[Tensor, " N"]
    smear_deg: Float[Tensor, " N"]
    disc_px: Float[Tensor, " N"]

    @property
    def blur(self) -> dict[str, Tensor]:
        """Fields of `torchpose.sim.Imaging`: ``psf_sigma``, a covariance where any is elliptic, ``smear``, ``disc``."""
        variance = self.psf_sigma.square()
        axis, along = _direction(self.psf_deg), _direction(self.smear_deg)
        elongation = (variance * (self.psf_ratio.square() - 1))[:, None, None] * axis[:, :, None] * axis[:, None]
        covariance = torch.diag_embed(variance[:, None].expand(-1, 2)) + elongation
        sigma = covariance if bool((self.psf_ratio > 1).any()) else self.psf_sigma
        return {"psf_sigma": sigma, "smear": self.smear_px[:, None] * along, "disc": self.disc_px}


@dataclass(frozen=True, eq=False)
class Plan(Rows):
    """A plan that has been read: everything that the frames depend on, one row a frame, float64.

    Attributes:
        R: target to camera.
        t: target to camera, mm.
        conditions: blur, levels and noise.
        motion: mm and rad during the exposure.
        seen: markers that lie in the frame as a whole.
        disturbances: of lens, air and lamp.
        prints: what was printed, where the plan says that it differs from the target.
        texture: of the paper, where it has one.
        file: what the plan file ``path`` says, with the ``camera`` and the ``target`` that it names.
        rig: of several cameras, of which ``camera`` is the first; see `Plan.of_camera`.
        backgrounds: pictures, in natural order; frame i takes the one of the number i modulo their count.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    conditions: Conditions
    motion: Float[Tensor, "N 6"]
    seen: Int[Tensor, " N"]
    disturbances: Disturbances
    prints: Prints | None
    texture: Texture | None
    file: PlanFile = shared()
    path: Path = shared()
    camera: Camera = shared()
    target: Target = shared()
    backgrounds: list[Path] = shared()
    rig: CameraRig | None = shared(None)

    def of_camera(self, number: int) -> Plan:
        """What one camera of the rig sees, with noise of its own; markers may be out of its view."""
        assert self.rig is not None
        camera, turn = self.rig.cameras[number], self.rig.R[number]
        R, t = self.rig.seen_by(number, self.R, self.t)
        motion = torch.cat([self.motion[:, :3] @ turn.T, self.motion[:, 3:] @ turn.T], 1)
        file = self.file.model_copy(update={"seed": self.file.seed + number * _APART})
        seen = markers_in_view(camera, self.target, R, t)
        return replace(self, R=R, t=t, motion=motion, seen=seen, camera=camera, file=file, rig=None)

    @property
    def names(self) -> list[str]:
        """File names of the frames."""
        digits = max(4, len(str(len(self) - 1)))
        return [f"{i:0{digits}d}.png" for i in range(len(self))]

    @property
    def in_depth_range(self) -> Bool[Tensor, " N"]:
        """Whether the target's origin lies in the plan's depth range; all do where it has none."""
        near, far = self.file.depth_range or (0.0, math.inf)
        return (self.t[:, 2] >= near) & (self.t[:, 2] <= far)


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Reads a plan file; files that it names are relative to it.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``. A frame with a marker out of view or a target out
            of the depth range is an error unless the plan says ``out_of_view: mark``.
    """
    path = example(path, "plans")
    file = validate(PlanFile, read_yaml(path), path)
    rig = CameraRig.load(beside(path, file.cameras)) if file.cameras else None
    camera = Camera.load(beside(path, file.camera or "")) if rig is None else rig.cameras[0]
    target = Target.load(beside(path, file.target))
    if file.faults:
        with within(f"{path}: "):
            faults_of(file.faults)
    if file.processing.jpeg is not None and (bits := file.sensor.bits) != 8:
        raise ConfigError(f"{path}: processing.jpeg: holds 8 bits and sensor.bits is {bits}; leave one of them out")
    if file.depth_range is not None and not 0 < file.depth_range[0] < file.depth_range[1]:
        raise ConfigError(f"{path}: depth_range: {file.depth_range} is not 0 < near < far; correct it")
    R, t = _poses(path, file, camera, target)
    image = file.imaging
    generator = torch.Generator().manual_seed(file.seed % 2**63)

    def draw(value: list[float]) -> Tensor:
        return _spread(value, torch.rand(len(t), dtype=torch.float64, generator=generator))

    def directions() -> Tensor:
        vectors = torch.randn(len(t), 3, dtype=torch.float64, generator=generator)
        return torch.nn.functional.normalize(vectors, dim=1)

    levels = [draw(x) for x in (image.psf_sigma, image.dark, image.light, image.surround, file.sensor.noise)]
    shift = directions() * draw(image.motion_mm)[:, None]
    motion = torch.cat([shift, directions() * draw(image.motion_deg).deg2rad()[:, None]], 1)
    # last, so that what came before them draws as it always did
    directed = (image.psf_ratio, image.psf_deg, image.smear_px, image.smear_deg, image.disc_px)
    conditions = Conditions(*levels, *map(draw, directed))
    rows = (image.coma_px, image.coma_deg, image.haze_px, image.ghost, image.speckle, image.flicker)
    each: list[Any] = [*map(draw, rows), image.haze_length, image.speckle_px, image.flicker_px, file.seed]
    disturbances = Disturbances(*each)
    seen = markers_in_view(camera, target, R, t)
    with within(f"{path}: print."):
        printed_ = _prints(file, target, len(t))
    plan = Plan(
        R,
        t,
        conditions,
        motion,
        seen,
        disturbances,
        *printed_,
        file,
        path,
        camera,
        target,
        _backgrounds(path, image.background),
        rig,
    )
    if file.out_of_view == "error":
        _check_view(plan)
    return plan


def _prints(file: PlanFile, target: Target, frames: int) -> tuple[Prints | None, Texture | None]:
    """What is printed in each frame, and on what; its chance is its own, so that plans of one print may differ else."""
    if (wanted := file.print) is None:
        return None, None
    seed = file.seed if wanted.seed is None else wanted.seed
    generator = torch.Generator().manual_seed(seed % 2**63)
    count = 1 if wanted.each == "set" else frames

    def draw(value: list[float]) -> Tensor:
        return _spread(value, torch.rand(count, dtype=torch.float64, generator=generator))

    errors = PrintErrors(
        wanted.center_sigma,
        draw(wanted.gain),
        draw(wanted.scale),
        draw(wanted.warp),
        wanted.warp_shape,
        draw(wanted.warp_deg).deg2rad(),
        wanted.dpi,
    )
    prints, texture = printed(target, errors, count, generator), None
    if (paper := wanted.texture) is not None:
        texture = Texture(keys_of(count, seed, "paper"), paper.share, paper.length)
    if wanted.each == "set":
        prints.as_target()  # is written beside the frames as a target file
        once = torch.zeros(frames, dtype=torch.int64)
        prints, texture = prints[once], None if texture is None else texture[once]
    return prints, texture


def markers_in_view(
    camera: Camera, target: Target, R: Float[Tensor, "N 3 3"], t: Float[Tensor, "N 3"]
) -> Int[Tensor, " N"]:
    """How many markers lie before the camera and in the frame as a whole."""
    parts = zip(R.split(_CHUNK), t.split(_CHUNK), strict=True)
    seen = [_some_in_view(camera, target, *part) for part in parts]
    return torch.cat([torch.zeros(0, dtype=torch.int64, device=t.device), *seen])


def _some_in_view(camera: Camera, target: Target, R: Float[Tensor, "N 3 3"], t: Float[Tensor, "N 3"]) -> Tensor:
    """The same of few enough poses for one go."""
    e1, e2 = plane_axes(target.normals)
    angle = torch.arange(36, dtype=t.dtype) * (2 * math.pi / 36)
    rim = angle.cos()[:, None, None] * e1 + angle.sin()[:, None, None] * e2
    points = (target.centers + target.radii[:, :1] * rim).reshape(-1, 3)  # (36 M, 3)
    x = points @ R.mT + t[:, None]
    pixel = camera.project(x)
    last = torch.tensor([camera.width - 1, camera.height - 1], dtype=t.dtype)
    inside = ((pixel >= 0) & (pixel <= last)).all(-1)
    if math.isfinite(camera.fold_radius):
        inside &= (x[..., :2] / x[..., 2:]).norm(dim=-1) < camera.fold_radius
    return inside.view(len(t), 36, -1).all(1).sum(1)


def _check_view(plan: Plan) -> None:
    """Raises ConfigError for the first frame that is behind the camera, has lost a marker or is out of range."""
    fix = "change the poses, or write out_of_view: mark to keep such frames, marked in truth.csv"
    behind, lost, far = (
        fault.nonzero().flatten().tolist()
        for fault in (plan.t[:, 2] <= 0, plan.seen < len(plan.target), ~plan.in_depth_range)
    )
    if behind:
        what = f"frame {behind[0]} is behind the camera (z = {float(plan.t[behind[0], 2]):g} mm)"
    elif lost:
        gone = len(plan.target) - int(plan.seen[lost[0]])
        what = f"{gone} of {len(plan.target)} markers of frame {lost[0]} are out of view ({len(lost)} such frames)"
    elif far:
        where = f"at {float(plan.t[far[0], 2]):g} mm, out of depth_range {plan.file.depth_range}"
        what = f"frame {far[0]} is {where} ({len(far)} such frames)"
    else:
        return
    raise ConfigError(f"{plan.path}: poses: {what}; {fix}")


def _poses(path: Path, file: PlanFile, camera: Camera, target: Target) -> tuple[Tensor, Tensor]:
    if (grid := file.poses.grid) is not None:
        angles = _floats(list(itertools.product(grid.angles_deg, repeat=3))).deg2rad()  # pitch, yaw, roll
        positions = _floats(grid.positions) + _floats([0.0, 0.0, grid.distance])
        return _euler(angles).repeat(len(positions), 1, 1), positions.repeat_interleave(len(angles), 0)
    if (random := file.poses.random) is not None:
        return _random_poses(path, random, file, camera, target)
    if (axes := file.poses.axes) is not None:
        eye, still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        moves = [step * eye[axis] for axis in range(3) for step in axes.translations]
        turns = [math.radians(angle) * eye[axis] for axis in range(3) for angle in axes.turns_deg]
        shift, turn = torch.stack(moves + [still] * len(turns)), torch.stack([still] * len(moves) + turns)
        return rotations.exp(turn) @ _euler(_floats([axes.rotation_deg]).deg2rad())[0], _floats(axes.start) + shift
    listed = read_truth(beside(path, str(file.poses.file)))
    if len(listed) > MOST_FRAMES:
        raise ConfigError(f"{path}: poses.file: has {len(listed)} frames; give at most {MOST_FRAMES}")
    return listed.R, listed.t


def _random_poses(path: Path, poses: Random, file: PlanFile, camera: Camera, target: Target) -> tuple[Tensor, Tensor]:
    """Halton poses; those that do not keep the target in view are passed over unless the plan marks them."""
    if file.out_of_view == "mark":
        return _drawn(poses, file.seed, 0, poses.count)
    parts, found, tries = [], 0, poses.count * _TRIES
    for start in range(0, tries, _CHUNK):
        R, t = _drawn(poses, file.seed, start, min(start + _CHUNK, tries))
        use = markers_in_view(camera, target, R, t) == len(target)
        parts.append((R[use], t[use]))
        found += int(use.sum())
        if found >= poses.count or (found == 0 and start + _CHUNK >= _HOPELESS):
            break
    if found < poses.count:
        tried = min(start + _CHUNK, tries)
        raise ConfigError(
            f"{path}: poses: only {found} of {tried} random poses keep the target in view, {poses.count} are "
            "wanted; narrow x, y and tilt_deg or widen z"
        )
    R, t = (torch.cat(columns)[: poses.count] for columns in zip(*parts, strict=True))
    return R, t


def _drawn(poses: Random, seed: int, start: int, stop: int) -> tuple[Tensor, Tensor]:
    """R and t of some of the Halton poses, by their numbers from 0."""
    u = torch.stack([_halton(start, stop, base, seed) for base in _HALTON_BASES])
    x, y, z, tilt, roll = (
        _spread(value, row)
        for value, row in zip((poses.x, poses.y, poses.z, poses.tilt_deg, poses.roll_deg), u, strict=False)
    )
    azimuth, zero = u[5] * 2 * math.pi, torch.zeros_like(x)
    lean = torch.stack([azimuth.cos(), azimuth.sin(), zero], 1) * tilt.deg2rad()[:, None]
    R = rotations.exp(lean) @ rotations.exp(torch.stack([zero, zero, roll.deg2rad()], 1))
    return R, torch.stack([x, y, z], 1)


def _halton(start: int, stop: int, base: int, seed: int) -> Tensor:
    """Van der Corput sequence (Halton 1960), shifted by the seed modulo 1 (Cranley and Patterson 1976), or a part."""
    number = torch.arange(start + 1, stop + 1)
    value, fraction = torch.zeros(stop - start, dtype=torch.float64), 1.0
    while bool((number > 0).any()):
        fraction /= base
        value += fraction * (number % base).double()
        number = number // base
    shift = float(torch.rand(1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed % 2**40 + base)))
    return (value + shift) % 1.0 if seed else value


def _euler(angles: Tensor) -> Tensor:
    """(N, 3, 3) Rz(roll) Ry(yaw) Rx(pitch) of (N, 3) pitch, yaw, roll in rad."""
    axes = torch.eye(3, dtype=angles.dtype)
    pitch, yaw, roll = (rotations.exp(angles[:, i, None] * axes[i]) for i in range(3))
    return roll @ yaw @ pitch


def _spread(value: list[float], u: Tensor) -> Tensor:
    return value[0] + (value[1] - value[0]) * u


def _direction(degrees: Tensor) -> Tensor:
    """Unit vectors (N, 2) of angles (N,)."""
    return torch.stack([degrees.deg2rad().cos(), degrees.deg2rad().sin()], 1)


def _floats(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _backgrounds(path: Path, name: str | None) -> list[Path]:
    sources = [] if name is None else find_sources([Path(beside(path, name))])
    return [Path(str(source.path)).absolute() for source in sources if source.film is None]

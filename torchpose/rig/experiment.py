"""Evaluation of the paper's experiment (Algorithm 2, Fig. 13): what the camera measured beside what the robot did.

Static frames give the repeatability. For moves, the distance |p_i - p_init| that the target went in the camera is
compared with the tool's in the base; for turns, the angle between orientation i and the first. Both are the same in
every frame of reference, so neither needs a hand-eye calibration, and it makes no difference which of camera and target
the robot carries. A robot pose that is off counts as an error of the camera here: a UR5 repeats to 0.1 mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.config import validate
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.rows import Rows
from torchpose.io.manifest import read_manifest, read_records
from torchpose.io.rows import POSE_SCHEMA
from torchpose.io.writers import read_table
from torchpose.rig.plan import Label
from torchpose.rig.poses import to_transform

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_SIGMA = ("sx", "sy", "sz", "srx", "sry", "srz")
_NOISE = ("nx", "ny", "nz", "nrx", "nry", "nrz")
_USED = ("ok", "ambiguous")  # status of the rows that have a pose
_GROUPS = (("static", None), *(("rotation" if k > 2 else "translation", axis) for k, axis in enumerate(AXES)))


@dataclass(frozen=True, eq=False)
class Static(Rows):
    """N frames of a target at rest, mm and rad along and about the camera's axes."""

    deviation: Float[Tensor, "N 6"]  # from their mean
    sigma: Float[Tensor, "N 6"]  # standard deviations that the poses claim

    @property
    def spread(self) -> Float[Tensor, " 6"]:
        """Standard deviation of the frames, mm and rad."""
        return (self.deviation.square().sum(0) / (len(self) - 1)).sqrt()

    @property
    def claimed(self) -> Float[Tensor, " 6"]:
        """Root mean square of ``sigma``."""
        return self.sigma.square().mean(0).sqrt()


@dataclass(frozen=True, eq=False)
class Moves:
    """N moves along, or turns about, one axis, all from one origin; mm or rad."""

    axis: str  # one of `AXES`
    value: Float[Tensor, " N"]  # commanded; its sign is that of the next two
    robot: Float[Tensor, " N"]  # distance or angle from the origin
    camera: Float[Tensor, " N"]
    covariance: Float[Tensor, "N N"]  # of the camera's, from the poses' covariances; they share their origin

    @property
    def turn(self) -> bool:
        return self.axis in AXES[3:]

    @property
    def error(self) -> Float[Tensor, " N"]:
        """camera - robot."""
        return self.camera - self.robot

    @property
    def sigma(self) -> Float[Tensor, " N"]:
        """Standard deviation of the error, for an exact robot."""
        return self.covariance.diagonal().sqrt()

    @property
    def reduced_chi2(self) -> float:
        """Of the errors in their joint covariance: 1 where that is right and the robot exact."""
        return float(self.error @ torch.linalg.solve(self.covariance, self.error)) / len(self.error)

    @property
    def scale(self) -> tuple[float, float]:
        """How much longer the camera sees the moves, as a fraction, and its standard deviation (line through 0).

        Along the optical axis this is the relative error of the focal length, eq. (5); across it there is none.
        """
        weighted = torch.linalg.solve(self.covariance, torch.stack([self.robot, self.error], -1))
        information = float(self.robot @ weighted[:, 0])
        return float(self.robot @ weighted[:, 1]) / information, information**-0.5


@dataclass(frozen=True, eq=False)
class Experiment:
    """What `evaluate_experiment` found."""

    static: Static | None  # None where there are fewer than three frames of it
    moves: list[Moves]  # by axis, those that were captured
    distance: float  # mean of the target's depth, mm
    emulated: bool = False  # whether any part of the rig was
    unused: tuple[str, ...] = ()  # images without a pose
    bound: Experiment | None = None  # with the bound of every pose in place of its covariance, where one was given


@dataclass(frozen=True, eq=False)
class _Frames(Rows):
    """Frames with a pose of camera and robot."""

    group: Int[Tensor, " N"]  # place in `_GROUPS`
    value: Float[Tensor, " N"]  # commanded, mm or deg
    origin: Bool[Tensor, " N"]
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    own: Float[Tensor, "N 6 6"]  # the part that other frames do not share
    noise: Float[Tensor, "N 6 6"]
    systematic: Float[Tensor, "N 6 L"]
    robot_R: Float[Tensor, "N 3 3"]
    robot_t: Float[Tensor, "N 3"]


def evaluate_experiment(
    manifest: Path, poses: Path, bound: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Experiment:
    """Joins a capture manifest with the poses that ``torchpose estimate`` found in its frames, by image, and evaluates.

    Args:
        manifest: with waypoints of the kinds static, translation and rotation.
        poses: .csv, .jsonl or .parquet. What camera and target do to all frames alike cancels in differences as far as
            it does, which the latter two tell; a CSV holds no correlations, and its differences count all as their own.
        bound: covariance (N, 6, 6) that poses R (N, 3, 3), t (N, 3) could have at best.

    Raises:
        ConfigError: a file cannot be read, holds several targets, lacks a column or a robot pose, or has no frame in
            common with the other.
    """
    frames, unused, emulated = _join(manifest, poses)
    limit = None
    if bound is not None:
        best, none = bound(frames.R, frames.t), torch.zeros_like(frames.systematic)
        limit = _evaluate(replace(frames, covariance=best, own=best, noise=best, systematic=none), manifest)
    return replace(_evaluate(frames, manifest), emulated=emulated, unused=unused, bound=limit)


def _evaluate(frames: _Frames, manifest: Path) -> Experiment:
    rest, *groups = (frames[frames.group == number] for number in range(len(_GROUPS)))
    values = torch.cat([rest.t, rotations.log(rest.R @ rest.R[:1].mT)], -1)
    static = Static(values - values.mean(0), rest.noise.diagonal(dim1=-2, dim2=-1).sqrt())
    moves = [_moves(group, axis, manifest) for axis, group in zip(AXES, groups, strict=True) if len(group)]
    return Experiment(static if len(rest) > 2 else None, moves, float(frames.t[:, 2].mean()))


def _join(manifest: Path, poses: Path) -> tuple[_Frames, tuple[str, ...], bool]:
    """The frames of both files, the images without a pose, and whether the rig was emulated."""
    table = read_table(poses, POSE_SCHEMA, ("frame", "target", "status", *_POSE, *_SIGMA))
    targets = sorted({row["target"] for row in table})
    if len(targets) > 1:
        raise ConfigError(f"{poses}: target: holds {', '.join(targets)}; estimate the experiment with one --target")
    by_frame = {row["frame"]: row for row in table}
    robot = {frame.image: frame.robot_pose for frame in read_manifest(manifest)}
    rows, tool, labels, unused, emulated = [], [], [], [], False
    for number, record in read_records(manifest):
        emulated = emulated or bool(record.get("emulated"))
        image = record.get("image")
        if record.get("record") != "frame" or not isinstance(image, str) or image not in by_frame:
            continue
        if not record.get("waypoint"):
            continue
        label = validate(Label, record["waypoint"], f"{manifest}: line {number}: waypoint")
        if (label.kind, label.axis) not in _GROUPS:
            continue
        if by_frame[image]["status"] not in _USED:
            unused.append(str(image))
            continue
        if robot[image] is None:
            raise ConfigError(f"{manifest}: line {number}: robot_pose: is missing; capture with the robot")
        rows.append(by_frame[image])
        tool.append(robot[image])
        labels.append(label)
    if not rows:
        raise ConfigError(f"{poses}: frame: no pose of a static, translation or rotation frame of {manifest}")
    frames = _Frames(
        torch.tensor([_GROUPS.index((label.kind, label.axis)) for label in labels]),
        torch.tensor([label.value for label in labels], dtype=torch.float64),
        torch.tensor([label.origin for label in labels]),
        *to_transform([[row[column] for column in _POSE] for row in rows]),
        *_covariances(rows),
        *to_transform(tool),
    )
    return frames, tuple(unused), emulated


def _covariances(rows: Sequence[dict[str, Any]]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Covariances (N, 6, 6) of all, what other frames do not share, and noise, and the systematic part (N, 6, L)."""

    def matrices(column: str, deviations: tuple[str, ...]) -> Tensor:
        if all(row.get(column) is not None for row in rows):
            return torch.tensor([row[column] for row in rows], dtype=torch.float64)
        names = deviations if all(row.get(name) is not None for row in rows for name in deviations) else _SIGMA
        deviation = torch.tensor([[row[name] for name in names] for row in rows], dtype=torch.float64)
        return torch.diag_embed(deviation.square())

    whole, noise = matrices("covariance", _SIGMA), matrices("noise_covariance", _NOISE)
    if any(row.get("systematic") is None for row in rows):
        return whole, whole, noise, whole[..., :0]
    systematic = torch.tensor([row["systematic"] for row in rows], dtype=torch.float64)
    systematic = systematic.view(len(rows), 6, -1)
    return whole, whole - systematic @ systematic.mT, noise, systematic


def _moves(frames: _Frames, axis: str, manifest: Path) -> Moves:
    start, rest = frames[frames.origin][:1], frames[~frames.origin]
    if not len(start) or not len(rest):
        lacking = "at the origin" if not len(start) else "away from it"
        raise ConfigError(f"{manifest}: waypoint: {axis}: has no frame {lacking}; capture it")
    if axis in AXES[3:]:
        camera, robot = rotations.log(rest.R @ start.R.mT), rotations.log(rest.robot_R @ start.robot_R.mT)
        value, block = rest.value.deg2rad(), slice(3, 6)
    else:
        camera, robot = rest.t - start.t, rest.robot_t - start.robot_t
        value, block = rest.value, slice(0, 3)
    sign = value.sign()
    along = torch.nn.functional.normalize(camera, dim=-1) * sign[:, None]
    # every difference has the noise of its own frame and that of the origin, which all share
    common = along @ start.own[0, block, block] @ along.T
    own = (along[:, None] @ rest.own[:, block, block] @ along[..., None]).flatten()
    # and what the numbers that all share leave of themselves in it
    left = (along[:, None] @ (rest.systematic - start.systematic)[:, block])[:, 0]
    covariance = common + own.diag() + left @ left.mT
    return Moves(axis, value, sign * robot.norm(dim=-1), sign * camera.norm(dim=-1), covariance)


def unit(axis: str) -> tuple[str, float]:
    """Unit in which errors along an axis are shown, and how many there are in a mm or rad."""
    return ("mdeg", 1e3 * math.degrees(1)) if axis in AXES[3:] else ("um", 1e3)

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
from torch import Tensor

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.manifest import read_manifest, read_records
from torchpose.io.writers import read_table

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_COLUMNS = ("frame", "target", "status", "tx", "ty", "tz", "rx", "ry", "rz", "sx", "sy", "sz", "srx", "sry", "srz")
_USED = ("ok", "ambiguous")  # status of the rows that have a pose
_KINDS = ("static", "translation", "rotation")


@dataclass(frozen=True, eq=False)
class Static:
    """N frames of a target at rest.

    Attributes:
        deviation: (N, 6) from their mean, mm and rad along and about the camera's axes.
        sigma: (N, 6) standard deviations that the poses claim.
    """

    deviation: Tensor
    sigma: Tensor

    @property
    def spread(self) -> Tensor:
        """(6,) standard deviation of the frames, mm and rad."""
        return (self.deviation.square().sum(0) / (len(self.deviation) - 1)).sqrt()

    @property
    def claimed(self) -> Tensor:
        """(6,) root mean square of ``sigma``."""
        return self.sigma.square().mean(0).sqrt()


@dataclass(frozen=True, eq=False)
class Moves:
    """N moves along, or turns about, one axis, all from one origin.

    Attributes:
        axis: one of `AXES`. value: (N,) commanded, mm or rad; its sign is that of ``robot`` and ``camera``.
        robot, camera: (N,) distance or angle from the origin, mm or rad.
        covariance: (N, N) of the camera's, from the poses' covariances; they share their origin.
    """

    axis: str
    value: Tensor
    robot: Tensor
    camera: Tensor
    covariance: Tensor

    @property
    def turn(self) -> bool:
        return self.axis in AXES[3:]

    @property
    def error(self) -> Tensor:
        """(N,) camera - robot."""
        return self.camera - self.robot

    @property
    def sigma(self) -> Tensor:
        """(N,) standard deviation of the error, for an exact robot."""
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
    """What `evaluate_experiment` found.

    Attributes:
        static: None where there are fewer than three frames of it. moves: by axis, those that were captured.
        distance: mean of the target's depth, mm. emulated: whether any part of the rig was.
        unused: images without a pose.
        bound: the same with the bound of every pose in place of its covariance, where one was given.
    """

    static: Static | None
    moves: list[Moves]
    distance: float
    emulated: bool
    unused: list[str]
    bound: Experiment | None = None


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames with a pose: waypoints, poses of camera and robot, covariance (N, 6, 6)."""

    waypoints: list[dict[str, Any]]
    R: Tensor
    t: Tensor
    covariance: Tensor
    robot_R: Tensor
    robot_t: Tensor

    def __getitem__(self, index: Sequence[int]) -> _Frames:
        at = list(index)
        tensors = (self.R[at], self.t[at], self.covariance[at], self.robot_R[at], self.robot_t[at])
        return _Frames([self.waypoints[k] for k in at], *tensors)


def evaluate_experiment(
    manifest: Path, poses: Path, bound: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Experiment:
    """Joins a capture manifest with the poses that ``torchpose estimate`` found in its frames, by image, and evaluates.

    Args:
        manifest: with waypoints of the kinds static, translation and rotation. poses: .csv, .jsonl or .parquet; a CSV
            holds no correlations, which count for tilted targets. Estimate with a camera file without
            ``camera_matrix_covariance``: errors of the camera are common to all frames and cancel in differences.
        bound: covariance (N, 6, 6) that poses R (N, 3, 3), t (N, 3) could have at best.

    Raises:
        ConfigError: a file cannot be read, holds several targets, lacks a column or a robot pose, or has no frame in
            common with the other.
    """
    frames, unused, emulated = _join(manifest, poses)
    if not frames.waypoints:
        raise ConfigError(f"{poses}: frame: no pose of a static, translation or rotation frame of {manifest}")
    where = f"{manifest}: waypoint"
    limit = None
    if bound is not None:
        limit = _evaluate(replace(frames, covariance=bound(frames.R, frames.t)), where)
    return replace(_evaluate(frames, where), emulated=emulated, unused=unused, bound=limit)


def _evaluate(frames: _Frames, where: str) -> Experiment:
    groups: dict[tuple[str, str | None], list[int]] = {}
    for k, waypoint in enumerate(frames.waypoints):
        groups.setdefault((str(waypoint.get("kind")), waypoint.get("axis")), []).append(k)
    moves = []
    for axis in AXES:
        members = groups.get(("rotation" if axis in AXES[3:] else "translation", axis))
        if members:
            moves.append(_moves(frames[members], axis, f"{where}: {axis}"))
    resting = groups.get(("static", None), [])
    static = _static(frames[resting]) if len(resting) > 2 else None
    return Experiment(static, moves, float(frames.t[:, 2].mean()), False, [])


def _join(manifest: Path, poses: Path) -> tuple[_Frames, list[str], bool]:
    robot = {frame.image: frame.robot_pose for frame in read_manifest(manifest)}
    table = read_table(poses)
    missing = [name for name in _COLUMNS if table and name not in table[0]]
    if missing:
        raise ConfigError(f"{poses}: {missing[0]}: column is missing; give what torchpose estimate wrote")
    targets = sorted({str(row["target"]) for row in table})
    if len(targets) > 1:
        raise ConfigError(f"{poses}: target: holds {', '.join(targets)}; estimate the experiment with one --target")
    by_frame = {str(row["frame"]): row for row in table}
    rows, tool, waypoints, unused = [], [], [], []
    emulated = False
    for number, record in read_records(manifest):
        emulated = emulated or bool(record.get("emulated"))
        image, waypoint = record.get("image"), record.get("waypoint")
        if record.get("record") != "frame" or image not in by_frame or not isinstance(waypoint, dict):
            continue
        if waypoint.get("kind") not in _KINDS:
            continue
        if by_frame[image]["status"] not in _USED:
            unused.append(str(image))
            continue
        if robot[image] is None:
            raise ConfigError(f"{manifest}: line {number}: robot_pose: is missing; capture with the robot")
        rows.append(by_frame[image])
        tool.append(robot[image])
        waypoints.append(waypoint)
    pose = torch.tensor([[float(row[c]) for c in _COLUMNS[3:9]] for row in rows], dtype=torch.float64).reshape(-1, 6)
    base = torch.tensor(tool, dtype=torch.float64).reshape(-1, 6)
    covariance = torch.tensor([_covariance(row) for row in rows], dtype=torch.float64).reshape(-1, 6, 6)
    frames = _Frames(
        waypoints, rotations.exp(pose[:, 3:]), pose[:, :3], covariance, rotations.exp(base[:, 3:]), base[:, :3]
    )
    return frames, unused, emulated


def _covariance(row: dict[str, Any]) -> list[list[float]]:
    if row.get("covariance") is not None:
        return [list(map(float, line)) for line in row["covariance"]]
    sigma = [float(row[c]) for c in _COLUMNS[9:]]
    return [[s * s if i == j else 0.0 for j in range(6)] for i, s in enumerate(sigma)]


def _static(f: _Frames) -> Static:
    turn = rotations.log(f.R @ f.R[:1].mT)
    values = torch.cat([f.t, turn], -1)
    return Static(values - values.mean(0), f.covariance.diagonal(dim1=-2, dim2=-1).sqrt())


def _moves(f: _Frames, axis: str, where: str) -> Moves:
    origin = [k for k, waypoint in enumerate(f.waypoints) if waypoint.get("origin")]
    away = [k for k, waypoint in enumerate(f.waypoints) if not waypoint.get("origin")]
    if not origin or not away:
        raise ConfigError(f"{where}: has no frame {'at the origin' if not origin else 'away from it'}; capture it")
    start, rest = f[origin[:1]], f[away]
    if axis in AXES[3:]:
        camera, robot = rotations.log(rest.R @ start.R.mT), rotations.log(rest.robot_R @ start.robot_R.mT)
        block = slice(3, 6)
    else:
        camera, robot = rest.t - start.t, rest.robot_t - start.robot_t
        block = slice(0, 3)
    value = torch.tensor([float(waypoint["value"]) for waypoint in rest.waypoints], dtype=torch.float64)
    sign = value.sign()
    along = torch.nn.functional.normalize(camera, dim=-1) * sign[:, None]
    # every difference has the noise of its own frame and that of the origin, which all share
    shared = along @ start.covariance[0, block, block] @ along.T
    own = (along[:, None] @ rest.covariance[:, block, block] @ along[..., None]).flatten()
    return Moves(
        axis,
        value.deg2rad() if axis in AXES[3:] else value,
        sign * robot.norm(dim=-1),
        sign * camera.norm(dim=-1),
        shared + torch.diag(own),
    )


def unit(axis: str) -> tuple[str, float]:
    """Unit in which errors along an axis are shown, and how many there are in a mm or rad."""
    return ("mdeg", 1e3 * math.degrees(1)) if axis in AXES[3:] else ("um", 1e3)

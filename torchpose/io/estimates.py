"""From a batch of frames to its rows: what every engine does with the frames that it has read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from typing import Any

import torch
from torch import Tensor

from torchpose.camera import LINEAR, Camera
from torchpose.geometry import rotations
from torchpose.handeye import HandEye
from torchpose.io.lanes import Lanes
from torchpose.io.reader import Batch, FrameReader
from torchpose.io.rows import BASE_SCHEMA, POSE_SCHEMA, Row, Schema, base_cells, detection_rows, fault_row, pose_rows
from torchpose.io.sources import Source
from torchpose.pipeline import PoseEstimator
from torchpose.results import Poses
from torchpose.target import Target
from torchpose.tracking import Tracker

Paint = Callable[[Tensor, Poses, list[str]], None]
"""Is given the frames of a group, their poses and their names."""
Measure = Callable[[Tensor, list[str]], Poses]
"""Poses of frames of these names."""


@dataclass(frozen=True)
class Estimation:
    """What the rows of a run depend on, besides its frames.

    Attributes:
        camera: of the frames; the reader takes them to linear ones by its tone.
        targets: to look for.
        hand_eye: adds the poses in the robot base.
        method: last stage, see `PoseEstimator`.
        instances: most copies of a target in a frame.
        relative_to: name of the target in whose frame the poses of the others are given; it has no rows of its own.
        upright: whether the boards among the targets are said to be upright, which the targets hold already.
        track: whether frames follow each other, and are measured near the last pose.
    """

    camera: Camera
    targets: list[Target]
    hand_eye: HandEye | None = None
    method: str = "photometric"
    instances: int = 1
    relative_to: str | None = None
    upright: bool = False
    track: bool = False

    @property
    def rows_of(self) -> list[Target]:
        """Targets that have rows."""
        return [target for target in self.targets if target.name != self.relative_to]

    @property
    def schema(self) -> Schema:
        """Columns of the rows."""
        return POSE_SCHEMA | (BASE_SCHEMA if self.hand_eye else {})

    def origin(self, roots: Iterable[str], *, detections: bool) -> dict[str, Any]:
        """The same for `ResultStore`. Names are those that its error messages shall say.

        Args:
            roots: the places that names of frames are relative to.
            detections: whether there is a table of the markers.
        """
        return {
            "torchpose version": version("torchpose"),
            "--camera": digest(self.camera),
            "--target": [[target.name, digest(target)] for target in self.targets],
            "--hand-eye": None if self.hand_eye is None else digest(self.hand_eye),
            "--method": self.method,
            "--tone": str(self.camera.tone or "linear"),
            "--instances": self.instances,
            "--relative-to": self.relative_to,
            "--assume-upright": self.upright,
            "--track": self.track,
            "--detections": detections,
            "INPUT": sorted(set(roots)),
        }

    def estimator(self) -> PoseEstimator:
        """Of linear frames: the reader hands on such ones."""
        method: Any = self.method  # it checks
        return PoseEstimator(replace(self.camera, tone=None), self.targets, instances=self.instances, method=method)

    def records(
        self, batch: Batch, estimator: PoseEstimator, paint: Paint | None = None, measure: Measure | None = None
    ) -> list[Row]:
        """Rows and detections of every frame of a batch, see `ResultStore.append`; by ``measure`` if that is given."""
        names = [target.name for target in self.targets]
        records: dict[str, Row] = {s.name: {"frame": s.name, "rows": [], "detections": []} for s in batch.sources}
        for position, fault in batch.faults.items():
            frame = batch.sources[position].name
            records[frame]["rows"] = [fault_row(frame, t.name, fault.status, fault.reason) for t in self.rows_of]
        for positions, frames in batch.groups:
            sources = [batch.sources[position] for position in positions]
            frame_names = [source.name for source in sources]
            there = frames.to(estimator.table.ids.device, non_blocking=True)
            poses = (estimator(there) if measure is None else measure(there, frame_names)).cpu()
            if paint is not None:
                paint(frames, poses, frame_names)
            for row in self.rows(poses, sources):
                records[row["frame"]]["rows"].append(row)
            for row in detection_rows(poses.detections, frame_names, names):
                records[row["frame"]]["detections"].append(row)
        return list(records.values())

    def rows(self, poses: Poses, sources: Sequence[Source]) -> list[Row]:
        """Rows of the poses of frames, which are of these sources."""
        names = [target.name for target in self.targets]
        given = _of_parts(poses, self.targets)
        if self.relative_to is not None:
            given = given.relative_to(names.index(self.relative_to))
        rows = pose_rows(given, [source.name for source in sources], names)
        if self.hand_eye is not None:
            _add_base_cells(rows, given, sources, self.hand_eye)
        return rows


@torch.inference_mode()
def estimated(
    work: Estimation, estimator: PoseEstimator, paint: Paint | None, threads: int, batches: Sequence[Sequence[Source]]
) -> Iterator[list[Row]]:
    """Records of batches of sources, one list a batch, see `Estimation.records`.

    Args:
        threads: that decode ahead.
        paint: see `Estimation.records`.
    """
    for batch in _read(work, estimator, threads, batches):
        yield work.records(batch, estimator, paint)


def _read(
    work: Estimation, estimator: PoseEstimator, threads: int, batches: Sequence[Sequence[Source]]
) -> Iterable[Batch]:
    camera, pinned = work.camera, estimator.table.ids.is_cuda
    tone = camera.tone or LINEAR
    return FrameReader(batches, camera.width, camera.height, threads=threads, tone=tone, pinned=pinned)


@torch.inference_mode()
def tracked(
    work: Estimation, estimator: PoseEstimator, paint: Paint | None, threads: int, lanes: Sequence[Lanes]
) -> Iterator[list[Row]]:
    """As `estimated`, of frames that follow each other: one list for all frames of some lanes."""
    for some in lanes:
        tracker = Tracker(estimator)

        def measure(frames: Tensor, names: list[str], some: Lanes = some, tracker: Tracker = tracker) -> Poses:
            return tracker(frames, [some.lane[name] for name in names])

        read = _read(work, estimator, threads, some.batches)
        yield [record for batch in read for record in work.records(batch, estimator, paint, measure)]


def _of_parts(poses: Poses, targets: list[Target]) -> Poses:
    """Poses of the parts, for the targets that say where their part is."""
    parts = [target.part_from_target for target in targets]
    if not any(parts):
        return poses
    still = (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    rotation, translation = (torch.stack(tensors) for tensors in zip(*(part or still for part in parts), strict=True))
    return poses.moved(rotation[poses.target], translation[poses.target])


def _add_base_cells(rows: list[Row], poses: Poses, sources: Sequence[Source], hand_eye: HandEye) -> None:
    """Adds the poses in the robot base; cells stay empty where a camera on the tool has no robot pose."""
    robot = None
    if hand_eye.mount == "tool":
        unknown = (float("nan"),) * 6
        tool = torch.tensor([source.robot_pose or unknown for source in sources], dtype=torch.float64)[poses.frame]
        robot = (rotations.exp(tool[:, 3:]), tool[:, :3])
    based = poses.seen_from(*hand_eye.base_from_camera(robot))
    based = replace(based, covariance=based.covariance + hand_eye.base_covariance(based.t, robot))
    for row, cells in zip(rows, base_cells(based), strict=True):
        row.update(cells)


def digest(model: Any) -> str:
    """SHA-256 of the values of a dataclass: the same for the same numbers, however the file is laid out."""
    values = [(field.name, getattr(model, field.name)) for field in fields(model) if field.name != "source"]
    plain = [(name, value.tolist() if hasattr(value, "tolist") else value) for name, value in values]
    return hashlib.sha256(repr(plain).encode()).hexdigest()

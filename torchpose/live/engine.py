"""The one thread that takes the newest frame, estimates its pose and lays down what there is to show.

What it lays down is a `Snapshot` that nobody changes; whoever looks takes the last one and waits for nobody.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.design.predict import Imaging, edge_covariance
from torchpose.errors import TorchposeError
from torchpose.io.rows import Row, fault_row, pose_rows
from torchpose.live.measures import (
    PictureMeasures,
    RingMeasures,
    picture_measures,
    ring_measures,
    tilt_deg,
    usable_blurs,
    white_of,
)
from torchpose.live.recording import Recorder
from torchpose.live.sources import Frames, Shot
from torchpose.pipeline import PoseEstimator
from torchpose.report.overlay import Overlay
from torchpose.results import Detections, Poses
from torchpose.rig.faults import RigFault
from torchpose.target import Target
from torchpose.tracking import Tracker

AGAIN_S = 2.0  # after which a camera that failed is opened anew
_KEPT = 600  # points of the strips (convention): two minutes at five frames a second
_RATED = 8  # frames over which the rate is told
# what focus and light can reach: a sharp lens, and print and paper at the ends of the range (convention)
_WELL = Imaging(psf_sigma=0.7, dark=25.0, light=230.0)
_NOISE_RANGE = (0.3, 60.0)  # grey levels of 0 to 255: rounding alone, and what a prediction takes


@dataclass(frozen=True)
class Accuracy:
    """Standard deviations of the position along its worst axis, um: stated, of the frame's noise alone, and predicted
    for this pose with a sharp and well lit picture; and that axis."""

    axis: str
    stated_um: float
    repeat_um: float
    reachable_um: float | None


@dataclass(frozen=True, eq=False)
class Sight:
    """What was seen in a frame.

    Attributes:
        shot: the frame.
        row: as in JSON lines.
        outlines: of the markers found: id, centre, outer and inner ellipse (centre, semi-axes, rad), px.
        axes: pixels (3, points, 2) of the target's axes; None without a pose.
        missing: ids of markers that were not found.
    """

    shot: Shot
    row: Row
    outlines: list[Row]
    axes: list[Any] | None
    missing: list[int]
    rings: list[RingMeasures]
    picture: PictureMeasures | None
    tilt_deg: float | None
    accuracy: Accuracy | None


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to show, at a moment.

    Attributes:
        version: grows with every snapshot.
        number: of frames looked at.
        sight: of the newest one.
        ready_s: Unix time at which it was there.
        rate: frames/s looked at of late.
        passed_over: frames of the source that nobody had time for, in all.
        sharpest: least blur of late, px.
        fault: why no frames come, in a word.
    """

    version: int
    number: int
    sight: Sight | None
    ready_s: float
    rate: float | None = None
    passed_over: int = 0
    sharpest: float | None = None
    fault: str | None = None


Point = tuple[Any, ...]
"""Of the strips: Unix time, status, tx ty tz (mm), quaternion, standard deviations s and n of place and turn."""
_POINT = ("tx", "ty", "tz", "sx", "sy", "sz", "srx", "sry", "srz", "nx", "ny", "nz", "nrx", "nry", "nrz")


class Observer:
    """Looks at frames, one after the other: pose, row, and what there is to turn.

    Where the last frame had a pose, the next one is looked for near it, and everywhere where that fails.

    Args:
        camera: of the frames.
        target: the one that is looked for.
        options: of `PoseEstimator`.
    """

    def __init__(self, camera: Camera, target: Target, **options: Any) -> None:
        self.camera, self.target = camera, target
        self.estimator = PoseEstimator(camera, target, **options)
        self._tracker = Tracker(self.estimator)
        self._overlay = Overlay(camera, [target])

    def look(self, shot: Shot) -> Sight:
        """What is seen in a frame."""
        if shot.image is None:
            assert shot.fault is not None
            row = fault_row(shot.name, self.target.name, shot.fault.status, shot.fault.reason)
            return Sight(shot, row, [], None, self.target.ids.tolist(), [], None, None, None)
        frame = torch.from_numpy(shot.image)
        poses = self._tracker(frame)
        part = self.target.part_from_target
        (row,) = pose_rows(poses if part is None else poses.moved(*part), [shot.name], [self.target.name])
        outlines = _outlines(poses.detections)
        white = shot.white or white_of(shot.image)
        picture = picture_measures(shot.image, white)
        there = bool(poses.t.isfinite().all())
        seen = {outline["id"] for outline in outlines}
        return Sight(
            shot,
            row,
            outlines,
            _listed(torch.from_numpy(self._overlay.project_axes(poses)[0])) if there else None,
            [number for number in self.target.ids.tolist() if number not in seen],
            ring_measures(frame, poses.detections, white),
            picture,
            tilt_deg(poses),
            self._accuracy(poses, row, picture) if there else None,
        )

    def _accuracy(self, poses: Poses, row: Row, picture: PictureMeasures) -> Accuracy:
        stated = {axis: 1e3 * row[f"s{axis}"] for axis in "xyz"}
        worst = max(stated, key=stated.__getitem__)
        low, high = _NOISE_RANGE
        imaging = replace(_WELL, noise=min(max(255 * picture.noise, low), high))
        variance = edge_covariance(self.camera, self.target, poses.R, poses.t, imaging).diagonal(dim1=1, dim2=2)
        least = 1e3 * float(variance[0, "xyz".index(worst)].sqrt())
        return Accuracy(worst, stated[worst], 1e3 * row[f"n{worst}"], least if math.isfinite(least) else None)


def _outlines(found: Detections) -> list[Row]:
    numbers = torch.cat([found.center, found.outer, found.inner], 1).double().round(decimals=4).tolist()
    return [
        {"id": marker, "center": n[:2], "outer": n[2:7], "inner": n[7:] if math.isfinite(n[-1]) else None}
        for marker, n in sorted(zip(found.marker.tolist(), numbers, strict=True))
    ]


def _listed(points: Tensor) -> list[Any]:
    """Polylines as lists, cut off where they leave what can be seen."""
    return [[point for point in line if math.isfinite(point[0])] for line in points.round(decimals=2).tolist()]


class Live:
    """Looks at the newest frame of a source, for use in a ``with`` block.

    Args:
        frames: the source.
        observer: looks at them.
        recorder: is offered every frame.
        tell: is given a line for every fault.

    Attributes:
        snapshot: the last one.
        changed: called, in the thread, with every new snapshot.
    """

    def __init__(self, frames: Frames, observer: Observer, recorder: Recorder, tell: Callable[[str], None]) -> None:
        self.frames, self.observer, self.recorder = frames, observer, recorder
        self.snapshot = Snapshot(0, 0, None, time.time())
        self.changed: Callable[[], None] = lambda: None
        self._tell = tell
        self._points: deque[Point] = deque(maxlen=_KEPT)
        self._blurs: deque[float] = deque(maxlen=_KEPT)
        self._times: deque[float] = deque(maxlen=_RATED)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="estimator", daemon=True)

    def __enter__(self) -> Live:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    @property
    def points(self) -> list[Point]:
        """Of the strips, the newest last."""
        while True:
            try:
                return list(self._points)
            except RuntimeError:  # one has come meanwhile
                continue

    def _run(self) -> None:
        with torch.inference_mode():
            while not self._end.is_set():
                try:
                    with self.frames as frames:
                        while True:
                            self._take(frames)
                except _Ended:
                    return
                except RigFault as fault:
                    self._fail(fault.reason.value, str(fault))
                except TorchposeError as error:
                    self._fail("source", str(error))
                except Exception as error:  # of the program: the page stays, and says so
                    self._fail("internal", f"internal: {type(error).__name__}: {error}; please report it")

    def _take(self, frames: Frames) -> None:
        """Looks at the next frame."""
        self._wait(0.0)
        shot = frames.newest(self._wait)
        sight = self.observer.look(shot)
        self.recorder.offer(shot, sight.row["status"])
        before, now = self.snapshot, time.time()
        self._times.append(time.monotonic())
        span = self._times[-1] - self._times[0]
        self._points.append(point_of(sight))
        self._blurs.extend([median(blurs)] if (blurs := usable_blurs(sight.rings)) else [])
        self._publish(
            Snapshot(
                before.version + 1,
                before.number + 1,
                sight,
                now,
                (len(self._times) - 1) / span if span > 0 else None,
                before.passed_over + shot.passed_over,
                min(self._blurs, default=None),
            )
        )

    def _fail(self, reason: str, line: str) -> None:
        """Shows and tells why there is no frame, and waits."""
        if self.snapshot.fault != reason:
            self._tell(line)
        self._publish(replace(self.snapshot, version=self.snapshot.version + 1, fault=reason, rate=None))
        self._times.clear()
        self._end.wait(AGAIN_S)

    def _publish(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self.changed()

    def _wait(self, seconds: float) -> None:
        if self._end.wait(seconds):
            raise _Ended


class _Ended(Exception):
    """The block is left."""


def point_of(sight: Sight) -> Point:
    """The point of the strips that a frame gives."""
    row = sight.row
    return (round(sight.shot.taken_s, 3), row["status"], row["quaternion"], *(row[name] for name in _POINT))

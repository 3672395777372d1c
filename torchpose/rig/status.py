"""The status of every frame while capturing, so that a target out of view is seen at once and not after the session."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

import torch

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.pipeline import PoseEstimator
from torchpose.results import Status
from torchpose.rig.cameras import Frame
from torchpose.rig.settings import CameraSettings
from torchpose.target import Target


class LiveStatus:
    """Estimates poses in a thread of its own, for use in a ``with`` block; at most one frame is waiting.

    Args:
        estimators: by camera name; frames of other cameras are not looked at.
    """

    def __init__(self, estimators: Mapping[str, PoseEstimator]) -> None:
        self.counts: Counter[str] = Counter()  # targets so far by the name of their status
        self._estimators = estimators
        self._worker = ThreadPoolExecutor(1)
        self._last: Future[None] | None = None

    @classmethod
    def load(cls, cameras: Sequence[str], targets: Sequence[str], rig: Sequence[CameraSettings]) -> LiveStatus:
        """From camera files in the order of the rig's cameras and target files; none of both: nothing is estimated.

        Raises:
            ConfigError: a file is wrong, or camera files are too few, too many or of another frame size.
        """
        if bool(cameras) != bool(targets):
            raise ConfigError("--camera, --target: one of both is given; give both to see the status, or none")
        if cameras and len(cameras) != len(rig):
            raise ConfigError(f"--camera: {len(cameras)} given for {len(rig)} cameras of the rig; give one for each")
        known = [Target.load(name) for name in targets]
        estimators = {}
        for path, settings in zip(cameras, rig, strict=False):
            camera = Camera.load(path)
            if (camera.width, camera.height) != (settings.width, settings.height):
                there = f"camera {settings.name} of the rig has {settings.width} x {settings.height}"
                size = f"image_width, image_height: {camera.width} x {camera.height}"
                raise ConfigError(f"{path}: {size}, but {there}; give its own camera file")
            estimators[settings.name] = PoseEstimator(camera, known, method="centers")
        return cls(estimators)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.shutdown(cancel_futures=True)

    def wait(self) -> None:
        """Returns when the last frame is counted."""
        if self._last is not None:
            self._last.result()

    def look(self, frame: Frame) -> None:
        """Has a frame estimated, after the one before."""
        if frame.camera in self._estimators:
            self.wait()
            self._last = self._worker.submit(self._estimate, frame)

    def _estimate(self, frame: Frame) -> None:
        poses = self._estimators[frame.camera](torch.from_numpy(frame.image)[None])
        self.counts.update(Status(status).name.lower() for status in poses.status.tolist())

"""Sequences of frames: each is measured near the last pose, and all over the frame where that does not show all."""

from collections.abc import Hashable, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpose.errors import ArgumentError, ConfigError
from torchpose.pipeline import PoseEstimator, RigEstimator
from torchpose.results import Poses


class Tracker:
    """Poses in one or more sequences, a frame of each at a time, by the poses of their last frames.

    Rows are those of the estimator alone, to a fraction of their deviations (`PoseEstimator.forward`, ``near``): what
    the last pose does not lead to is looked for everywhere, in the same call. So a target may come, go and jump.

    Args:
        estimator: of one camera. Where it looks for boards or for several copies, it looks for them everywhere.

    Raises:
        ConfigError: the estimator is one of several cameras.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        if isinstance(estimator, RigEstimator):
            raise ConfigError("estimator: is of several cameras; give that of one, a Tracker for each")
        self.estimator = estimator
        self._last: dict[Hashable, tuple[Tensor, Tensor]] = {}

    def __call__(self, frames: Tensor | NDArray[Any], sequences: Sequence[Hashable] | None = None) -> Poses:
        """Poses of the next frame of each sequence.

        Args:
            frames: B of them, as `PoseEstimator` takes them.
            sequences: names of the sequences that they are of, all different; by default the numbers 0 to B - 1.

        Raises:
            ArgumentError: not one name for each frame, or one twice.
            FrameError: as for `PoseEstimator`.
        """
        count = 1 if frames.ndim == 2 else len(frames)
        names: Sequence[Hashable] = range(count) if sequences is None else sequences
        if len(names) != count or len(set(names)) != count:
            raise ArgumentError(f"sequences: {len(names)} names for {count} frames; give each frame one of its own")
        if self.estimator.instances > 1 or not count:
            return self.estimator(frames)
        poses: Poses = self.estimator(frames, near=self._near(names))
        rows = poses.R.view(count, -1, 3, 3), poses.t.view(count, -1, 3)
        self._last.update(zip(names, zip(*(part.unbind() for part in rows), strict=True), strict=True))
        return poses

    def forget(self, *sequences: Hashable) -> None:
        """Drops what is known of these sequences, or of all where none is given: their next frames are first ones."""
        for name in sequences or list(self._last):
            self._last.pop(name, None)

    def _near(self, names: Sequence[Hashable]) -> tuple[Tensor, Tensor] | None:
        """The last poses of sequences, as (B, T, 3, 3) and (B, T, 3); NaN where there is none."""
        known = [self._last[name] for name in names if name in self._last]
        if not known:
            return None
        nowhere = tuple(torch.full_like(part, torch.nan) for part in known[0])
        R, t = zip(*(self._last.get(name, nowhere) for name in names), strict=True)
        return torch.stack(R), torch.stack(t)

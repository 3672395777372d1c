"""What the rows of a run say together of target and camera file: the same misfit in frame after frame is no chance."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

_FEW = 3  # frames, with fewer of which nothing is the same in all
_AXES = ("x", "y", "z", "edge")


class Misfits:
    """Misfits of the ``ok`` rows of one target, and how many rows show it mirrored."""

    def __init__(self) -> None:
        self.frames = self.mirrored = 0
        self.kinds: Counter[str] = Counter()
        self._count: np.ndarray | int = 0
        self._sum: np.ndarray | float = 0.0
        self._square: np.ndarray | float = 0.0

    def add(self, row: dict[str, Any]) -> None:
        """Counts a row of `rows.POSE_SCHEMA`."""
        self.mirrored += row["reason"] == "mirrored"
        if row["status"] != "ok":
            return
        self.frames += 1
        if row.get("misfit"):
            self.kinds[row["misfit"]] += 1
        if not row.get("place"):
            return
        place = np.array([marker or [np.nan] * 4 for marker in row["place"]], dtype=float)
        seen = np.isfinite(place)
        place = np.where(seen, place, 0.0)
        if np.ndim(self._sum) and np.shape(self._sum) != place.shape:  # rows of another target file of that name
            return
        self._count, self._sum, self._square = self._count + seen, self._sum + place, self._square + place**2

    def lines(self, name: str, ids: Sequence[int]) -> list[str]:
        """What there is to tell of the target with markers ``ids``, in order; nothing where all is as its file says."""
        lines = []
        if self.kinds:
            kinds = ", ".join(f"{kind} {count}" for kind, count in self.kinds.most_common())
            lines.append(
                f"{name}: {sum(self.kinds.values())} of {self.frames} ok rows show more than noise and the stated "
                f"uncertainties ({kinds}); it is counted in s*"
            )
        mean, scatter = self._common()
        size = np.sqrt(np.nanmean(mean[: len(ids), :3] ** 2) * 3) if mean.size else 0.0
        # the mean of n independent places would be sqrt(n) smaller than they are
        if mean.size and size > 2 * scatter / math.sqrt(self.frames) and size > 0:
            places = "; ".join(
                f"{marker} ({', '.join(f'{axis} {1e3 * v:+.1f}' for axis, v in zip(_AXES, at, strict=True))})"
                for marker, at in zip(ids, mean, strict=False)
            )
            lines.append(
                f"{name}: markers sit {1e3 * size:.2g} um beside their places, the same in all {self.frames} frames: "
                "the target or the camera file is off; torchpose calibrate --measure-target measures both. By marker, "
                f"um: {places}"
            )
        return lines

    def _common(self) -> tuple[np.ndarray, float]:
        """Mean place (M, 4) of the markers, and the RMS length of what the single frames differ from it, mm."""
        if self.frames < _FEW or not np.any(self._sum):
            return np.zeros((0, 4)), 0.0
        count = np.maximum(np.asarray(self._count), 1)
        mean = np.asarray(self._sum) / count
        variance = np.maximum(np.asarray(self._square) / count - mean**2, 0.0)
        return mean, float(np.sqrt(3 * variance[:, :3].mean()))

"""What the rows of a run say together of target and camera file: the same misfit in frame after frame is no chance."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchpose.pose.excess import SURE

_FEW = 3  # frames, with fewer of which nothing is the same in all
_AXES = ("x", "y", "z", "edge", "size")
_BY_CHANCE = 0.5 * math.erfc(SURE / math.sqrt(2))  # of rows that are as their files say, those that stand out
_STATED = 2.0  # deviations, within which all is as the file says (convention)
_CAUSES = {
    "print": "the print or the target file: torchpose calibrate --measure-target, or center_sigma and edge_gain_sigma",
    "camera": "the camera file: torchpose calibrate, or intrinsics_covariance",
    "tone": "grey values that are not linear: --tone, or the camera's gamma, sharpening and glare",
    "scatter": "what moves or bends in the picture: a moving part, rolling shutter, lost lines, hot air, compression",
}


class Misfits:
    """Misfits of the ``ok`` rows of one target, and how many rows show it mirrored."""

    def __init__(self) -> None:
        self.frames = self.mirrored = self.refuted = 0
        self.kinds: Counter[str] = Counter()
        self._count: np.ndarray | int = 0
        self._sum: np.ndarray | float = 0.0
        self._square: np.ndarray | float = 0.0

    def add(self, row: dict[str, Any]) -> None:
        """Counts a row of `rows.POSE_SCHEMA`."""
        self.mirrored += row["reason"] == "mirrored"
        self.refuted += row["status"] == "rejected" and row["reason"] in ("residual", "ring_shape")
        if row["status"] != "ok":
            return
        self.frames += 1
        if row.get("misfit"):
            self.kinds[row["misfit"]] += 1
        if not row.get("place"):
            return
        place = np.array([marker or [np.nan] * len(_AXES) for marker in row["place"]], dtype=float)
        seen = np.isfinite(place)
        place = np.where(seen, place, 0.0)
        if np.ndim(self._sum) and np.shape(self._sum) != place.shape:  # rows of another target file of that name
            return
        self._count, self._sum, self._square = self._count + seen, self._sum + place, self._square + place**2

    def lines(self, name: str, ids: Sequence[int], stated: tuple[float, float] = (0.0, 0.0)) -> list[str]:
        """What there is to tell of a target; nothing where all is as its file says.

        Args:
            name: of the target.
            ids: of its markers, in order.
            stated: deviations that its file states, mm: of the places (RMS length) and of the edge gain.
        """
        lines = []
        number, chance = sum(self.kinds.values()), _BY_CHANCE * self.frames
        if number > 1 + chance + 3 * math.sqrt(chance):
            most, count = self.kinds.most_common(1)[0]
            kinds = ", ".join(f"{kind} {count}" for kind, count in self.kinds.most_common())
            likely = f"; likely {_CAUSES[most]}" if 2 * count > number else ""
            lines.append(
                f"{name}: {number} of {self.frames} ok rows show more than noise and the stated uncertainties "
                f"({kinds}), which is counted in s*{likely}"
            )
        if self.refuted > max(1, self.frames):
            lines.append(
                f"{name}: {self.refuted} rows are rejected because no pose explains their rings: look at the target "
                "file (places, ring sizes, ids) and at the camera file"
            )
        if self.frames >= _FEW and np.ndim(self._count):
            used = np.asarray(self._count)[: len(ids), 0]
            unused = [str(marker) for marker, count in zip(ids, used, strict=False) if not count]
            if unused:
                lines.append(f"{name}: marker {', '.join(unused)} is used in none of {self.frames} ok rows")
        return lines + self._same_in_all(name, ids, stated)

    def _same_in_all(self, name: str, ids: Sequence[int], stated: tuple[float, float]) -> list[str]:
        """Where markers and edges lie beside their places in all frames alike, further than the file states."""
        mean, scatter = self._common()
        if not mean.size:
            return []
        mean, lines = mean[: len(ids)], []
        # the mean of n independent places would be sqrt(n) smaller than they are
        least = 2 * scatter / math.sqrt(self.frames)
        parts = mean[:, :3], mean[:, 3:4], mean[:, 4:]
        aside, edge, size = (math.sqrt(np.square(part).sum(-1).mean()) for part in parts)
        if aside > max(least[0], _STATED * stated[0]):
            places = "; ".join(
                f"{marker} ({', '.join(f'{axis} {1e3 * v:+.1f}' for axis, v in zip(_AXES, at, strict=True))})"
                for marker, at in zip(ids, mean, strict=False)
            )
            lines.append(
                f"{name}: markers sit {1e3 * aside:.2g} um beside their places, the same in all {self.frames} frames: "
                "the target or the camera file is off; torchpose calibrate --measure-target measures both. By marker, "
                f"um: {places}"
            )
        if max(edge * (edge > _STATED * stated[1]), size) > max(*least[1:], 0.1 * aside):
            gain, larger = 1e3 * mean[:, 3:].mean(0)
            lines.append(
                f"{name}: dark edges lie {gain:+.2g} um further out than the file says, rings are {larger:+.2g} um "
                f"larger in radius, the same in all {self.frames} frames: ring sizes, dot gain or tone"
            )
        return lines

    def _common(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean place (M, 5) of the markers; how much single frames differ from it (3,): place, edge, size; RMS, mm."""
        if self.frames < _FEW or not np.any(self._sum):
            return np.zeros((0, len(_AXES))), np.zeros(3)
        count = np.maximum(np.asarray(self._count), 1)
        mean = np.asarray(self._sum) / count
        variance = np.maximum(np.asarray(self._square) / count - mean**2, 0.0).mean(0)
        return mean, np.sqrt([variance[:3].sum(), variance[3], variance[4]])

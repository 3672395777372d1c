"""Mistakes that only a whole run shows: every frame of the wrong size, a target that is in no frame."""

from collections import Counter
from typing import Any

from torchpose.results import Status

_WRONG_SIZE, _UNREADABLE, _NO_TARGET = (
    status.name.lower() for status in (Status.WRONG_SIZE, Status.UNREADABLE, Status.NO_TARGET)
)


class WholeRun:
    """Counts the rows of a run by target and status."""

    def __init__(self) -> None:
        self._statuses: dict[str, Counter[str]] = {}
        self._sizes: Counter[str] = Counter()

    def add(self, row: dict[str, Any]) -> None:
        """Counts a row of `rows.POSE_SCHEMA`."""
        self._statuses.setdefault(row["target"], Counter())[row["status"]] += 1
        if row["status"] == _WRONG_SIZE:
            self._sizes[row["reason"] or "another size"] += 1

    def lines(self, size: str) -> list[str]:
        """What there is to tell; ``size`` as the camera file has it. Nothing where some frame shows each target."""
        rows = sum(self._statuses.values(), Counter())
        if rows and set(rows) <= {_WRONG_SIZE, _UNREADABLE}:
            if not self._sizes:
                return []  # unreadable ones are told one by one
            found, count = self._sizes.most_common(1)[0]
            of = "all frames" if count == rows.total() else f"{count} of {rows.total()} rows"
            return [
                f"no frame has the size of the camera file, {size}: {of} are {found}; give the camera of these frames"
            ]
        lines = []
        for name, statuses in self._statuses.items():
            looked = statuses.total() - statuses[_WRONG_SIZE] - statuses[_UNREADABLE]
            if looked > 1 and statuses[_NO_TARGET] == looked:
                lines.append(
                    f"{name}: no marker of it in any of {looked} frames; check --target (ids, background), that the "
                    "rings are at least some 10 px wide, and focus and light (--overlay or torchpose detect show what "
                    "is seen)"
                )
        return lines

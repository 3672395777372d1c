"""What the rows of a run amount to, however they come in: the same for every engine."""

import math
from collections import Counter
from collections.abc import Sequence

from torchpose.io.misfits import Misfits
from torchpose.io.rows import Row
from torchpose.io.whole_run import WholeRun

_LEAST_CHANCE = 1e-300  # of a row whose cameras contradict each other (derived: the smallest of float64)


class Tally:
    """Counts rows frame by frame.

    Attributes:
        counts: number of rows by status.
        unreadable: frames that could not be read, with their reason.
        crowded: frames that show more copies of a target than they have rows.
        most: by target, the most copies of it that one of these frames shows.
        disagree: number of rows whose cameras contradict each other.
        surprise: of rows with a pose, - 2 ln of how likely by chance their cameras contradict each other as much: chi-
            squared of twice their number, ``compared`` (Fisher 1925).
        misfits: by target, what its rows say together of target and camera file.
        whole_run: what only all rows together show.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.unreadable: dict[str, str] = {}
        self.crowded: set[str] = set()
        self.most: dict[str, int] = {}
        self.disagree, self.surprise, self.compared = 0, 0.0, 0
        self.misfits: dict[str, Misfits] = {}
        self.whole_run = WholeRun()

    def add(self, frame: str, rows: Sequence[Row]) -> None:
        """Counts the rows of a frame, one at least."""
        self.counts.update(row["status"] for row in rows)
        if rows[0]["status"] == "unreadable":
            self.unreadable[frame] = rows[0]["reason"]
        of_target = Counter(row["target"] for row in rows)
        for row in rows:
            self.misfits.setdefault(row["target"], Misfits()).add(row)
            self.whole_run.add(row)
            self.disagree += row["reason"] == "cameras_disagree"
            if row["status"] == "ok" and (chance := row.get("consistency_p")) is not None:
                self.surprise -= 2 * math.log(max(chance, _LEAST_CHANCE))
                self.compared += 1
            if (row.get("copies") or 0) > of_target[row["target"]]:
                self.crowded.add(frame)
                self.most[row["target"]] = max(self.most.get(row["target"], 0), row["copies"])

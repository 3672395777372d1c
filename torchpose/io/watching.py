"""Rows of pictures as they arrive: what `arrivals` takes goes through reader and estimator, and out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch

from torchpose.camera import LINEAR
from torchpose.io.arrivals import Arrival, Arrivals
from torchpose.io.estimates import Estimation
from torchpose.io.reader import FrameReader, default_batch, in_batches
from torchpose.io.rows import Row
from torchpose.io.sources import Source, sources_of_file
from torchpose.results import Status

_WAIT = 0.2  # s between looks whether to stop (convention): a person takes it for at once


class Sink(Protocol):
    """Where rows go: `GrowingTable` or `StreamedRows`."""

    def __contains__(self, frame: str) -> bool: ...

    def append(self, records: Sequence[Row]) -> None: ...


Publish = Callable[[Sequence[Row]], None]
"""Is given rows that are out. It returns at once, whoever listens."""


@dataclass
class Watching:
    """Takes what arrives until it is told to stop.

    Attributes:
        work: what the rows depend on.
        arrivals: the folder.
        sink: where the rows go.
        publish: further places for them.
        threads: that decode.
        batch: frames at once; None: by their size.
        stopped: whether to come to an end; a handler of signals may set it.
    """

    work: Estimation
    arrivals: Arrivals
    sink: Sink
    publish: Sequence[Publish] = ()
    threads: int = 1
    batch: int | None = None
    stopped: bool = field(default=False, init=False)
    _held: list[Arrival] = field(default_factory=list, init=False)

    def first(self, *, idle: float | None = None) -> list[Source]:
        """Waits for the first files, which `run` will take; their frames. Empty where it ends before."""
        start = time.monotonic()
        while not (self.stopped or self._held or (idle is not None and time.monotonic() - start >= idle)):
            self._held = self.arrivals.ready(_WAIT)
        return [source for file in self._held for source in self._frames(file)]

    def run(self, *, idle: float | None = None) -> None:
        """Takes files until `stopped`, or until none has arrived for ``idle`` seconds."""
        camera = self.work.camera
        estimator, quiet_since = self.work.estimator(), time.monotonic()
        size = self.batch or default_batch(camera.width, camera.height)
        with torch.inference_mode():
            while not self.stopped and (idle is None or time.monotonic() - quiet_since < idle):
                files, self._held = self._held or self.arrivals.ready(_WAIT), []
                if files:
                    self._take(files, estimator, size)
                if files or self.arrivals.waiting:
                    quiet_since = time.monotonic()

    def _take(self, files: Sequence[Arrival], estimator: Any, size: int) -> None:
        """Rows of files, batch by batch; those that turn out not to be whole are put back."""
        camera = self.work.camera
        frames = [(source, file) for file in files for source in self._frames(file)]
        of_frame = {source.name: file for source, file in frames}
        sources = [source for source, _ in frames if source.name not in self.sink]
        waiting: dict[str, Arrival] = {}
        tone = camera.tone or LINEAR
        reader = FrameReader(in_batches(sources, size), camera.width, camera.height, threads=self.threads, tone=tone)
        for batch in reader:
            records = self.work.records(batch, estimator)
            for record in records:
                file = of_frame[record["frame"]]
                if not file.unchanged or (_unreadable(record) and not file.last):
                    waiting[file.name] = file
            whole = [record for record in records if of_frame[record["frame"]].name not in waiting]
            self.sink.append(whole)
            for publish in self.publish:
                publish([row for record in whole for row in record["rows"]])
            if self.stopped:
                break
        for file in waiting.values():
            self.arrivals.put_back(file)

    def _frames(self, file: Arrival) -> list[Source]:
        return list(sources_of_file(file.name, file.path, file.path.parent))


def _unreadable(record: Row) -> bool:
    unreadable = Status.UNREADABLE.name.lower()
    return any(row["status"] == unreadable for row in record["rows"])

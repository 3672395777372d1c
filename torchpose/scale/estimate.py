"""`torchpose estimate --engine ray`: blocks of frames decoded and measured by the workers of a Ray cluster.

A worker is an actor of Ray Data with an estimator and one core. Paths travel to it and rows come back; pictures stay
where they are decoded. Ray places the work, gives no worker more blocks than it has room for, and does again what a
lost worker had.
"""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpose.camera import LINEAR, Camera
from torchpose.io.estimates import Estimation
from torchpose.io.processes import one_thread
from torchpose.io.reader import Batch, FrameReader, in_batches
from torchpose.io.rows import Row
from torchpose.io.sources import Source
from torchpose.io.storage import REQUESTS
from torchpose.io.tally import Tally
from torchpose.scale.cluster import answered, answers
from torchpose.scale.parts import Parts, part_name

_CALLS = 2  # of a worker side by side: one decodes while the other measures


@dataclass(frozen=True)
class Block:
    """Consecutive frames that become the part of this name."""

    name: str
    sources: Sequence[Source]


class Measure:
    """A worker: decodes blocks, measures them with its estimator and writes their parts.

    Args:
        work: what the rows depend on.
        poses: where they go.
        detections: where those of the markers go, if anywhere.
    """

    def __init__(self, work: Estimation, poses: Parts, detections: Parts | None) -> None:
        one_thread()
        self._work, self._poses, self._detections = work, poses, detections
        self._estimator = work.estimator()
        self._measuring = threading.Lock()

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, Any]:
        rows = answered(lambda: self._done(pickle.loads(batch["block"][0])))
        return {"rows": np.array([rows], dtype=object)}

    @torch.inference_mode()
    def _done(self, block: Block) -> list[tuple[str, list[Row]]]:
        """Rows by frame of a block, once they are written."""
        stamps = {source.name: source.stamp() for source in block.sources}  # before they are read
        read = decoded(block, self._work.camera)
        with self._measuring:
            records = self._work.records(read, self._estimator)
        if self._detections is not None:
            self._detections.write(block.name, (row for r in records for row in r["detections"]), stamps)
        # the last: where it is there, the block is done
        self._poses.write(block.name, (row for r in records for row in r["rows"]), stamps)
        return [(record["frame"], record["rows"]) for record in records]


def decoded(block: Block, camera: Camera) -> Batch:
    """The frames of a block."""
    threads = 1 if all(isinstance(source.path, Path) for source in block.sources) else REQUESTS
    tone = camera.tone or LINEAR
    return next(iter(FrameReader([block.sources], camera.width, camera.height, threads=threads, tone=tone)))


def pending(sources: Sequence[Source], size: int, poses: Parts, tally: Tally) -> list[Block]:
    """Blocks of up to so many frames that have no rows yet; those that have are counted.

    Parts of pictures that have changed, or that could not be read, are removed. What is left keeps the borders between
    blocks that a first run has.
    """
    stamps, done = {source.name: source.stamp() for source in sources}, set[str]()
    for part in poses.written():
        if not part.is_fresh(stamps):
            poses.remove(part.name)
            continue
        for frame, rows in groupby(part.rows, key=itemgetter("frame")):
            tally.add(frame, list(rows))
        done.update(part.files)
    blocks = []
    for number, batch in enumerate(in_batches(sources, size)):
        left = [_absolute(source) for source in batch if source.name not in done]
        if left:
            blocks.append(Block(part_name(number * size, left), left))
    return blocks


def _absolute(source: Source) -> Source:
    """The same for a worker that was started elsewhere."""
    return replace(source, path=source.path.absolute()) if isinstance(source.path, Path) else source


def measured(
    work: Estimation, blocks: Sequence[Block], poses: Parts, detections: Parts | None, *, workers: int
) -> Iterator[list[tuple[str, list[Row]]]]:
    """Rows by frame of each block as it is done, in no order.

    Raises:
        ConfigError: workers lack the package, or a place cannot be written.
    """
    if not blocks:
        return
    import ray.data

    items = [{"block": pickle.dumps(block)} for block in blocks]
    data: ray.data.Dataset = ray.data.from_items(items, override_num_blocks=len(items))
    data = data.map_batches(
        Measure,
        fn_constructor_args=(work, poses, detections),
        batch_size=1,
        num_cpus=1,
        compute=ray.data.ActorPoolStrategy(
            # all from the beginning; one must do, as nodes may be lost
            min_size=1,
            max_size=min(workers, len(blocks)),
            initial_size=min(workers, len(blocks)),
            max_concurrent_calls_per_actor=_CALLS,
            enable_true_multi_threading=True,
        ),
    )
    for _, rows in answers(data, "rows"):
        yield rows

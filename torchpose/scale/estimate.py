"""`torchpose estimate --engine ray`: blocks of frames decoded and measured by the workers of a Ray cluster.

Two stages of Ray Data: tasks decode blocks, actors that hold an estimator each measure them and write a part of the
table. Ray places the work, holds decoding back where it runs ahead, and does again what a lost worker had.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import torch

from torchpose.camera import LINEAR
from torchpose.io.estimates import Estimation
from torchpose.io.reader import Batch, FrameReader, in_batches
from torchpose.io.rows import Row
from torchpose.io.sources import Source
from torchpose.io.tally import Tally
from torchpose.scale.cluster import DECODING, MEASURING, blocks_done
from torchpose.scale.parts import Parts, part_name

_KINDS = {"frames_8": np.uint8, "frames_16": np.uint16}  # columns of a decoded block, one a pixel type


@dataclass(frozen=True)
class Block:
    """Consecutive frames that become the part of this name."""

    name: str
    sources: Sequence[Source]


@dataclass(frozen=True)
class Decode:
    """The stage that reads: a block in, its frames out."""

    camera: Any

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, Any]:
        block: Block = pickle.loads(batch["block"][0])
        size = self.camera.width, self.camera.height
        read = next(iter(FrameReader([block.sources], *size, threads=1, tone=self.camera.tone or LINEAR)))
        columns: dict[str, Any] = {name: np.zeros((1, 0, *size[::-1]), kind) for name, kind in _KINDS.items()}
        places: dict[str, list[int]] = {name: [] for name in _KINDS}
        for positions, frames in read.groups:
            name = "frames_8" if frames.dtype == torch.uint8 else "frames_16"
            columns[name], places[name] = frames.numpy()[None], positions
        about = pickle.dumps((block, read.faults, places))
        return {"about": np.array([about], dtype=object), **columns}


class Measure:
    """The stage that measures and writes: one estimator a worker.

    Args:
        work: what the rows depend on.
        poses: where they go.
        detections: where those of the markers go, if anywhere.
    """

    def __init__(self, work: Estimation, poses: Parts, detections: Parts | None) -> None:
        torch.set_num_threads(1)
        self._work, self._poses, self._detections = work, poses, detections
        self._estimator = work.estimator()

    @torch.inference_mode()
    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, Any]:
        block, faults, places = pickle.loads(batch["about"][0])
        groups = [
            (positions, torch.from_numpy(np.array(batch[name][0]))) for name, positions in places.items() if positions
        ]
        records = self._work.records(Batch(block.sources, faults, groups), self._estimator)
        stamps = {source.name: source.stamp() for source in block.sources}
        if self._detections is not None:
            self._detections.write(block.name, (row for r in records for row in r["detections"]), stamps)
        # the last: where it is there, the block is done
        self._poses.write(block.name, (row for r in records for row in r["rows"]), stamps)
        rows = pickle.dumps([(record["frame"], record["rows"]) for record in records])
        return {"rows": np.array([rows], dtype=object)}


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
        left = [source for source in batch if source.name not in done]
        if left:
            blocks.append(Block(part_name(number * size, left), left))
    return blocks


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
    data = data.map_batches(Decode(work.camera), batch_size=1, num_cpus=DECODING)
    data = data.map_batches(
        Measure,
        fn_constructor_args=(work, poses, detections),
        batch_size=1,
        num_cpus=MEASURING,
        compute=ray.data.ActorPoolStrategy(min_size=1, max_size=workers),
    )
    for row in blocks_done(data):
        yield pickle.loads(row["rows"])

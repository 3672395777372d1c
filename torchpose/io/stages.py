"""The pipeline as a stage of other people's: a callable on batches of columns, and a data set of frames for torch.

Neither needs more than torch and NumPy. `PoseStage` is what `ray.data.Dataset.map_batches` and Hugging Face's
`Dataset.map` call; `FrameDataset` is what `torch.utils.data.DataLoader` reads, with any number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from torchpose.camera import LINEAR, Camera
from torchpose.errors import ArgumentError
from torchpose.io.estimates import Estimation
from torchpose.io.reader import Batch, FrameReader, default_batch, in_batches, linear_image
from torchpose.io.rows import Row
from torchpose.io.sources import Source, find_sources
from torchpose.io.storage import Place, place_of
from torchpose.target import Target

Where = str | PathLike[str]


class PoseStage:
    """Columns of frames in, columns of poses out.

    Args:
        camera: of the frames, or its file.
        target: one or several, as `Target`, name or path.
        method: last stage, see `PoseEstimator`.
        threads: of decoding, and of torch for the whole process; None decodes in one and leaves torch as it is.

    A batch is a dictionary of arrays of one length B. It holds one of

    - ``path``: paths or URLs of pictures, of one page,
    - ``image``: frames (B, H, W) or (B,) of (H, W), uint8 or uint16.

    What comes back has B * T rows, T targets a frame: the columns of the batch but the images, repeated, and those of
    the pose table (`torchpose.io.rows.POSE_SCHEMA`) without its lists, but for ``frame``, which is the position in the
    batch where there is no path. Empty cells are NaN, or None where they are text.
    """

    def __init__(
        self,
        camera: Camera | Where,
        target: Target | Where | Sequence[Target | Where],
        *,
        method: str = "photometric",
        threads: int | None = None,
    ) -> None:
        lens = camera if isinstance(camera, Camera) else Camera.load(camera)
        several = [target] if isinstance(target, Target | str | PathLike) else list(target)
        targets = [one if isinstance(one, Target) else Target.load(one) for one in several]
        self._work, self._threads = Estimation(lens, targets, method=method), threads
        self._estimator = self._work.estimator()

    @torch.inference_mode()
    def __call__(self, batch: dict[str, Any]) -> dict[str, np.ndarray]:
        """
        Raises:
            ArgumentError: the batch has neither ``path`` nor ``image``.
        """
        if self._threads is not None:
            torch.set_num_threads(self._threads)
        read = self._read(batch)
        records = self._work.records(read, self._estimator)
        kept = {name: np.asarray(values) for name, values in batch.items() if name not in ("image", "path")}
        rows = [row for record in records for row in record["rows"]]
        of = [number for number, record in enumerate(records) for _ in record["rows"]]
        return {name: values[of] for name, values in kept.items()} | _columns(rows, self._work)

    def _read(self, batch: dict[str, Any]) -> Batch:
        lens = self._work.camera
        if "path" in batch:
            places = [place_of(str(path)) for path in batch["path"]]
            sources = [Source(str(place), place, place.parent) for place in places]
            # rows are told apart by name: the same picture twice is two frames
            sources = [Source(f"{i}\0{s.name}", s.path, s.root) for i, s in enumerate(sources)]
            read = FrameReader([sources], lens.width, lens.height, threads=self._threads or 1, tone=lens.tone or LINEAR)
            return next(iter(read))
        if "image" not in batch:
            raise ArgumentError(f"batch: has the columns {', '.join(batch)}; give path or image")
        frames = torch.from_numpy(
            np.stack([linear_image(np.asarray(one), lens.tone or LINEAR) for one in batch["image"]])
        )
        sources = [Source(f"{i}\0{i}", Path(), Path()) for i in range(len(frames))]
        return Batch(sources, {}, [(list(range(len(frames))), frames)])


def _columns(rows: Sequence[Row], work: Estimation) -> dict[str, np.ndarray]:
    """The cells of rows as arrays, without lists."""
    columns: dict[str, np.ndarray] = {}
    for name, kind in work.schema.items():
        cells = [row[name] for row in rows]
        if name == "frame":
            columns[name] = np.array([cell.partition("\0")[2] for cell in cells], dtype=object)
        elif kind is float:
            columns[name] = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
        elif kind is int:
            columns[name] = np.array([-1 if cell is None else cell for cell in cells], dtype=np.int64)
        elif kind is str:
            columns[name] = np.array(cells, dtype=object)
    return columns


class FrameDataset(IterableDataset[tuple[list[str], Tensor]]):
    """Batches of frames from files, folders, manifests or stores, for `torch.utils.data.DataLoader`.

    Use it with ``batch_size=None``: a batch is a list of names and frames (B, H, W), linear, as `PoseEstimator` takes
    them. Workers share the batches; the order between them is the loader's. Pictures that cannot be read are left out
    and kept in `faults` of the worker's own copy.

    Args:
        inputs: as for ``torchpose estimate``: paths or URLs.
        camera: of the frames, or its file; it says their size and tone.
        batch: frames at a time, by default chosen by their size.
        threads: of decoding, in each worker.
    """

    def __init__(
        self, inputs: Where | Sequence[Where], camera: Camera | Where, *, batch: int | None = None, threads: int = 1
    ) -> None:
        super().__init__()
        given = [inputs] if isinstance(inputs, str | PathLike) else list(inputs)
        places: list[Path | Place] = [place_of(str(one)) for one in given]
        self.camera = camera if isinstance(camera, Camera) else Camera.load(camera)
        self.sources = find_sources(places)
        self.batch = batch or default_batch(self.camera.width, self.camera.height)
        self.threads = threads
        self.faults: dict[str, str] = {}

    def __iter__(self) -> Iterator[tuple[list[str], Tensor]]:
        batches, worker = in_batches(self.sources, self.batch), get_worker_info()
        if worker is not None:
            batches = batches[worker.id :: worker.num_workers]
        lens = self.camera
        reader = FrameReader(batches, lens.width, lens.height, threads=self.threads, tone=lens.tone or LINEAR)
        for read in reader:
            self.faults.update((read.sources[i].name, fault.reason) for i, fault in read.faults.items())
            for positions, frames in read.groups:
                yield [read.sources[i].name for i in positions], frames.clone()  # the buffer is used again

    def __len__(self) -> int:
        """Batches, where no picture is unreadable and all have one pixel type."""
        return len(in_batches(self.sources, self.batch))

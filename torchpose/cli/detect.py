"""``torchpose detect``: ellipses, segments and polygons of any picture, without camera or target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.cli.common import (
    Overlay,
    Silent,
    Threads,
    Tone,
    check_outputs,
    cores,
    ended,
    frames_of,
    interrupted,
    read_tone,
    use_threads,
)

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    import numpy as np

    from torchpose import camera as cameras
    from torchpose.io.rows import Row
    from torchpose.io.sources import Source

_BATCH_PIXELS = 40_000_000


_INPUTS = "Image files, folders of them or capture manifests, of any size."
_EXPLAIN = "Also list the ellipses that were rejected, with the reason."


def detect(
    inputs: Annotated[list[Path], typer.Argument(metavar="INPUT...", help=_INPUTS)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Table of the shapes: .csv, .jsonl or .parquet.")],
    overlay: Overlay = None,
    explain: Annotated[bool, typer.Option("--explain", help=_EXPLAIN)] = False,
    tone: Tone = None,
    threads: Threads = None,
    quiet: Silent = False,
) -> int:
    """Find ellipses, straight edges and polygons, with their numbers of false alarms. No parameter to tune.

    One row a shape, in pixels of the frame (pixel centre at integer coordinates).
    """
    import cv2
    import torch

    from torchpose.cli.terminal import FrameProgress, native_stderr_silenced
    from torchpose.io.shape_rows import SHAPE_SCHEMA
    from torchpose.io.writers import check_table_path, write_rows
    from torchpose.report.files import make_folder

    check_table_path(out, "--out")
    sources = frames_of(inputs)
    check_outputs(inputs, sources, [out], overlay)
    if overlay is not None:
        make_folder(overlay, "--overlay")
    cv2.setNumThreads(1)
    use_threads(threads)
    unreadable: dict[str, str] = {}
    rows: list[Row] = []
    show = FrameProgress(len(sources), 0, quiet=quiet)
    try:
        with native_stderr_silenced(), show as progress, torch.inference_mode():
            for some, frames in _batches(_decoded(sources, threads or cores(), read_tone(tone)), unreadable):
                found = _rows(some, frames, explain)
                if overlay is not None:
                    _draw(overlay, some, frames, found)
                rows += found
                progress.advance(len(some), _kinds(rows))
    except KeyboardInterrupt:
        return interrupted("nothing was written; run again")
    order = {source.name: number for number, source in enumerate(sources)}
    rows.sort(key=lambda row: order[row["frame"]])
    write_rows(out, rows, SHAPE_SCHEMA)
    progress.summary(_kinds(rows), out)
    return ended(unreadable)


def _batches(
    decoded: Iterator[tuple[Source, np.ndarray | str]], unreadable: dict[str, str]
) -> Iterator[tuple[list[Source], np.ndarray]]:
    """Frames (B, H, W) of consecutive sources of one size and type; those that cannot be read go to ``unreadable``."""
    import numpy as np

    waiting: list[Source] = []
    images: list[np.ndarray] = []
    for source, image in decoded:
        if isinstance(image, str):
            unreadable |= {source.name: image} if image else {}
            continue
        fits = not images or (image.shape == images[0].shape and image.dtype == images[0].dtype)
        if images and not (fits and (len(images) + 1) * image.size <= _BATCH_PIXELS):
            yield waiting, np.stack(images)
            waiting, images = [], []
        waiting.append(source)
        images.append(image)
    if images:
        yield waiting, np.stack(images)


def _decoded(
    sources: Sequence[Source], threads: int, tone: cameras.Tone | None
) -> Iterator[tuple[Source, np.ndarray | str]]:
    """Every source in order with its frame (H, W), or the reason why there is none; threads decode ahead.

    The reason is empty where a film has ended before.
    """
    from concurrent.futures import ThreadPoolExecutor

    from torchpose.camera import LINEAR
    from torchpose.io.reader import Fault, decoded, linear_image

    def load(source: Source) -> np.ndarray | str:
        image = decoded(source, threads=threads)
        if image is None or isinstance(image, Fault):
            return "" if image is None else image.reason
        return linear_image(image, tone or LINEAR)

    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        ahead = [pool.submit(load, source) for source in sources[: 2 * threads]]
        for number, source in enumerate(sources):
            yield source, ahead.pop(0).result()
            if number + 2 * threads < len(sources):
                ahead.append(pool.submit(load, sources[number + 2 * threads]))


def _rows(sources: Sequence[Source], images: np.ndarray, explain: bool) -> list[Row]:
    import torch

    from torchpose.detect import Verdict, find_shapes
    from torchpose.io.shape_rows import shape_rows
    from torchpose.rings.inner_circles import find_inner

    frames = torch.from_numpy(images)
    shapes = find_shapes(frames, explain=explain)
    ratios = torch.full_like(shapes.ellipses.log10_nfa, torch.nan)
    valid = (shapes.ellipses.verdict == Verdict.ACCEPTED).nonzero()[:, 0]
    inner = find_inner(frames, shapes.ellipses[valid])
    ratios[valid[inner.found]] = inner.ratio[inner.found]
    return shape_rows(shapes, ratios, [source.name for source in sources])


def _draw(folder: Path, sources: Sequence[Source], images: np.ndarray, rows: list[Row]) -> None:
    from torchpose.report.detection_overlay import draw_shapes
    from torchpose.report.overlay import picture_path, write_picture

    for source, image in zip(sources, images, strict=True):
        mine = [row for row in rows if row["frame"] == source.name]
        write_picture(picture_path(folder, source.name), draw_shapes(image, mine))


def _kinds(rows: list[Row]) -> Counter[str]:
    return Counter(row["kind"] for row in rows if row["verdict"] == "accepted")

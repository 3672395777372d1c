"""JPEG and TIFF files with one flipped bit: which are refused, and what those do to a pose that are not.

    python scripts/damage_statistics.py --flips 60

Frame 005 of the sample, 2 MP, coded in several ways; one bit anywhere in the coded pixels is flipped. The pose of the
undamaged file is the reference. A row for torchpose's reader and one for OpenCV alone, which libjpeg's warnings do not
keep from handing on a picture. Columns:

    refused    files that are unreadable
    same       of the others, those whose grey values are as they were
    < 1, < 3   poses of status ok, by their distance from the reference in its standard deviations (covariance of t)
    > 3        the same: wrong poses that say ok
    other      other statuses
    worst      largest distance of any that is ok
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

import torchpose as tp
from torchpose.io.images import UnreadableImageError, decode
from torchpose.io.images.native import by_opencv

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "sample"
BATCH = 8


def coded(frame: np.ndarray) -> Iterator[tuple[str, bytes]]:
    """Files of the frame, by their kind."""
    colour = np.dstack([frame, (0.9 * frame).astype(np.uint8), (0.8 * frame).astype(np.uint8)])
    yield "baseline", cv2.imencode(".jpg", frame)[1].tobytes()
    yield "own tables", by_pillow(frame, optimize=True)
    yield "own tables, restart markers", by_pillow(frame, optimize=True, restart_marker_blocks=64)
    yield "progressive", by_pillow(frame, progressive=True)
    yield "progressive, restart markers", by_pillow(frame, progressive=True, restart_marker_rows=1)
    yield "restart markers", cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_RST_INTERVAL, 16])[1].tobytes()
    yield "colour 4:2:0", cv2.imencode(".jpg", colour)[1].tobytes()
    yield "colour 4:4:4", by_pillow(colour, subsampling=0)
    yield "TIFF, LZW", cv2.imencode(".tif", frame)[1].tobytes()
    yield "TIFF, deflate", cv2.imencode(".tif", frame, [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1].tobytes()


def by_pillow(image: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=90, **options)
    return buffer.getvalue()


def flipped(data: bytes, count: int, seed: int) -> Iterator[bytes]:
    """The file with one bit flipped: behind the header of the first scan of a JPEG, in the first 90 % of a TIFF."""
    jpeg = data.startswith(b"\xff\xd8")
    start, end = (data.find(b"\xff\xda") + 14, len(data) - 2) if jpeg else (8, len(data) * 9 // 10)
    for position, bit in np.random.default_rng(seed).integers((start, 0), (end, 8), (count, 2)).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 1 << bit
        yield bytes(damaged)


def ours(data: bytes) -> np.ndarray | None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        try:
            return decode(Path(file.name))
        except UnreadableImageError:
            return None


def opencv(data: bytes) -> np.ndarray | None:
    try:
        return by_opencv(data)
    except UnreadableImageError:
        return None


def distances(estimator: tp.PoseEstimator, clean: np.ndarray, images: Sequence[np.ndarray]) -> Tensor:
    """Distance of each pose from that of the clean frame, in its standard deviations; nan where it is not ok."""
    frames = torch.from_numpy(np.stack([clean, *images]))
    found = [estimator(frames[i : i + BATCH]) for i in range(0, len(frames), BATCH)]
    t, status = torch.cat([poses.t for poses in found]), torch.cat([poses.status for poses in found])
    off = t[1:] - t[0]
    squared = (off * torch.linalg.solve(found[0].covariance[0, :3, :3], off.mT).mT).sum(1)
    return squared.sqrt().where(status[1:] == tp.Status.OK, torch.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=60, help="damaged files of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", nargs="+", help="of files; all by default")
    args = parser.parse_args()
    frame = np.asarray(cv2.imread(str(SAMPLE / "frames" / "005.png"), cv2.IMREAD_GRAYSCALE))
    estimator = tp.PoseEstimator(tp.Camera.load(SAMPLE / "camera.yaml"), tp.Target.load("quad40"))
    print("| file | reader | refused | same | < 1 | < 3 | > 3 | other | worst |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for kind, data in coded(frame):
        if args.kind and kind not in args.kind:
            continue
        clean = by_opencv(data)
        for name, read in (("torchpose", ours), ("OpenCV", opencv)):
            images = [read(damaged) for damaged in flipped(data, args.flips, args.seed)]
            whole = [image for image in images if image is not None]
            changed = [image for image in whole if not np.array_equal(image, clean)]
            with torch.inference_mode():
                off = distances(estimator, clean, changed)
            ok = off[~off.isnan()]
            counts = [int((ok < 1).sum()), int(((ok >= 1) & (ok < 3)).sum()), int((ok >= 3).sum()), len(off) - len(ok)]
            worst = f"{float(ok.max()):.2g}" if len(ok) else "-"
            cells = [kind, name, args.flips - len(whole), len(whole) - len(changed), *counts, worst]
            print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()

"""Files dropped into a watched folder by several writers, the watcher killed again and again: every row once.

    python scripts/soak_watch.py --files 10000 --kills 10 --out out/soak_watch

Writers write at once, in pieces with pauses, in pieces with the file closed between them, or under another name that is
then renamed. The watcher is killed (SIGKILL) at random moments and started again; at the end it is told to stop
(SIGTERM). Prints what was found, and fails where a row is missing, twice or not that of its picture.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from torchpose.camera import Camera
from torchpose.sim import render
from torchpose.target import Target

WIDTH, HEIGHT = 160, 120
WRITERS = 4
TARGETS, BLANKS = 2, 6  # of eight files that follow each other, so that 10,000 take minutes


def pictures(count: int) -> list[bytes]:
    """PNG files: quad40 at distances that tell them apart, then as many grey ones as there are `BLANKS`."""
    camera = Camera.ideal(WIDTH, HEIGHT, 260.0)
    rotation = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    translation = torch.zeros(count, 3, dtype=torch.float64)
    translation[:, 2] = distances(count)
    frames = render(camera, Target.load("quad40"), rotation, translation, plate=(70.0, 70.0)).round().byte().numpy()
    grey = [np.full((HEIGHT, WIDTH), 100, np.uint8)] * BLANKS
    return [cv2.imencode(".png", frame)[1].tobytes() for frame in [*frames, *grey]]


def distances(count: int) -> torch.Tensor:
    return 180.0 + 2.0 * torch.arange(count, dtype=torch.float64)


def drop(path: Path, data: bytes, way: int, pause: float) -> None:
    """Writes a file in one of four ways."""
    if way == 0:
        path.write_bytes(data)
    elif way == 1:  # in pieces
        with path.open("wb") as file:
            for start in range(0, len(data), len(data) // 3 + 1):
                file.write(data[start : start + len(data) // 3 + 1])
                file.flush()
                time.sleep(pause)
    elif way == 2:  # closed between the pieces
        path.write_bytes(data[: len(data) // 2])
        time.sleep(pause)
        with path.open("ab") as file:
            file.write(data[len(data) // 2 :])
    else:  # renamed into place
        hidden = path.with_name(f".{path.name}.part")
        hidden.write_bytes(data)
        hidden.rename(path)


def write_all(folder: Path, numbers: list[int], files: list[bytes], pause: float, seed: int) -> None:
    chance = random.Random(seed)
    for number in numbers:
        place = folder / f"writer{seed}" if number % 3 == 0 else folder
        place.mkdir(exist_ok=True)
        drop(place / f"{number:06d}.png", files[number % len(files)], chance.randrange(4), pause * chance.random())


def watcher(folder: Path, out: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "torchpose", "watch", "in", "-c", "camera.yaml", "-t", "quad40", "-o", out.name]
    return subprocess.Popen([*command, "-j", "1", "-q", *options], cwd=folder)


def run(folder: Path, files: int, kills: int, *, table: str = "poses.jsonl", pause: float = 0.02) -> Counter[str]:
    """Drops files, kills and restarts the watcher; rows by what is right or wrong with them."""
    (folder / "in").mkdir(parents=True)
    Camera.ideal(WIDTH, HEIGHT, 260.0).save(folder / "camera.yaml")
    data, out = pictures(TARGETS), folder / table
    writers = [
        threading.Thread(target=write_all, args=(folder / "in", list(range(one, files - 1, WRITERS)), data, pause, one))
        for one in range(WRITERS)
    ]
    chance = random.Random(0)
    child = watcher(folder, out)
    for thread in writers:
        thread.start()
    for kill in range(kills):
        # some time after it has begun to write, or before, while it starts
        wanted = chance.random() * files * (kill + 1) / kills
        end = time.monotonic() + 60.0
        while rows_in(out) < wanted and time.monotonic() < end:
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
        child.wait()
        child = watcher(folder, out)
    for thread in writers:
        thread.join()
    drop(
        folder / "in" / f"{files - 1:06d}.png", data[(files - 1) % len(data)], 0, 0.0
    )  # its row: the last one has started
    end = time.monotonic() + 60.0 + files
    while rows_in(out) < files and time.monotonic() < end and child.poll() is None:
        time.sleep(0.1)
    time.sleep(1.0)  # for rows that would be too many
    child.send_signal(signal.SIGTERM)
    code = child.wait()
    found = judged(out, files)
    found[f"exit code {code}"] += 1
    return found


def rows_in(out: Path) -> int:
    return out.read_bytes().count(b"\n") if out.exists() else 0


def judged(out: Path, files: int) -> Counter[str]:
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    names = Counter(Path(row["frame"]).stem for row in rows)
    found: Counter[str] = Counter()
    found["rows"] = len(rows)
    found["missing"] = sum(f"{number:06d}" not in names for number in range(files))
    found["twice"] = sum(count > 1 for count in names.values())
    found["wrong"] = sum(not is_right(row) for row in rows)
    return found


def is_right(row: dict[str, Any]) -> bool:
    """Whether a row is that of the picture that was written under its name."""
    kind = int(Path(row["frame"]).stem) % (TARGETS + BLANKS)
    if kind >= TARGETS:
        return bool(row["status"] == "no_target")
    return bool(row["status"] == "ok" and abs(row["tz"] - float(distances(TARGETS)[kind])) < 0.9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=10000)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--out", type=Path, required=True, help="folder, which must not exist")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    np.seterr(all="raise")
    start = time.monotonic()
    found = run(given.out, given.files, given.kills)
    print(f"{dict(found)} in {time.monotonic() - start:.0f} s")
    good = found["rows"] == given.files and not (found["missing"] or found["twice"] or found["wrong"])
    sys.exit(0 if good and found["exit code 0"] else 1)


if __name__ == "__main__":
    main()

"""What the live page costs: from a frame to the page, frames a second with viewers, and memory over many frames.

    python scripts/bench_live.py [--seconds 20] [--soak 100000] [--looks 15]

Frames of the simulated target are played as fast as the estimator takes them, at 2 and 20 MP, and looked at by 0, 1 and
10 viewers over loopback. A viewer does what the page does: it reads the events, and asks for the newest picture when it
has the one before. They run in a process of their own. Latency is from the moment at which a frame is there to the one
at which a viewer has its numbers, and its picture.

The soak plays small frames as fast as they can be looked at, with one viewer, and tells the memory as it goes;
`--remembered` looks at each of the three pictures once and plays what was seen, so that all but the estimator works.

`--looks` tells what tracking saves: CPU of looking at a frame near the last pose, and all over it, in turn, of frames
with the target alone and with 200 other things.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from torchpose.camera import Camera
from torchpose.live.app import Answers
from torchpose.live.engine import Live, Observer, Sight
from torchpose.live.recording import Recorder
from torchpose.live.server import Server, listen
from torchpose.live.sources import Shot
from torchpose.sim import add_noise, render
from torchpose.target import Target

ROOT = Path(__file__).parents[1]
VIEWERS = str(Path(__file__).with_name("live_viewers.py"))
CAMERAS = {"2 MP": "acA5472_8mm_third.yaml", "20 MP": "acA5472_8mm.yaml"}
THINGS = 200  # beside the target, where there are others
FRAMES = 3  # different ones, so that nothing can be kept from one to the next
PAGE_KB = 1024


@dataclass
class Played:
    """Frames that are there already, as fast as somebody takes them."""

    images: list[np.ndarray]
    kind: str = "folder"
    number: int = 0
    times: list[float] = field(default_factory=list)

    def __enter__(self) -> Played:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def newest(self, wait: Callable[[float], object]) -> Shot:
        wait(0.0)
        self.number += 1
        return Shot(f"{self.number:06d}", time.time(), self.images[self.number % len(self.images)])


def frames_of(camera: Camera, target: Target, distance: float) -> list[np.ndarray]:
    R, t = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, distance]], dtype=torch.float64)
    ideal = render(camera, target, R, t, plate=(70.0, 70.0), surround=110.0)
    return [np.asarray(add_noise(ideal, 1.0, seed)[0]) for seed in range(FRAMES)]


def cluttered(image: np.ndarray) -> np.ndarray:
    """The frame with rings, discs and squares beside the plate, which is left as it is."""
    generator, height, width = np.random.default_rng(1), *image.shape
    found, size, third = image.copy(), height // 40, height // 3
    plate = np.s_[height // 2 - third : height // 2 + third, width // 2 - third : width // 2 + third]
    for number in range(THINGS):
        at = tuple(int(v) for v in generator.integers(size, (width - size, height - size)))
        if number % 2:
            line = -1 if number % 4 == 1 else size // 4
            cv2.circle(found, at, int(generator.integers(size // 2, size)), 40, line, cv2.LINE_AA)
        else:
            cv2.rectangle(found, at, (at[0] + size, at[1] + size // 2), 180, -1)
    found[plate] = image[plate]
    return found


def looks(count: int) -> None:
    """Prints CPU of a frame near the last pose and all over, in one run."""
    target = Target.load("quad40")
    print("| frames | all over, CPU ms | near, CPU ms | near / all over |\n| --- | ---: | ---: | ---: |")
    for size, name in CAMERAS.items():
        camera = Camera.load(ROOT / "configs/cameras" / name)
        alone = frames_of(camera, target, 150.0)
        for what, images in (("target alone", alone), (f"{THINGS} other things", [cluttered(one) for one in alone])):
            near, everywhere = Observer(camera, target), Everywhere(camera, target)
            times: dict[str, list[float]] = {"near": [], "everywhere": []}
            with torch.inference_mode():
                for number in range(count + 2):
                    shot = Shot(f"{number}", time.time(), images[number % FRAMES])
                    for key, observer in (("near", near), ("everywhere", everywhere)):
                        began = time.process_time()
                        sight = observer.look(shot)
                        times[key].append(time.process_time() - began)
                        assert sight.row["status"] == "ok", sight.row
            all_over, tracked = (1e3 * statistics.median(times[key][2:]) for key in ("everywhere", "near"))
            ratio = statistics.median(a / b for a, b in zip(times["near"][2:], times["everywhere"][2:], strict=True))
            print(f"| {size}, {what} | {all_over:.0f} | {tracked:.0f} | {ratio:.2f} |", flush=True)


class Everywhere(Observer):
    """Looks for the target all over every frame."""

    def look(self, shot: Shot) -> Sight:
        self._tracker.forget()
        return super().look(shot)


class Remembering(Observer):
    """Sees in a picture what it saw in it the first time."""

    def look(self, shot: Shot) -> Sight:
        self._seen: dict[int, Sight] = getattr(self, "_seen", {})
        if id(shot.image) not in self._seen:
            self._seen[id(shot.image)] = super().look(shot)
        sight = self._seen[id(shot.image)]
        return replace(sight, shot=shot, row=sight.row | {"frame": shot.name})


@contextmanager
def served(observer: Observer, target: Target, frames: Played, folder: Path) -> Iterator[tuple[Live, int]]:
    camera = observer.camera
    images = {"camera": [camera.width, camera.height, "as taken"]}
    about = {"source": "folder", "target": target.name, "emulated": True, "images": images}
    shown = {"version": "", "source": "", "target": target.name, "width": camera.width, "height": camera.height}
    tell = Lines()
    with (
        Recorder(folder, **about) as recorder,
        Live(frames, observer, recorder, tell) as live,
        listen("127.0.0.1", 0) as listening,
    ):
        server = Server(Answers(live, shown | {"markers": []}, None, tell), "127.0.0.1", None, tell)
        thread = threading.Thread(target=server.run, args=(listening,))
        thread.start()
        try:
            yield live, listening.getsockname()[1]
        finally:
            server.end()
            thread.join()


class Lines:
    """Prints what a server tells."""

    def __call__(self, line: str) -> None:
        print(line, file=sys.stderr)


def watched(live: Live, port: int, count: int, seconds: float) -> dict[str, float]:
    """Figures of a run with so many viewers."""
    first, began, cpu = live.snapshot.number, time.monotonic(), time.process_time()
    found: list[dict[str, Any]] = []
    if count:
        command = [sys.executable, VIEWERS, str(port), str(count), str(seconds)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found = json.loads(done.stdout)
    else:
        time.sleep(seconds)
    frames, took = live.snapshot.number - first, time.monotonic() - began
    rate = statistics.mean(viewer["rate"] for viewer in found) if found else frames / took
    figures = {"frames_s": rate, "cpu_ms": 1e3 * (time.process_time() - cpu) / frames}
    for what in ("numbers", "pictures"):
        values = [value for viewer in found for value in viewer[what]]
        if values:
            figures[f"{what}_ms"] = 1e3 * statistics.median(values)
            figures[f"{what}_p95_ms"] = 1e3 * float(np.percentile(values, 95))
            figures[f"{what}_s"] = len(values) / len(found) / seconds
    return figures


def latencies(seconds: float) -> None:
    """Prints the table of sizes and viewers."""
    target = Target.load("quad40")
    print(
        "| frames | viewers | frames/s | CPU ms a frame | numbers ms (p95) | picture ms (p95) | pictures/s a viewer |\n"
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    )
    for size, name in CAMERAS.items():
        camera = Camera.load(ROOT / "configs/cameras" / name)
        with tempfile.TemporaryDirectory() as folder:
            frames = Played(frames_of(camera, target, 150.0))
            with served(Observer(camera, target), target, frames, Path(folder)) as (live, port):
                while live.snapshot.number < 3:
                    time.sleep(0.1)
                for count in (0, 1, 10):
                    found = watched(live, port, count, seconds)

                    def pair(what: str, found: dict[str, float] = found) -> str:
                        key = f"{what}_ms"
                        return f"{found[key]:.0f} ({found[f'{what}_p95_ms']:.0f})" if key in found else "-"

                    rate = f"{found['pictures_s']:.1f}" if "pictures_s" in found else "-"
                    print(
                        f"| {size} | {count} | {found['frames_s']:.2f} | {found['cpu_ms']:.0f} | {pair('numbers')} | "
                        f"{pair('pictures')} | {rate} |",
                        flush=True,
                    )


def soak(count: int, kind: type[Observer]) -> None:
    """Prints memory over many small frames, with one viewer."""
    camera = Camera(
        320, 240, torch.tensor([[480.0, 0, 159.5], [0, 480.0, 119.5], [0, 0, 1]], dtype=torch.float64), torch.zeros(5)
    )
    target = Target.load("quad40")
    with tempfile.TemporaryDirectory() as folder:
        frames = Played(frames_of(camera, target, 150.0))
        with served(kind(camera, target), target, frames, Path(folder)) as (live, port):
            began, told = time.monotonic(), 0
            command = [sys.executable, VIEWERS, str(port), "1", "1e9"]
            viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            try:
                while live.snapshot.number < count:
                    time.sleep(0.2)
                    if live.snapshot.number >= told:
                        rate = live.snapshot.number / (time.monotonic() - began)
                        print(
                            f"{live.snapshot.number:7d} frames  {resident_mb():7.1f} MB  {rate:.1f} frames/s",
                            flush=True,
                        )
                        told += max(1, count // 50)
            finally:
                viewer.kill()
                viewer.wait()


def resident_mb() -> float:
    """Memory of this process now."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / PAGE_KB**2
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / PAGE_KB


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each row of the table")
    parser.add_argument("--soak", type=int, metavar="FRAMES", help="only play so many small frames")
    parser.add_argument("--remembered", action="store_true", help="without the estimator")
    parser.add_argument("--looks", type=int, metavar="FRAMES", help="only tell what tracking saves")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if given.looks:
        looks(given.looks)
    elif given.soak:
        soak(given.soak, Remembering if given.remembered else Observer)
    else:
        latencies(given.seconds)


if __name__ == "__main__":
    main()

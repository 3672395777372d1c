"""A small scene that changes while a page looks at it: what the tests of the live page share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpose.camera import Camera
from torchpose.live.app import Answers
from torchpose.live.engine import Live, Observer
from torchpose.live.recording import Recorder
from torchpose.live.server import Server, listen
from torchpose.live.sources import Frames, Shot
from torchpose.sim import add_noise, render
from torchpose.target import Target

F64 = torch.float64
WIDTH, HEIGHT = 480, 360
CAMERA = Camera(
    WIDTH,
    HEIGHT,
    torch.tensor([[700.0, 0, 239.5], [0, 700.0, 179.5], [0, 0, 1]], dtype=F64),
    torch.zeros(5, dtype=F64),
)
TARGET = Target.load("quad40")
POSE = (torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 150.0]], dtype=F64))
LOOK: dict[str, Any] = {"psf_sigma": 0.7, "dark": 30.0, "light": 220.0, "surround": 110.0, "plate": (70.0, 70.0)}


def picture(number: int = 0, t: tuple[float, float, float] = (0.0, 0.0, 150.0), **look: Any) -> np.ndarray:
    """A frame (H, W) uint8 of the target."""
    place = torch.tensor([t], dtype=F64)
    ideal = render(CAMERA, TARGET, POSE[0], place, **(LOOK | look))
    return np.asarray(add_noise(ideal, 1.0, number)[0])


@dataclass
class Scene:
    """Frames that are what they are set to; ``gap_s`` apart."""

    images: list[np.ndarray] = field(default_factory=lambda: [picture()])
    gap_s: float = 0.05
    kind: str = "folder"
    number: int = 0

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def newest(self, wait: Callable[[float], object]) -> Shot:
        wait(self.gap_s)
        self.number += 1
        return Shot(f"{self.number:06d}.png", time.time(), self.images[self.number % len(self.images)])


@dataclass
class Page:
    """A page that is served."""

    port: int
    live: Live
    lines: list[str]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def until(self, true: Callable[[], bool], seconds: float = 10.0) -> None:
        """Returns when something is true, which it has to be soon."""
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, "too late"
            time.sleep(0.02)


@contextmanager
def looking(frames: Frames, folder: Path, lines: list[str], camera: Camera = CAMERA) -> Iterator[Live]:
    """An estimator thread on frames."""
    observer = Observer(camera, TARGET)
    images = {"camera": [camera.width, camera.height, "as taken"]}
    about = {"source": frames.kind, "target": TARGET.name, "emulated": True, "images": images}
    with Recorder(folder, **about) as recorder, Live(frames, observer, recorder, lines.append) as live:
        yield live


def answers_of(live: Live, lines: list[str], wanted_um: float | None = 1.0) -> Answers:
    camera = live.observer.camera
    shown: dict[str, Any] = {
        "version": "test",
        "source": live.frames.kind,
        "target": TARGET.name,
        "wanted_um": wanted_um,
    }
    shown |= {"width": camera.width, "height": camera.height, "markers": TARGET.ids.tolist()}
    return Answers(live, shown, wanted_um, lines.append)


@contextmanager
def served(
    frames: Frames, folder: Path, *, camera: Camera = CAMERA, token: str | None = None, wanted_um: float = 1.0
) -> Iterator[Page]:
    """A page of frames, on a port of its own."""
    lines: list[str] = []
    with looking(frames, folder, lines, camera) as live, listen("127.0.0.1", 0) as listening:
        server = Server(answers_of(live, lines, wanted_um), "127.0.0.1", token, lines.append)
        thread = threading.Thread(target=server.run, args=(listening,))
        thread.start()
        try:
            yield Page(listening.getsockname()[1], live, lines)
        finally:
            server.end()
            thread.join()

"""What the commands share: options, cores, checks of inputs and outputs, the last line and the exit code."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.errors import ConfigError, printable

if TYPE_CHECKING:
    from torchpose import camera as cameras
    from torchpose.io.sources import Source
    from torchpose.io.storage import Place

INTERRUPTED = 130  # as shells have it: 128 + SIGINT
CLOSED = 141  # 128 + SIGPIPE: nobody reads on, as behind `| head`

MOST_SEED = 2**63 - 1  # of torch's generators
_MOST_THREADS = 256  # (convention) more than any machine of today gains from; thousands of stacks end the process
_MOST_BATCH = 4096  # frames (convention): of 20 megapixels they fill 80 GB
_THREADS = "Cores to use; by default all."
Threads = Annotated[int | None, typer.Option("--threads", "-j", min=1, max=_MOST_THREADS, help=_THREADS)]
Tone = Annotated[
    str | None,
    typer.Option(
        metavar="linear|srgb|gamma:G", help="How grey values follow light; goes before `tone` in the camera file."
    ),
]
Batch = Annotated[
    int | None, typer.Option(min=1, max=_MOST_BATCH, help="Frames at once; by default chosen by their size.")
]
Overlay = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for pictures of what was found, one a frame.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")]
Silent = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar and no summary.")]
Resume = Annotated[bool, typer.Option("--resume", help="Keep the frames that an earlier run finished.")]


def say(text: str, *, err: bool = False) -> None:
    """Prints a line; names of files in it cannot steer the terminal."""
    typer.echo(printable(text), err=err)


def use_threads(threads: int | None, *, share: float = 1.0) -> int:
    """Has torch use a share of the threads; how many there are in all. More than cores would only wait."""
    import torch

    wanted = threads or cores()
    torch.set_num_threads(max(1, min(int(share * wanted), cores())))
    return wanted


@contextmanager
def importing() -> Iterator[None]:
    """Around imports: what modules are made of is no garbage, and is not searched for any again and again."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def one_thread_each() -> None:
    """Has torch and OpenCV use one thread: the cores are shared out among processes (`torchpose.io.processes`).

    Results then do not depend on the number of cores, and a process that has no threads can be forked.
    """
    from torchpose.io.processes import one_thread

    one_thread()


def check_device(name: str) -> None:
    """Raises ConfigError unless frames can be worked on there."""
    import torch

    if name not in ("cpu", "cuda"):
        raise ConfigError(f"--device: {name} is not known; give cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device: torch finds no CUDA device here; leave --device out, or install torch for CUDA")


def frames_of(inputs: Sequence[Path | Place], listed: Sequence[Path] = ()) -> list[Source]:
    """Frames of the INPUTs, and of a list of further ones; what is passed over is told on stderr."""
    from torchpose.io.sources import find_sources

    return find_sources(inputs, lambda line: say(f"torchpose: {line}", err=True), more=listed)


def listed_files(inputs: Sequence[object], files_from: Path | None) -> list[Path]:
    """What --files-from names. ConfigError: there is no INPUT either."""
    from torchpose.io.lists import read_list

    if files_from is not None:
        return read_list(files_from)
    if not inputs:
        raise ConfigError("INPUT: is missing; give image files, folders or a capture manifest, or --files-from")
    return []


def built_in_targets(incomplete: str) -> list[str]:
    """Names of built-in targets that begin so, for the shell to complete."""
    places = (Path(__file__).parents[1] / "targets").glob("*.yaml")
    return sorted(path.stem for path in places if path.stem.startswith(incomplete))


def check_outputs(
    given: Sequence[Path | Place], sources: Sequence[Source], tables: Sequence[Path], overlay: Path | None
) -> None:
    """Refuses outputs that would overwrite or mingle with inputs."""
    from torchpose.config import real

    inputs = [path for path in given if isinstance(path, Path)]
    read = {real(path) for path in inputs}
    for table in tables:
        if real(table) in read:
            raise ConfigError(f"{table}: --out: is an INPUT too; choose another file")
    if overlay is None:
        return
    place = real(overlay)
    folder = next((path for path in inputs if os.path.isdir(path) and place.is_relative_to(real(path))), None)
    if folder is not None:
        raise ConfigError(
            f"{overlay}: --overlay: lies inside INPUT {folder}, where its pictures would be taken for frames; "
            "choose a folder outside"
        )
    from torchpose.report.overlay import picture_path

    frames = {real(source.path) for source in sources if isinstance(source.path, Path)}
    places = [picture_path(place, source.name) for source in sources]  # refuses those that lie outside
    if any(path in frames for path in places):
        raise ConfigError(f"{overlay}: --overlay: its pictures would overwrite the frames; choose another folder")
    drawn: dict[tuple[object, Path], str] = {}
    for source, path in zip(sources, places, strict=True):
        first = drawn.setdefault((source.root, path), source.name)  # cameras of a rig have a root and a folder each
        if first != source.name:
            raise ConfigError(
                f"{first}: --overlay: would be the same picture as that of {source.name}, {path.name}; rename one"
            )


def read_tone(text: str | None) -> cameras.Tone | None:
    """The tone that --tone names."""
    from torchpose.camera import Tone

    return None if text is None else Tone.parse(text, "--tone")


def with_tone(camera: cameras.Camera, text: str | None) -> cameras.Camera:
    """The camera with the tone that --tone names, where it is given."""
    from dataclasses import replace

    return camera if text is None else replace(camera, tone=read_tone(text))


def check_robot_poses(sources: Sequence[Source], why: str = "") -> None:
    """Refuses frames without a robot pose; ``why`` they need one."""
    without = [source for source in sources if source.robot_pose is None]
    if without:
        raise ConfigError(
            f"{without[0].path}: robot_pose: missing for {len(without)} of {len(sources)} frames{why}; "
            "give a capture manifest with robot poses as INPUT"
        )


def cores() -> int:
    """Cores that this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def interrupted(what: str) -> int:
    """Tells what an interruption has left; the exit code."""
    say(f"torchpose: error: interrupted: {what}", err=True)
    return INTERRUPTED


def ended(unreadable: dict[str, str]) -> int:
    """Tells of frames that could not be read, by name with the reason; the exit code of a run that came to its end."""
    if not unreadable:
        return 0
    shown = [f"{frame} ({reason})" for frame, reason in list(unreadable.items())[:5]]
    more = [f"and {len(unreadable) - 5} more"] if len(unreadable) > 5 else []
    say(
        f"torchpose: error: {', '.join(shown + more)}: INPUT: {len(unreadable)} could not be read; "
        "replace the files and run again",
        err=True,
    )
    return 1

"""``torchpose watch``: a row for every picture that arrives in a folder."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchpose.cli.common import CLOSED, Batch, Silent, Threads, Tone, cores, ended, say, use_threads
from torchpose.cli.options import CameraFile, HandEyeFile, Instances, LastStage, RelativeTo, Targets, Upright
from torchpose.errors import ConfigError

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.io.estimates import Estimation
    from torchpose.io.feeds import Feed
    from torchpose.io.growing import GrowingTable
    from torchpose.io.stream import StreamedRows
    from torchpose.io.watching import Watching

_FOLDER = "Folder that pictures are written into, or below. Those that are there already are taken first."
_OUT = "Table that grows: .jsonl or .csv; or `-`: JSON lines on standard output."
_SETTLE = "A file that nobody says was closed is whole once it has not changed for so long."
_POLL = "Read the folder again and again instead of asking the system for events (network drives)."
_IDLE = "End after so long without a new picture; by default never."
_WEBSOCKET = "Also give the rows over a WebSocket at this port (docs/shell.md)."
_OPCUA = "Also give the latest rows over OPC UA at this port (docs/shell.md)."
_HOST = "Address that --websocket and --opcua listen on; beyond this machine with --token alone."
_TOKEN = "What clients of --websocket and --opcua have to know."


def watch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help=_FOLDER)],
    out: Annotated[Path, typer.Option("--out", "-o", help=_OUT)],
    camera: CameraFile = None,
    target: Targets = None,
    instances: Instances = None,
    assume_upright: Upright = None,
    hand_eye: HandEyeFile = None,
    relative_to: RelativeTo = None,
    method: LastStage = None,
    tone: Tone = None,
    settle: Annotated[float, typer.Option(min=0.01, max=3600, metavar="SECONDS", help=_SETTLE)] = 1.0,
    poll: Annotated[bool, typer.Option("--poll", help=_POLL)] = False,
    idle: Annotated[float | None, typer.Option(min=0.1, metavar="SECONDS", help=_IDLE)] = None,
    websocket: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help=_WEBSOCKET)] = None,
    opcua: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help=_OPCUA)] = None,
    host: Annotated[str, typer.Option(help=_HOST)] = "127.0.0.1",
    token: Annotated[str, typer.Option(help=_TOKEN, envvar="TORCHPOSE_TOKEN")] = "",
    batch: Batch = None,
    threads: Threads = None,
    quiet: Silent = False,
) -> int:
    """Measure every picture that arrives in a folder, once it is whole, until a signal ends it.

    Rows as those of estimate, appended in the order of arrival. Started again, it goes on where it ended: no row is
    missing or twice.
    """
    import cv2

    from torchpose.cli.estimate import estimation
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.arrivals import Arrivals
    from torchpose.io.project import settings
    from torchpose.io.watching import Watching

    options: dict[str, Any] = {"camera": camera, "target": target, "method": method, "tone": tone}
    options |= {"instances": instances, "hand_eye": hand_eye, "relative_to": relative_to}
    stated = settings([folder], **options, assume_upright=assume_upright)
    work = estimation(stated, [])
    if work.hand_eye is not None and work.hand_eye.mount == "tool":
        raise ConfigError(f"{hand_eye}: --hand-eye: is of a camera on the tool; pictures alone have no robot poses")
    cv2.setNumThreads(1)
    use_threads(threads, share=0.5)
    with contextlib.ExitStack() as opened:
        arrivals = Arrivals(folder, settle=settle, events=not poll, tell=_tell)
        opened.callback(arrivals.close)
        sink = _opened(work, folder, out)
        opened.callback(sink.close)
        feeds = [opened.enter_context(feed) for feed in _feeds(work, websocket, opcua, (host, token))]
        publish = [feed.publish for feed in feeds]
        watching = Watching(work, arrivals, sink, publish, threads=threads or cores(), batch=batch)
        if not quiet:
            _tell_start(folder, arrivals.by_events, stated.told)
        with native_stderr_silenced(), _ended_by_signals(watching):
            closed = _run(watching, sink, idle)
    if not (quiet or closed):
        _tell_end(folder, sink)
    return CLOSED if closed else ended(sink.tally.unreadable)


def _run(watching: Watching, sink: GrowingTable | StreamedRows, idle: float | None) -> bool:
    """Takes what arrives, to the end; whether that is because nobody reads standard output any more."""
    try:
        _with_tone(watching, sink, idle)
        watching.run(idle=idle)
    except BrokenPipeError:
        return True
    return False


def _opened(work: Estimation, folder: Path, out: Path) -> GrowingTable | StreamedRows:
    """Where the rows go. The tone is part of what they are made from only where somebody has stated it."""
    from torchpose.config import real
    from torchpose.io.growing import GrowingTable
    from torchpose.io.stream import StreamedRows, is_standard

    if is_standard(out):
        return StreamedRows(work.schema)
    origin = work.origin([str(real(folder))], detections=False)
    if work.camera.tone is None:
        del origin["--tone"]
    return GrowingTable(out, work.schema, origin)


def _feeds(work: Estimation, websocket: int | None, opcua: int | None, access: tuple[str, str]) -> list[Feed]:
    """What else gives the rows; ``access`` is host and token. ConfigError: its library is missing."""
    from importlib.util import find_spec

    from torchpose.io.feeds import Place
    from torchpose.io.feeds.opcua import OpcUaFeed
    from torchpose.io.feeds.websocket import WebSocketFeed

    for port, option, library, extra in (
        (websocket, "--websocket", "websockets", "live"),
        (opcua, "--opcua", "asyncua", "opcua"),
    ):
        if port is not None and find_spec(library) is None:
            raise ConfigError(f"{option}: {library} is not installed; pip install 'torchpose[{extra}]'")
    made: list[Feed] = []
    if websocket is not None:
        made.append(WebSocketFeed(Place(websocket, *access), schema=work.schema))
    if opcua is not None:
        names = [target.name for target in work.rows_of]
        made.append(OpcUaFeed(Place(opcua, *access), targets=names, schema=work.schema))
    return made


def _with_tone(watching: Watching, sink: GrowingTable | StreamedRows, idle: float | None) -> None:
    """Has the camera take the tone that an earlier run has judged, or that the first pictures tell."""
    from dataclasses import replace

    from torchpose.camera import LINEAR, Tone
    from torchpose.cli.estimate import with_judged_tone
    from torchpose.io.growing import GrowingTable

    work = watching.work
    if work.camera.tone is not None:
        return
    table = sink if isinstance(sink, GrowingTable) else None
    if table is not None and table.tone is not None:
        lens = replace(work.camera, tone=Tone.parse(table.tone, "tone"))
    else:
        lens = with_judged_tone(work.camera, work.targets[0], first := watching.first(idle=idle))
        if table is not None and first:
            table.keep_tone(str(lens.tone or LINEAR))
    watching.work = replace(work, camera=lens)


def _tell(line: str) -> None:
    say(f"torchpose: {line}", err=True)


def _tell_start(folder: Path, by_events: bool, told: str) -> None:
    how = "" if by_events else ", read again and again (no events: --poll, no watchdog, or the system has none)"
    say(f"torchpose: {folder}: waiting for pictures{how}; Ctrl-C or SIGTERM ends it", err=True)
    if told:
        say(f"torchpose: {told}", err=True)


def _tell_end(folder: Path, sink: GrowingTable | StreamedRows) -> None:
    counts = ", ".join(f"{count} {status}" for status, count in sink.tally.counts.most_common())
    say(f"torchpose: {folder}: {sink.tally.counts.total()} rows ({counts or 'no picture arrived'})", err=True)


@contextlib.contextmanager
def _ended_by_signals(watching: Watching) -> Iterator[None]:
    """SIGINT and SIGTERM let the batch in hand be written; a second SIGINT does not wait for it."""

    def stop(number: int, _: object) -> None:
        watching.stopped = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

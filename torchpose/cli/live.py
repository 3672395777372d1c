"""``torchpose live``: a page in the browser that shows what a camera sees while someone sets a rig up."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchpose.cli.common import Tone, say, use_threads, with_tone
from torchpose.cli.options import METHODS, camera_option, target_option
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.camera import Camera
    from torchpose.live.sources import Frames
    from torchpose.target import Target

_SOURCE = "Folder, manifest or film played as a camera, over and over. Or give --rig."
_CAMERA = "Camera file, as for `estimate`."
_TARGET = "Target file or name of a built-in target."
_RIG = "Rig file (YAML): show its Basler camera; RIG#NAME picks one of several. Its robot is left alone."
_TWIN = "Emulate the camera as this file (YAML) says; the tool stands in the middle of the workspace."
_HOST = "Address to listen on. Anything but this machine's own demands --token."
_TOKEN = "What whoever opens the page has to know: once in the URL, ?token=TOKEN, or as a header."
_RATE = "Frames a second: of a folder (5 unless given), of a video (its own), at most of a camera."
_RECORD = "Folder for recordings and stills."
_WANTED = "Standard deviation of the position that is wanted, um, to compare with."
_SHORT = 12  # characters of a token (convention), below which it can be guessed


def live(
    camera: Annotated[str, camera_option(_CAMERA)],
    target: Annotated[str, target_option(_TARGET)],
    source: Annotated[Path | None, typer.Argument(metavar="[SOURCE]", help=_SOURCE)] = None,
    rig: Annotated[Path | None, typer.Option(metavar="RIG", help=_RIG)] = None,
    twin: Annotated[Path | None, typer.Option(metavar="TWIN", help=_TWIN)] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes one that is free.")] = 8765,
    host: Annotated[str, typer.Option(help=_HOST)] = "127.0.0.1",
    token: Annotated[str | None, typer.Option(envvar="TORCHPOSE_TOKEN", help=_TOKEN)] = None,
    rate: Annotated[float | None, typer.Option(min=0.01, max=1000, metavar="FPS", help=_RATE)] = None,
    record: Annotated[Path, typer.Option(metavar="DIR", help=_RECORD)] = Path("torchpose-live"),
    wanted_um: Annotated[float | None, typer.Option(min=1e-6, max=1e6, metavar="UM", help=_WANTED)] = None,
    method: Annotated[str, typer.Option("--method", "-m", metavar=METHODS, help="As for `estimate`.")] = "photometric",
    tone: Tone = None,
    assume_upright: Annotated[bool, typer.Option("--assume-upright", help="As for `estimate`.")] = False,
    threads: Annotated[int, typer.Option("--threads", "-j", min=1, max=256, help="Threads of the estimator.")] = 1,
) -> int:
    """Show in a browser what a camera sees: picture, pose, uncertainty, and what to turn.

    The page is at http://127.0.0.1:8765 until Ctrl-C. It shows blur, exposure, size and tilt of the rings, records
    sessions that `estimate` reads, and moves nothing.
    """
    from torchpose.camera import Camera
    from torchpose.target import Target

    if (source is None) == (rig is None):
        raise ConfigError("SOURCE, --rig: give one of both: a folder or video file, or a rig file")
    if twin is not None and rig is None:
        raise ConfigError("--twin: stands in the place of a rig; give --rig too")
    _check_access(host, token)
    lens, plate = with_tone(Camera.load(camera), tone), Target.load(target)
    plate = plate.upright() if assume_upright else plate
    frames, lens = _frames(source, rig, twin, (lens, plate), rate)
    use_threads(threads)  # threads of torch gain little on one frame, and the page needs a core too
    options: dict[str, Any] = {"method": method}
    return _serve(frames, lens, plate, options, record=record, wanted_um=wanted_um, at=(host, port, token))


def _check_access(host: str, token: str | None) -> None:
    """Refuses a page that anyone on the network could open. ConfigError: without the extra, too."""
    try:
        from torchpose.live.guard import is_loopback
    except ImportError:
        raise ConfigError("live: starlette or uvicorn is not installed; pip install 'torchpose[live]'") from None
    if token is not None and (not token.isascii() or not token.isprintable() or " " in token or not token):
        raise ConfigError("--token: has to be of letters, digits and signs, without blanks")
    if is_loopback(host):
        return
    if token is None:
        raise ConfigError(
            f"{host}: --host: is beyond this machine: whoever reaches it could look; give --token TOKEN, which they "
            "have to know"
        )
    guess = "" if len(token) >= _SHORT else f"; the token has less than {_SHORT} characters and may be guessed"
    say(f"torchpose: warning: --host {host}: the network can ask for this page, unencrypted{guess}", err=True)


def _frames(
    source: Path | None, rig: Path | None, twin: Path | None, seen: tuple[Camera, Target], rate: float | None
) -> tuple[Frames, Camera]:
    """What is shown, and the camera with the tone that files tell, as `estimate` judges it."""
    from torchpose.cli.estimate import with_judged_tone
    from torchpose.live.sources import camera_of_rig, player

    lens, plate = seen
    size = (lens.width, lens.height)
    if rig is not None:
        return camera_of_rig(rig, twin, size, rate), lens
    assert source is not None
    frames = player(source, size, rate, lambda line: say(f"torchpose: {line}", err=True))
    return frames, lens if lens.tone is not None else with_judged_tone(lens, plate, frames.sources)


def _serve(
    frames: Frames,
    lens: Camera,
    plate: Target,
    options: dict[str, Any],
    *,
    record: Path,
    wanted_um: float | None,
    at: tuple[str, int, str | None],
) -> int:
    """Shows until a signal comes."""
    from importlib.metadata import version

    import cv2

    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.live.app import Answers
    from torchpose.live.engine import Live, Observer
    from torchpose.live.recording import Recorder
    from torchpose.live.server import Server, listen

    def tell(line: str) -> None:
        say(f"torchpose: live: {line}", err=True)

    host, port, token = at
    cv2.setNumThreads(1)
    observer = Observer(lens, plate, **options)
    images = {"camera": [lens.width, lens.height, "as taken"]}
    about = {"source": frames.kind, "target": plate.name, "emulated": frames.kind == "twin", "images": images}
    shown = {
        "version": version("torchpose"),
        "source": frames.kind,
        "target": plate.name,
        "width": lens.width,
        "height": lens.height,
        "wanted_um": wanted_um,
        "markers": plate.ids.tolist(),
    }
    with listen(host, port) as listening, native_stderr_silenced(), Recorder(record, **about) as recorder:
        with Live(frames, observer, recorder, tell) as live:
            server = Server(Answers(live, shown, wanted_um, tell), host, token, tell)
            name = f"[{host}]" if ":" in host else host
            say(f"torchpose: live at http://{name}:{listening.getsockname()[1]}/ (Ctrl-C ends)", err=True)
            server.run(listening)
        recorder.stop()
        if recorder.state.name is not None:
            last = recorder.state
            say(f"torchpose: {record / str(last.name)}: {last.frames} frames recorded", err=True)
    return 0

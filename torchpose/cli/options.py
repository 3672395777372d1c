"""Options of the commands that estimate poses: the same words and letters in all of them."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from torchpose.cli.common import built_in_targets, cores
from torchpose.errors import ConfigError

_CAMERA = (
    "Camera file: OpenCV YAML, JSON or XML, ROS camera_info, Kalibr camchain, COLMAP cameras.txt and others "
    "(docs/cameras.md). FILE#cam1 or FILE#2 picks one of several."
)
_CAMERAS = (
    "Several cameras, instead of --camera: Kalibr camchain, OpenCV's stereo calibration, or a folder of ROS "
    "camera_info with tf_static.yaml. INPUT has one folder a camera (cam0, cam1, ...), or is a capture manifest "
    "(docs/rigs.md)."
)
MOST_ANGLE = 80.0  # degrees between two cameras (convention): a flat target is seen from less than 90
METHODS = "photometric|edges|centers|paper"  # torchpose.pipeline.Method, which takes a second to import
_METHOD = "Last stage: grey values (the default), edge points, ring centres, or the paper's own chain."
_HAND_EYE = "Calibrated camera-to-base or camera-to-tool transform; adds the poses in the robot base."
_INSTANCES = (
    "Most copies of a target in a frame (a tray of equal parts): up to as many rows, column instance. By default 1."
)
_TARGET = (
    "Target file or name of a built-in target, or a board of equal marks: rings:10x7:20mm:6mm:3mm (columns, rows, "
    "pitch, radii), circles:7x6:20mm:4mm, acircles:4x11:20mm:4mm (pitch, radius); repeat for several."
)
_UPRIGHT = (
    "Boards that look the same after a turn have their rows to the right. Without, they are ambiguous unless measured."
)
_RELATIVE = "Name of a target: give the poses of the others (of their parts) in its frame (that of its part)."
_FROM = (
    "List of further INPUTs, one a line or with zeros between them; `-`: standard input. Frames are called by their "
    "place below the folder that holds all of them."
)


ENGINE = "What runs the work: processes of this machine, or the workers of a Ray cluster (extra: ray)."
ADDRESS = "With --engine ray: a cluster that is there; without it, one starts here and ends with the command."


class Engine(StrEnum):
    local = "local"
    ray = "ray"


@contextmanager
def crew_of(engine: Engine, address: str | None, threads: int | None) -> Iterator[Any]:
    """Who shares out the work: `Crew` or what is like it, of so many. ConfigError: nobody answers."""
    check_address(engine, address, threads)
    threads = threads or cores()
    if engine is Engine.local:
        from torchpose.io.processes import Crew

        yield partial(Crew, count=threads)
        return
    from torchpose.scale.cluster import cluster
    from torchpose.scale.crew import RayCrew

    with cluster(address, threads) as workers:
        yield partial(RayCrew, count=workers.count)


def check_address(engine: Engine, address: str | None, threads: int | None) -> None:
    """Raises ConfigError for an address that nothing would use, and for threads that it leaves without use."""
    if address is not None and engine is not Engine.ray:
        raise ConfigError("--address: is of --engine ray alone; add it or leave --address out")
    if address is not None and threads is not None:
        raise ConfigError("--threads: is of a cluster that starts here, --address names another; leave one of them out")


def camera_option(text: str) -> Any:
    """--camera with a help text."""
    return typer.Option("--camera", "-c", help=text)


def target_option(text: str) -> Any:
    """--target with a help text."""
    return typer.Option("--target", "-t", help=text, autocompletion=built_in_targets)


def folder_option(text: str) -> Any:
    """--out for a folder, with a help text."""
    return typer.Option("--out", "-o", metavar="DIR", help=text)


CameraFile = Annotated[str | None, camera_option(_CAMERA)]
Cameras = Annotated[Path | None, typer.Option("--cameras", metavar="RIG", help=_CAMERAS)]
Targets = Annotated[list[str] | None, target_option(_TARGET)]
Instances = Annotated[int | None, typer.Option(min=1, max=1000, metavar="K", help=_INSTANCES)]
Upright = Annotated[bool | None, typer.Option("--assume-upright", help=_UPRIGHT)]
HandEyeFile = Annotated[Path | None, typer.Option("--hand-eye", help=_HAND_EYE)]
RelativeTo = Annotated[str | None, typer.Option(metavar="NAME", help=_RELATIVE)]
LastStage = Annotated[str | None, typer.Option("--method", "-m", metavar=METHODS, help=_METHOD)]
FilesFrom = Annotated[Path | None, typer.Option("--files-from", "-f", metavar="FILE", help=_FROM)]

"""``torchpose simulate``: a plan file in, frames with exact truth out."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from torchpose.cli.common import Batch, Quiet, Resume, Threads, importing, interrupted, one_thread_each, say
from torchpose.cli.options import ADDRESS, ENGINE, Engine, crew_of
from torchpose.errors import ConfigError

_OUT = "Folder of the data set, on a disk or in a store (s3://BUCKET/FOLDER)."
_BACKEND = "Who renders: the analytic renderer, or Blender Cycles (extra: blender)."


class Backend(StrEnum):
    analytic = "analytic"
    blender = "blender"


def simulate(
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="Plan file (YAML): poses, imaging, sensor.")],
    out: Annotated[str, typer.Option("--out", "-o", metavar="DIR", help=_OUT)],
    backend: Annotated[Backend, typer.Option(help=_BACKEND)] = Backend.analytic,
    resume: Resume = False,
    bop: Annotated[bool, typer.Option("--bop", help="Export the layout of the BOP challenge besides.")] = False,
    batch: Batch = None,
    threads: Threads = None,
    engine: Annotated[Engine, typer.Option(help=ENGINE)] = Engine.local,
    address: Annotated[str | None, typer.Option(help=ADDRESS)] = None,
    quiet: Quiet = False,
) -> int:
    """Render the frames of a plan, with their exact truth and the Cramer-Rao bound of every pose.

    The frames depend on the plan alone: not on batch size, threads or interruptions.
    """
    from collections import Counter

    with importing():
        from torchpose.cli.terminal import FrameProgress
        from torchpose.datasets.dataset import write_bop, write_dataset, write_rig_dataset
        from torchpose.datasets.plan import load_plan
        from torchpose.io.storage import place_of

    place = place_of(out)
    if bop and not isinstance(place, Path):
        raise ConfigError("--bop: links the frames, which a store cannot; give a folder of a disk or leave it out")
    if backend is Backend.blender and engine is Engine.ray:
        raise ConfigError("--backend: blender renders on this machine alone; leave --engine ray out")
    one_thread_each()
    read = load_plan(plan)
    if bop and read.rig is not None:
        raise ConfigError("--bop: is of one camera; leave it out for a plan with cameras")
    write = write_dataset if read.rig is None else write_rig_dataset
    cameras = 1 if read.rig is None else len(read.rig)
    how: dict[str, Any] = {"backend": backend.value, "resume": resume, "batch": batch}
    with FrameProgress(cameras * len(read), 0, quiet=quiet) as progress:
        how["progress"] = lambda done: progress.advance(done, Counter())
        try:
            with crew_of(engine, address, threads) as crew:
                write(read, place, **how, crew=crew)
            if bop and isinstance(place, Path):
                write_bop(place)
        except KeyboardInterrupt:
            return interrupted(f"{place} keeps its frames; add --resume to go on")
    if not quiet:
        marked = int((read.seen < len(read.target)).sum())
        several = None if read.rig is None else f"each of {', '.join(str(place / name) for name in read.rig.names)}"
        say(f"{len(read)} frames in {several or place / 'frames'}, truth in {place / 'truth.csv'}", err=True)
        if marked:
            say(f"{marked} of them without the whole target in view, marked in the truth", err=True)
    return 0

"""``torchpose simulate``: a plan file in, frames with exact truth out."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from torchpose.cli.common import INTERRUPTED, cores

EPILOG = """
Examples:

`torchpose simulate configs/plans/paper_grid.yaml --out out/grid`

`torchpose simulate plan.yaml --out out/stress --resume --bop`

Then `torchpose estimate out/grid/frames --camera out/grid/camera.yaml --target out/grid/target.yaml --out poses.csv`
and `torchpose evaluate poses.csv out/grid`. docs/simulation.md describes plans and the truth file.

Exit codes: 0 all frames are there; 2 a usage or configuration error; 130 interrupted (go on with `--resume`).
"""


class Backend(StrEnum):
    analytic = "analytic"
    blender = "blender"


def simulate(
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="Plan file (YAML): poses, imaging, sensor.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the data set.")],
    backend: Annotated[
        Backend, typer.Option(help="Who renders: the analytic renderer, or Blender Cycles (extra: blender).")
    ] = Backend.analytic,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the frames that an earlier run finished.")] = False,
    bop: Annotated[bool, typer.Option("--bop", help="Export the layout of the BOP challenge besides.")] = False,
    batch: Annotated[int | None, typer.Option(min=1, help="Frames at once; by default chosen by their size.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads to use; by default one a core.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> int:
    """Render the frames of a plan, with their exact truth and the Cramer-Rao bound of every pose.

    The frames depend on the plan alone: not on batch size, threads or interruptions.
    """
    from collections import Counter

    import cv2
    import torch

    from torchpose.cli.terminal import FrameProgress
    from torchpose.datasets.dataset import write_bop, write_dataset
    from torchpose.datasets.plan import load_plan

    cv2.setNumThreads(1)
    torch.set_num_threads(max(1, (threads or cores()) // 2))
    read = load_plan(plan)
    with FrameProgress(len(read), 0, quiet=quiet) as progress:
        try:
            write_dataset(
                read,
                out,
                backend=backend.value,
                resume=resume,
                batch=batch,
                threads=threads or cores(),
                progress=lambda done: progress.advance(done, Counter()),
            )
            if bop:
                write_bop(out)
        except KeyboardInterrupt:
            typer.echo(f"torchpose: error: interrupted: {out} keeps its frames; add --resume to go on", err=True)
            return INTERRUPTED
    if not quiet:
        marked = int((read.seen < len(read.target)).sum())
        typer.echo(f"{len(read)} frames in {out / 'frames'}, truth in {out / 'truth.csv'}", err=True)
        if marked:
            typer.echo(f"{marked} of them without the whole target in view, marked in the truth", err=True)
    return 0

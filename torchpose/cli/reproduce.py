"""``torchpose reproduce``: the paper's tables and figures in one report."""

from pathlib import Path
from typing import Annotated

import typer

from torchpose.cli.common import MOST_SEED, Quiet, interrupted, say
from torchpose.cli.options import folder_option

_Full = Annotated[bool, typer.Option("--full", help="As many seeds and frames as the documented figures have: hours.")]


def reproduce(
    out: Annotated[Path, folder_option("Folder of the report, report.html, and its tables.")],
    full: _Full = False,
    only: Annotated[list[str] | None, typer.Option(metavar="STUDY", help="This study alone; may be repeated.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the studies that an earlier run finished.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of everything random.")] = 0,
    quiet: Quiet = False,
) -> int:
    """Compute every table and figure of the paper: its number, ours and the bound side by side, with plots."""
    from torchpose.cli.terminal import StudyProgress
    from torchpose.studies.reproduce import REPORT, STUDIES
    from torchpose.studies.reproduce import reproduce as run

    with StudyProgress(list(only or STUDIES), quiet=quiet) as progress:
        try:
            failed = run(out, full=full, seed=seed, only=only or (), resume=resume, progress=progress.advance)
        except KeyboardInterrupt:
            return interrupted(f"{out} keeps the finished studies; add --resume")
    for name, reason in failed.items():
        say(f"torchpose: error: {name}: {reason}", err=True)
    if not quiet:
        say(str(out / REPORT))
    return 1 if failed else 0

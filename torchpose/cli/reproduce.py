"""``torchpose reproduce``: the paper's tables and figures in one report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from torchpose.cli.common import INTERRUPTED

EPILOG = """
Examples:

`torchpose reproduce --out report`

`torchpose reproduce --out report --full --resume`

`torchpose reproduce --out report --only table03_centers --only table04_compensation`

Exit codes: 0 all studies are in the report; 1 one failed (named in the report); 2 a usage or configuration error;
130 interrupted (go on with `--resume`).
"""


def reproduce(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the report, report.html, and its tables.")],
    full: Annotated[
        bool, typer.Option("--full", help="As many seeds and frames as the documented figures have: hours.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(metavar="STUDY", help="This study alone; may be repeated.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the studies that an earlier run finished.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> int:
    """Compute every table and figure of the paper: its number, ours and the bound side by side, with plots."""
    from torchpose.cli.terminal import StudyProgress
    from torchpose.studies.reproduce import REPORT, STUDIES
    from torchpose.studies.reproduce import reproduce as run

    with StudyProgress(list(only or STUDIES), quiet=quiet) as progress:
        try:
            failed = run(out, full=full, seed=seed, only=only or (), resume=resume, progress=progress.advance)
        except KeyboardInterrupt:
            typer.echo(f"torchpose: error: interrupted: {out} keeps the finished studies; add --resume", err=True)
            return INTERRUPTED
    for name, reason in failed.items():
        typer.echo(f"torchpose: error: {name}: {reason}", err=True)
    if not quiet:
        typer.echo(str(out / REPORT))
    return 1 if failed else 0

"""``torchpose evaluate``: estimated poses against the truth of simulated frames."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.analysis.evaluation import Evaluation
    from torchpose.io.truth import Truth

_POSES = "Table of torchpose estimate: .csv, .jsonl, .parquet."
_TRUTH = "Folder of torchpose simulate, or its truth.csv."
_PLOTS = "Folder for plots of errors, consistency and conditions."


def evaluate(
    poses: Annotated[Path, typer.Argument(metavar="POSES", help=_POSES)],
    truth: Annotated[Path, typer.Argument(metavar="DIR_OR_TRUTH", help=_TRUTH)],
    out: Annotated[Path | None, typer.Option(help="Table of the errors, one row a frame (.csv).")] = None,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help=_PLOTS)] = None,
) -> int:
    """Compare poses with the truth: bias and spread of each axis beside its bound, success by status, NEES."""
    from torchpose.analysis.evaluation import estimates_of
    from torchpose.analysis.evaluation import evaluate as evaluate_poses
    from torchpose.io.truth import read_truth

    known = read_truth(truth / "truth.csv" if truth.is_dir() else truth)
    estimates = estimates_of(_rows_of(poses, known))
    result = evaluate_poses(estimates, known)
    _show(result, estimates.full_covariance)
    if out is not None:
        _write_errors(out, result, known, estimates.status)
    if plots is not None:
        from torchpose.report.evaluation import save_plots

        for plot in save_plots(result, known, plots, poses.stem):
            typer.echo(str(plot))
    return 0


def _rows_of(path: Path, truth: Truth) -> list[dict[str, Any]]:
    """Rows of the table in the order of the truth.

    Names of frames may have a folder before them, as they do where the data set itself was the input.
    """
    from torchpose.io.writers import read_table

    rows = read_table(path)
    try:
        table = {(str(row["frame"]), str(row["target"])): row for row in rows}
        missing = [name for name in ("status", "tx", "rz", "sx", "srz") if rows and name not in rows[0]]
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{path}: POSES: cannot be read ({error!r}); give what torchpose estimate wrote") from None
    if missing:
        raise ConfigError(f"{path}: {missing[0]}: column is missing; give what torchpose estimate wrote")
    keys = list(zip(truth.frame, truth.target, strict=True))
    if not any(key in table for key in keys):
        table = {(frame.rsplit("/", 1)[-1], target): row for (frame, target), row in table.items()}
    lost = [key for key in keys if key not in table]
    if lost:
        raise ConfigError(
            f"{path}: frame: {lost[0][0]} with target {lost[0][1]} and {len(lost) - 1} more rows of the truth are "
            "missing; estimate all frames of the data set with its target.yaml"
        )
    return [table[key] for key in keys]


def _show(result: Evaluation, full_covariance: bool) -> None:
    from torchpose.cli.terminal import print_table

    columns = ("axis", "unit", "bias", "spread", "rms", "worst", "claimed sigma", "bound sigma", "rms / bound")
    rows = [(*astuple(axis), axis.rms / axis.bound) for axis in result.axes]
    console = print_table("estimate - truth, frames with status ok", columns, rows)
    total = sum(result.counts.values())
    states = ", ".join(f"{count} {status}" for status, count in result.counts.most_common())
    console.print(f"{total} rows: {states}; of {result.visible} with the whole target in view {result.found} ok")
    console.print(f"origin of the target at most {result.center:.3g} um off across the optical axis")
    low, high = result.nees_interval
    note = "" if full_covariance else " (without correlations: the table holds none)"
    console.print(f"mean NEES {result.nees:.2f}; {low:.2f} to {high:.2f} where the covariances are right{note}")


def _write_errors(path: Path, result: Evaluation, truth: Truth, status: list[str]) -> None:
    import torch

    from torchpose.analysis.evaluation import AXES, UNITS
    from torchpose.io.writers import check_table_path, write_rows

    check_table_path(path, "--out")
    axes = [f"{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True)]
    columns = [*(f"{kind}{axis}" for kind in ("", "claimed_", "bound_") for axis in axes), "nees"]
    values = torch.cat([result.error, result.predicted, result.bound, result.errors.nees[:, None]], 1).tolist()
    rows = (
        {"frame": frame, "target": target, "status": state}
        | {name: None if number != number else number for name, number in zip(columns, numbers, strict=True)}
        for frame, target, state, numbers in zip(truth.frame, truth.target, status, values, strict=True)
    )
    write_rows(path, rows, dict.fromkeys(("frame", "target", "status"), str) | dict.fromkeys(columns, float))

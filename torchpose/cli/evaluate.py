"""``torchpose evaluate``: estimated poses against the truth of simulated frames."""

from __future__ import annotations

import os
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.cli.common import say
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.analysis.evaluation import Evaluation
    from torchpose.io.rows import Row, Schema
    from torchpose.io.truth import Truth

_POSES = "Table of torchpose estimate: .csv, .jsonl, .parquet."
_TRUTH = "Folder of torchpose simulate, or its truth.csv."
_PLOTS = "Folder for plots of errors, consistency and conditions."


def evaluate(
    poses: Annotated[Path, typer.Argument(metavar="POSES", help=_POSES)],
    truth: Annotated[Path, typer.Argument(metavar="DIR_OR_TRUTH", help=_TRUTH)],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Table of the errors, one row a frame (.csv).")
    ] = None,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help=_PLOTS)] = None,
) -> int:
    """Compare poses with the truth: bias and spread of each axis beside its bound, success by status, NEES."""
    from torchpose.analysis.evaluation import estimates_of
    from torchpose.analysis.evaluation import evaluate as evaluate_poses
    from torchpose.io.truth import read_truth

    known = read_truth(truth / "truth.csv" if os.path.isdir(truth) else truth)
    rows, more = _rows_of(poses, known)
    estimates = estimates_of(rows)
    result = evaluate_poses(estimates, known)
    _show(result, estimates.full_covariance)
    if more:
        say(f"{more} further rows with a pose are of copies that the truth does not have")
    if out is not None:
        _write_errors(out, result, known, rows)
    if plots is not None:
        from torchpose.report.evaluation import save_plots

        for plot in save_plots(result, known, plots, poses.stem):
            say(str(plot))
    return 0


def _rows_of(path: Path, truth: Truth) -> tuple[list[Row], int]:
    """Rows of the table in the order of the truth, and how many with a pose are left over.

    Names of frames may have a folder before them, as they do where the data set itself was the input. Of several copies
    of a target in a frame those that lie nearest belong together.
    """
    from torchpose.analysis.evaluation import match_copies
    from torchpose.io.rows import POSE, POSE_SCHEMA, STD
    from torchpose.io.writers import read_table

    table: dict[tuple[str, str], list[Row]] = {}
    for row in read_table(path, POSE_SCHEMA, ("frame", "target", "status", *POSE, *STD)):
        table.setdefault((row["frame"], row["target"]), []).append(row)
    keys = list(zip(truth.frame, truth.target, strict=True))
    if not any(key in table for key in keys):
        table = {(frame.rsplit("/", 1)[-1], target): copies for (frame, target), copies in table.items()}
    lost = [key for key in keys if key not in table]
    if lost:
        raise ConfigError(
            f"{path}: frame: {lost[0][0]} with target {lost[0][1]} and {len(lost) - 1} more rows of the truth are "
            "missing; estimate all frames of the data set with its target.yaml"
        )
    return match_copies(keys, truth.t, table)


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


def _write_errors(path: Path, result: Evaluation, truth: Truth, rows: list[Row]) -> None:
    import torch

    from torchpose.analysis.evaluation import AXES, UNITS
    from torchpose.io.writers import check_table_path, write_rows

    check_table_path(path, "--out")
    axes = [f"{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True)]
    columns = [*(f"{kind}{axis}" for kind in ("", "claimed_", "bound_") for axis in axes), "nees"]
    values = torch.cat([result.error, result.predicted, result.bound, result.errors.nees[:, None]], 1).tolist()
    errors = (
        {"frame": frame, "target": target, "status": row["status"], "instance": int(row.get("instance") or 0)}
        | {name: None if number != number else number for name, number in zip(columns, numbers, strict=True)}
        for frame, target, row, numbers in zip(truth.frame, truth.target, rows, values, strict=True)
    )
    schema: Schema = dict.fromkeys(("frame", "target", "status"), str) | {"instance": int}
    write_rows(path, errors, schema | dict.fromkeys(columns, float))

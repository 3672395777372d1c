"""The command line of a study that is run by itself: ``python scripts/fig02_pnp_comparison.py --out out/fig02``."""

import argparse
import inspect
import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

from torchpose.errors import ConfigError
from torchpose.report.html import cell
from torchpose.studies.study import StudyResult, Table

_COMMON = ("full", "seed", "progress")


def main(study: ModuleType) -> int:
    """Runs a study, prints its tables and statements, writes its files; the exit code.

    Whole-number parameters of the study's ``run`` besides the common ones become options of their own; left out, they
    are as ``full`` or not makes them.
    """
    parser = argparse.ArgumentParser(description=study.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for tables (.csv) and plots (.png)")
    parser.add_argument("--full", action="store_true", help="as many seeds and frames as the documented figures have")
    parser.add_argument("--seed", type=int, default=0)
    own = [name for name in inspect.signature(study.run).parameters if name not in _COMMON]
    for name in own:
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, metavar="N")
    options = parser.parse_args()
    try:
        result = study.run(full=options.full, seed=options.seed, **{name: getattr(options, name) for name in own})
        finish(result, options.out)
    except ConfigError as error:
        print(f"{study.NAME}: error: {error}", file=sys.stderr)
        return 2
    return 0


def finish(result: StudyResult, out: Path | None) -> None:
    """Prints a result and writes its files, where there is a folder for them."""
    for table in result.tables:
        print(f"\n{table.title}\n\n{text_of(table)}\n")
        if table.note:
            print(table.note)
    if result.comparisons:
        rows = [{"" if key == "what" else key: value for key, value in asdict(c).items()} for c in result.comparisons]
        print(f"\nBeside the paper\n\n{text_of(Table('', '', rows))}\n")
    for statement in result.statements:
        print(f"- {statement}")
    for path in result.save(out) if out else ():
        print(path)


def text_of(table: Table) -> str:
    """The table as Markdown."""
    cells = [table.columns] + [[cell(row[column]) for column in table.columns] for row in table.rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(table.columns))]
    lines = ["| " + " | ".join(text.ljust(w) for text, w in zip(line, widths, strict=True)) + " |" for line in cells]
    return "\n".join([lines[0], "| " + " | ".join("-" * w for w in widths) + " |", *lines[1:]])

"""The report of the studies: one HTML file that needs no other, for a desk's screen and a phone's."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from torchpose.config import MOST_TABLE_BYTES, parse_mapping, read_text
from torchpose.io.rows import Row

_PAGE = Path(__file__).with_name("study_report.html")  # beside it, as .css, its style
_SHOWN_ROWS = 24  # of a table; longer ones fold
_LONG = 20  # letters, from which on a cell may break


def report(folders: Sequence[Path], failed: dict[str, str], environment: dict[str, str]) -> str:
    """The report as a text of HTML.

    Args:
        folders: of studies, as `torchpose.studies.study.StudyResult.save` wrote them, in the order of the report.
        failed: studies that ended with an error, and the error.
        environment: names and versions of what the figures depend on.
    """
    records = [(folder, parse_mapping(read_text(folder / "result.json", most=MOST_TABLE_BYTES))) for folder in folders]
    return Template(_PAGE.read_text(encoding="utf-8")).substitute(
        style=_PAGE.with_suffix(".css").read_text(encoding="utf-8"),
        kind="full" if any(r["full"] for _, r in records) else "quick",
        links="".join(f'<a href="#{escape(r["study"])}">{escape(_short(r))}</a>' for _, r in records),
        problems="".join(
            f'<p class="failed">{escape(name)} was not computed: {escape(why)}</p>' for name, why in failed.items()
        ),
        summary=_summary([record for _, record in records]),
        sections="".join(_section(folder, record) for folder, record in records),
        environment=_environment([record for _, record in records], environment),
    )


def _short(record: Row) -> str:
    return str(record["title"].split(":")[0])


def _summary(records: list[Row]) -> str:
    rows = [
        {"": _short(r), "quantity": c["what"]} | {key: c[key] for key in ("unit", "paper", "ours", "bound")}
        for r in records
        for c in r["comparisons"]
    ]
    return f'<section id="summary"><h2>Paper, ours, bound</h2>{_table(rows, fold=False)}</section>' if rows else ""


def _section(folder: Path, record: Row) -> str:
    parts = [f"<h2>{escape(record['title'])}</h2>"]
    if record["statements"]:
        parts.append("<ul>" + "".join(f"<li>{escape(s)}</li>" for s in record["statements"]) + "</ul>")
    for picture in record["pictures"]:
        pixels = base64.b64encode((folder / f"{picture['name']}.png").read_bytes()).decode("ascii")
        title = escape(picture["title"])
        image = f'<img src="data:image/png;base64,{pixels}" alt="{title}" loading="lazy">'
        caption = f"{title}. {escape(picture['note'])}".rstrip()
        parts.append(f"<figure>{image}<figcaption>{caption}</figcaption></figure>")
    for table in record["tables"]:
        note = f'<p class="soft">{escape(table["note"])}</p>' if table["note"] else ""
        parts.append(f"<h3>{escape(table['title'])}</h3>{_table(table['rows'])}{note}")
    settings = "".join(f", {key} {escape(cell(value))}" for key, value in record["settings"].items())
    parts.append(f'<p class="soft">Settings: seed {record["seed"]}{settings}.</p>')
    return f'<section id="{escape(record["study"])}">{"".join(parts)}</section>'


def _table(rows: list[Row], fold: bool = True) -> str:
    if not rows:
        return '<p class="soft">No rows.</p>'
    classes = {column: _class(column, rows) for column in rows[0]}
    head = "".join(f"<th{kind}>{escape(column.replace('_', ' '))}</th>" for column, kind in classes.items())
    body = "".join(
        f"<tr>{''.join(_data(column, kind, row[column]) for column, kind in classes.items())}</tr>" for row in rows
    )
    table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    if fold and len(rows) > _SHOWN_ROWS:
        return f"<details><summary>{len(rows)} rows</summary>{table}</details>"
    return table


def _data(column: str, kind: str, value: Any) -> str:
    """One cell; the name of its column stands in it too, for narrow screens, where every row is a list."""
    name = f' data-name="{escape(column.replace("_", " "))}"' if column else ""
    return f"<td{kind}{name}>{escape(cell(value))}</td>"


def _class(column: str, rows: list[Row]) -> str:
    """Classes of a column's cells, by the length of its longest text; numbers have none."""
    longest = max((len(row[column]) for row in rows if isinstance(row[column], str)), default=0)
    names = ["text"] * (longest > 0) + ["long"] * (longest > _LONG) + ["ours"] * (column == "ours")
    return f' class="{" ".join(names)}"' if names else ""


def cell(value: Any) -> str:
    """A value as a reader wants it: four digits, nothing for None and not a number."""
    if value is None or value != value:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _environment(records: list[Row], environment: dict[str, str]) -> str:
    versions = [{"package": name, "version": value} for name, value in environment.items()]
    times = [{"study": r["title"]} | {key: round(r[key], 1) for key in ("seconds", "cpu_seconds")} for r in records]
    return (
        '<section id="environment"><h2>Versions and times</h2>'
        f"{_table(times, fold=False)}{_table(versions, fold=False)}</section>"
    )

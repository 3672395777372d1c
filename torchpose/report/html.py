"""The report of the studies: one HTML file that needs no other, for a desk's screen and a phone's."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

_STYLE = """
:root { color-scheme: light; --ink: #1b1f24; --soft: #5b6470; --line: #d9dee4; --tint: #f5f7f9; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: var(--ink);
       background: #fff; }
main, header { max-width: 72rem; margin: 0 auto; padding: 0 1rem; }
header { padding-top: 2rem; }
h1 { font-size: 1.8rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.3rem; margin: 0 0 .5rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; }
section { border-top: 1px solid var(--line); padding: 2rem 0 1rem; scroll-margin-top: 1rem; }
p, ul { max-width: 48rem; }
.soft { color: var(--soft); font-size: .9rem; }
nav { display: flex; flex-wrap: wrap; gap: .4rem .9rem; margin: 1rem 0 2rem; }
a { color: var(--accent); }
.wide { overflow-x: auto; margin: .5rem 0; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th { background: var(--tint); font-weight: 600; }
td.text, th.text { text-align: left; }
td.long, th.long { white-space: normal; min-width: 9rem; }
tr:last-child td { border-bottom: 0; }
td.ours { font-weight: 600; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; border: 1px solid var(--line); border-radius: 6px; }
figcaption { color: var(--soft); font-size: .9rem; max-width: 48rem; }
.failed { background: #fdecea; border-left: 4px solid #b3261e; padding: .6rem 1rem; }
details { margin: .5rem 0; }
summary { cursor: pointer; color: var(--accent); }
@media (max-width: 40rem) { body { font-size: 15px; } h1 { font-size: 1.45rem; } th, td { padding: .3rem .5rem; } }
@media print { nav { display: none; } section { break-inside: avoid-page; } }
"""
_SHOWN_ROWS = 24  # of a table; longer ones fold
_LONG = 20  # letters, from which on a cell may break


def report(folders: Sequence[Path], failed: dict[str, str], environment: dict[str, str]) -> str:
    """The report as a text of HTML.

    Args:
        folders: of studies, as `torchpose.studies.study.StudyResult.save` wrote them, in the order of the report.
        failed: studies that ended with an error, and the error.
        environment: names and versions of what the figures depend on.
    """
    records = [(folder, json.loads((folder / "result.json").read_text(encoding="utf-8"))) for folder in folders]
    links = "".join(f'<a href="#{escape(r["study"])}">{escape(r["title"].split(":")[0])}</a>' for _, r in records)
    problems = "".join(
        f'<p class="failed">{escape(name)} was not computed: {escape(reason)}</p>' for name, reason in failed.items()
    )
    sections = "".join(_section(folder, record) for folder, record in records)
    kind = "full" if any(r["full"] for _, r in records) else "quick"
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>torchpose: the paper reproduced</title><style>{_STYLE}</style></head><body>
<header><h1>torchpose: the paper reproduced</h1>
<p>Every table and figure of the paper on pose estimation from concentric rings, computed by one {kind} run of
<code>torchpose reproduce</code>. Our figure stands beside the paper's and, where there is one, beside the
Cram&eacute;r-Rao bound, which no unbiased method can beat.</p>
<nav>{links}<a href="#environment">Versions and times</a></nav></header>
<main>{problems}{_summary(records)}{sections}{_environment(records, environment)}</main></body></html>
"""


def _summary(records: list[tuple[Path, dict[str, Any]]]) -> str:
    rows = [
        {"": r["title"].split(":")[0], "quantity": c["what"], "unit": c["unit"]}
        | {"paper": c["paper"], "ours": c["ours"], "bound": c["bound"]}
        for _, r in records
        for c in r["comparisons"]
    ]
    if not rows:
        return ""
    return f'<section id="summary"><h2>Paper, ours, bound</h2>{_table(rows, fold=False)}</section>'


def _section(folder: Path, record: dict[str, Any]) -> str:
    parts = [f"<h2>{escape(record['title'])}</h2>"]
    if record["statements"]:
        parts.append("<ul>" + "".join(f"<li>{escape(s)}</li>" for s in record["statements"]) + "</ul>")
    for picture in record["pictures"]:
        pixels = base64.b64encode((folder / f"{picture['name']}.png").read_bytes()).decode("ascii")
        caption = " ".join(filter(None, (escape(picture["title"]) + ".", escape(picture["note"]))))
        image = f'<img src="data:image/png;base64,{pixels}" alt="{escape(picture["title"])}" loading="lazy">'
        parts.append(f"<figure>{image}<figcaption>{caption}</figcaption></figure>")
    for table in record["tables"]:
        note = f'<p class="soft">{escape(table["note"])}</p>' if table["note"] else ""
        parts.append(f"<h3>{escape(table['title'])}</h3>{_table(table['rows'])}{note}")
    settings = ", ".join(f"{key} {_cell(value)}" for key, value in record["settings"].items())
    parts.append(f'<p class="soft">Settings: seed {record["seed"]}{", " + settings if settings else ""}.</p>')
    return f'<section id="{escape(record["study"])}">{"".join(parts)}</section>'


def _table(rows: list[dict[str, Any]], fold: bool = True) -> str:
    if not rows:
        return '<p class="soft">No rows.</p>'
    columns = list(rows[0])
    text = {c: max((len(row[c]) for row in rows if isinstance(row[c], str)), default=0) for c in columns}
    head = "".join(f"<th{_class(c, text)}>{escape(c.replace('_', ' '))}</th>" for c in columns)
    body = "".join(
        "<tr>" + "".join(f"<td{_class(c, text)}>{_cell(row[c])}</td>" for c in columns) + "</tr>" for row in rows
    )
    table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    if fold and len(rows) > _SHOWN_ROWS:
        return f"<details><summary>{len(rows)} rows</summary>{table}</details>"
    return table


def _class(column: str, text: dict[str, int]) -> str:
    """Classes of a column's cells, by the length of its longest text; numbers have none."""
    names = [
        name
        for name, holds in (("text", text[column]), ("long", text[column] > _LONG), ("ours", column == "ours"))
        if holds
    ]
    return f' class="{" ".join(names)}"' if names else ""


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))


def _environment(records: list[tuple[Path, dict[str, Any]]], environment: dict[str, str]) -> str:
    versions = [{"package": name, "version": value} for name, value in environment.items()]
    times = [
        {"study": r["title"], "seconds": round(r["seconds"], 1), "cpu_seconds": round(r["cpu_seconds"], 1)}
        for _, r in records
    ]
    return (
        '<section id="environment"><h2>Versions and times</h2>'
        f"{_table(times, fold=False)}{_table(versions, fold=False)}</section>"
    )

"""All studies in one report: failures, resumption, what the report holds. With small studies in their place."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from torchpose.errors import ConfigError
from torchpose.report.figures import subplots
from torchpose.studies import reproduce as module
from torchpose.studies.study import Comparison, Picture, StudyResult, Table


def small(name: str, calls: list[str], error: Exception | None = None) -> ModuleType:
    study = ModuleType(f"torchpose.studies.{name}")

    def run(*, full: bool, seed: int, progress: Callable[..., Any]) -> StudyResult:
        calls.append(name)
        if error:
            raise error
        progress(0.5)
        figure, ((axis,),) = subplots(1, 1, (3, 2))
        axis.plot([0, 1])
        rows: list[dict[str, Any]] = [
            {"noise": n, "error_px": float("nan") if n == 0 else 0.1234567 * n, "kind": "a<b"} for n in range(30)
        ]
        return StudyResult(
            [Table("rows", "Thirty rows", rows, "a note")],
            [Picture("plot", "A plot", figure)],
            [Comparison("error & more", "px", 0.5, 0.25, 0.125)],
            ["A statement."],
            {"frames": 3},
        )

    vars(study).update(NAME=name, TITLE=f"{name.capitalize()}: title", run=run)
    return study


@pytest.fixture
def studies(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    calls: list[str] = []
    names = ("one", "broken", "two")
    for name in names:
        error = ZeroDivisionError("by zero") if name == "broken" else None
        monkeypatch.setitem(sys.modules, f"torchpose.studies.{name}", small(name, calls, error))
    monkeypatch.setattr(module, "STUDIES", names)
    return calls


def test_every_study_is_run_and_a_failure_is_reported_without_holding_up_the_others(
    tmp_path: Path, studies: list[str]
) -> None:
    told = []
    failed = module.reproduce(tmp_path / "out", seed=3, progress=lambda name, done: told.append((name, done)))
    assert studies == ["one", "broken", "two"]
    assert failed == {"broken": "ZeroDivisionError: by zero"}
    assert "ZeroDivisionError" in (tmp_path / "out" / "broken" / "error.txt").read_text()
    assert ("two", 0.5) in told
    record = json.loads((tmp_path / "out" / "one" / "result.json").read_text())
    assert record["tables"][0]["rows"][0]["error_px"] is None  # JSON has no NaN
    assert record["seed"] == 3
    text = (tmp_path / "out" / "report.html").read_text()
    assert "broken was not computed: ZeroDivisionError: by zero" in text
    assert "error &amp; more" in text
    assert "a&lt;b" in text
    assert "0.1235" in text


def test_the_report_needs_no_other_file_and_its_tags_match(tmp_path: Path, studies: list[str]) -> None:
    module.reproduce(tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', text)
    assert text.count("data:image/png;base64,") == 2
    stack: list[str] = []

    class Tags(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            if tag not in ("meta", "img", "br"):
                stack.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert stack.pop() == tag

    Tags().feed(text)
    assert stack == []


def test_resume_keeps_what_is_finished_with_the_same_settings(tmp_path: Path, studies: list[str]) -> None:
    module.reproduce(tmp_path)
    studies.clear()
    module.reproduce(tmp_path, resume=True)
    assert studies == ["broken"]
    studies.clear()
    module.reproduce(tmp_path, resume=True, seed=1)
    assert studies == ["one", "broken", "two"]
    studies.clear()
    module.reproduce(tmp_path, only=["two"])
    assert studies == ["two"]
    assert 'id="one"' in (tmp_path / "report.html").read_text()


def test_unknown_studies_and_places_that_cannot_be_written_are_refused(tmp_path: Path, studies: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"table99: --only: is no study; give one of one, broken, two"):
        module.reproduce(tmp_path, only=["table99"])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out"):
        module.reproduce(tmp_path / "file", only=["one"])

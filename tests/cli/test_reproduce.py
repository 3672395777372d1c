from __future__ import annotations

from pathlib import Path

import pytest

from torchpose.cli.main import main


def run(*arguments: str) -> str | int | None:
    with pytest.raises(SystemExit) as end:
        main(["reproduce", *arguments])
    return end.value.code


def test_one_study_as_a_user_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "report"
    assert run("--out", str(out), "--only", "fig07_subpixel") == 0
    assert capsys.readouterr().out.strip() == str(out / "report.html")
    assert "Fig. 7" in (out / "report.html").read_text()
    for name in ("fig07.csv", "fig07.png", "fig08.png", "result.json"):
        assert (out / "fig07_subpixel" / name).stat().st_size > 0


def test_mistakes_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--out", str(tmp_path), "--only", "table99") == 2
    assert capsys.readouterr().err.startswith("torchpose: error: table99: --only: is no study; give one of fig02_pnp")
    (tmp_path / "file").write_text("")
    assert run("--out", str(tmp_path / "file"), "--only", "fig07_subpixel") == 2
    assert "--out" in capsys.readouterr().err
    assert run() == 2

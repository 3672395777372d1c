"""What README.md shows works: its Python, its files, its options, its links."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

import torchpose as tp
from torchpose.cli.main import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(language: str) -> list[str]:
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", README, re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", body, flags=re.MULTILINE) for indent, body in found]


def test_python_runs() -> None:
    (code,) = blocks("python")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" OK [") == 4


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for body in blocks("yaml"):
        (tmp_path / body.split()[1]).write_text(body, encoding="utf-8")
    return tmp_path


def test_files_load(files: Path) -> None:
    camera = tp.Camera.load(files / "camera.yaml")
    assert (camera.width, camera.height) == (1824, 1216)
    assert camera.distortion.tolist() == [-0.08, 0.02, 0.0002, -0.00015]
    target = tp.Target.load(files / "target.yaml")
    assert (target.name, target.ids.tolist()) == ("plate", [0, 1, 2, 3])
    assert target.part_translation is not None
    assert target.part_translation.tolist() == [0, 0, 4.2]
    assert tp.HandEye.load(files / "handeye.yaml").mount == "base"


def test_built_in_targets_are_all_named() -> None:
    for path in (ROOT / "torchpose" / "targets").glob("*.yaml"):
        assert f"`{path.stem}`" in README


def commands() -> dict[str, Any]:
    group: Any = typer.main.get_command(app)
    return dict(group.commands)


def test_options_exist() -> None:
    estimate = commands()["estimate"]
    options = {name for parameter in estimate.params for name in parameter.opts}
    section = README[README.index("## Your own images") : README.index("### Other commands")]
    named = set(re.findall(r"(?<![\w-])--[a-z-]+", section)) - {"--help"}
    assert {"--camera", "--resume", "--hand-eye"} <= named <= options


def test_other_commands_exist_with_their_options() -> None:
    found = commands()
    section = README[README.index("### Other commands") : README.index("### How a pose")]
    lines = re.findall(r"`torchpose (\w+)([^`]*)`", section)
    assert {name for name, _ in lines} == set(found) - {"estimate"}
    for name, usage in lines:
        options = {option for parameter in found[name].params for option in parameter.opts}
        assert set(re.findall(r"--[a-z-]+", usage)) <= options


def test_statuses_and_reasons_are_all_explained() -> None:
    table = README[README.index("### How a pose") : README.index("## Library")]
    assert set(re.findall(r"`(\w+)`", table)) >= {status.name.lower() for status in tp.Status}
    reasons = {reason.name.lower() for reason in tp.Reason} - {"none", "two_solutions"}  # the latter is `ambiguous`
    assert set(re.findall(r"`(\w+)`", table)) >= reasons


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert "://" in link or (page.parent / link).exists(), link


def test_layout_names_every_part() -> None:
    layout = README[README.index("## Layout") : README.index("Imports point one way")]
    parts = [path for path in (ROOT / "torchpose").iterdir() if not path.name.startswith("_")]
    stages = {f"{path.name}/" for path in parts if (path / "__init__.py").exists()}
    helpers = {"errors.py", "config.py"}
    modules = {path.name for path in parts if path.suffix == ".py"} - helpers
    assert set(re.findall(r"`([\w.]+/?)`", layout)) >= stages | modules


@pytest.mark.parametrize("record", sorted((ROOT / "docs" / "decisions").glob("0*.md")), ids=lambda path: str(path.stem))
def test_records_have_a_date_and_a_status_and_are_listed(record: Path) -> None:
    title, _, date, status = record.read_text(encoding="utf-8").splitlines()[:4]
    assert title.startswith(f"# {record.name[:4]} ")
    assert re.fullmatch(r"- Date: \d{4}-\d\d-\d\d", date)
    assert status.startswith("- Status: ")
    listed = (ROOT / "docs" / "decisions" / "README.md").read_text(encoding="utf-8")
    row = f"| [{record.name[:4]}]({record.name}) | "
    assert any(
        line.startswith(row) and line.endswith(f" | {date[8:]} | {status[10:]} |") for line in listed.splitlines()
    )

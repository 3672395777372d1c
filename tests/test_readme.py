"""What README.md and the pages that it leads to say is so: files, options, commands, statuses, links, layout.

Their commands and Python run in `tests/docs/test_snippets.py`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
import typer

import torchpose as tp
from torchpose.cli.main import app
from torchpose.results import Misfit

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


TASKS = {name: page(f"tasks/{name}.md") for name in ("estimate", "statuses", "handeye", "camera", "target")}


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for text in (TASKS["camera"], TASKS["estimate"], TASKS["handeye"]):
        for body in re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
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
        assert f"`{path.stem}`" in TASKS["estimate"]
        assert f"`{path.stem}`" in TASKS["target"]


def commands() -> dict[str, Any]:
    group: Any = typer.main.get_command(app)
    return dict(group.commands)


def test_options_exist() -> None:
    estimate = commands()["estimate"]
    options = {name for parameter in estimate.params for name in parameter.opts}
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", TASKS["estimate"])) - {"--help"}
    assert {"--camera", "--resume", "--hand-eye"} <= named <= options


def test_commands_are_all_named() -> None:
    table = README[README.index("## Commands") : README.index("## Limits")]
    assert re.findall(r"^\| `torchpose (\w+)`", table, re.MULTILINE) == unique(table)
    assert set(unique(table)) == set(commands())


def unique(table: str) -> list[str]:
    return list(dict.fromkeys(re.findall(r"`torchpose (\w+)", table)))


def test_statuses_and_reasons_are_all_explained() -> None:
    table = TASKS["statuses"]
    assert set(re.findall(r"`(\w+)`", table)) >= {status.name.lower() for status in tp.Status}
    reasons = {reason.name.lower() for reason in tp.Reason} - {"none"}
    misfits = {misfit.name.lower() for misfit in Misfit} - {"none"}
    assert set(re.findall(r"`(\w+)`", table)) >= reasons | misfits
    # of files: every word that the readers of pictures have
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "torchpose" / "io").rglob("*.py")]
    words = {word for text in sources for word in re.findall(r'UnreadableImageError\("(\w+)"\)', text)}
    assert words >= {"corrupt", "truncated", "missing"}
    assert set(re.findall(r"`(\w+)`", page("pictures.md"))) >= words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    made = {"commands.md", "api"}  # by scripts/site_hooks.py; tests/docs/test_site.py looks at the links of the site
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        place = Path(os.path.normpath(page.parent / link))
        is_made = place.is_relative_to(ROOT / "docs") and place.relative_to(ROOT / "docs").parts[0] in made
        assert "://" in link or is_made or place.exists(), link


def test_layout_names_every_part() -> None:
    layout = page("layout.md").split("Imports point one way")[0]
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

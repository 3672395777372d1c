"""What the documentation shows works: its commands, its Python, its files, page by page, as a reader would type them.

Pages that lead a reader (the tutorial, tasks, explanations) run as they stand, block after block in one folder. Of all
other pages every command line has to be one that the program takes.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from torchpose.cli.main import app, main

ROOT = Path(__file__).parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
RUN = [ROOT / "docs" / "tutorial.md", *sorted((ROOT / "docs" / "tasks").glob("*.md"))]
RUN += [*sorted((ROOT / "docs" / "explain").glob("*.md")), ROOT / "docs" / "kornia.md", ROOT / "docs" / "prints.md"]
SLOW = {"tutorial.md", "target.md", "kornia.md", "limits.md", "prints.md"}  # calibrate, design, or measure many frames
GIVEN = {  # what the text around a page's blocks says is there already
    "prints.md": """
import cv2, torch
import torchpose as tp
targets = [tp.Target.load("quad40"), tp.Target.load("hexa50")]
estimator = tp.PoseEstimator(tp.Camera.load("data/sample/camera.yaml"), targets)
names = [f"data/sample/frames/{k:03d}.png" for k in range(2)]
poses = estimator(torch.stack([torch.from_numpy(cv2.imread(name, cv2.IMREAD_GRAYSCALE)) for name in names]))
i, j = 0, 2
"""
}
SHELL = {"|", ">", ">>", "<", "&&", "&", ";", "2>"}  # what ends the words of a command
BLOCK = re.compile(r"^( *)```(\w+)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of the fenced blocks of a page, in order, those in boxes and lists too."""
    for indent, language, body in BLOCK.findall(page.read_text(encoding="utf-8")):
        yield language, re.sub(rf"^{indent}", "", body, flags=re.MULTILINE)


def command_lines(text: str, program: str) -> list[list[str]]:
    """Words of every line that calls a program, in fenced and in indented blocks; continued lines are one."""
    found = re.findall(rf"^ *{program}((?: [^\n]*)?)$", re.sub(r"\\\n\s*", " ", text), re.MULTILINE)
    words = [shlex.split(line, comments=True) for line in found]
    return [list(takewhile(lambda word: word not in SHELL, line)) for line in words]


def of_torchpose(page: Path) -> list[list[str]]:
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))
    fenced = [re.sub(r"\\\n\s*", " ", body) for language, body in blocks(page) if language == "sh"]
    indented = re.findall(r"^ {4}(torchpose [a-z].*)$", BLOCK.sub("", text), re.MULTILINE)
    return command_lines("\n".join([*fenced, *indented]), "torchpose")


WITH_COMMANDS = [page for page in PAGES if of_torchpose(page)]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=named)
def test_commands_are_commands_of_the_program(page: Path) -> None:
    group: Any = typer.main.get_command(app)
    for words in of_torchpose(page):
        if words == ["--version"]:
            continue
        name, *arguments = words
        group.commands[name].make_context(name, arguments)  # raises where an option or its value is none


def test_pages_with_commands_are_looked_at() -> None:
    assert {"docs/tutorial.md", "docs/calibration.md", "README.md", "docs/rig.md"} <= {named(p) for p in WITH_COMMANDS}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_scripts_exist_with_their_options(page: Path) -> None:
    """Of `python scripts/NAME.py ...` and `bash scripts/NAME.sh`, wherever a page has them."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"scripts/(\w+\.(?:py|sh))", text):
        assert (ROOT / "scripts" / name).exists() or "decisions" in named(page), name
    for name, usage in re.findall(r"python scripts/(\w+)\.py([^\n`#]*)", text):
        source = (ROOT / "scripts" / f"{name}.py").read_text() + (ROOT / "torchpose/studies/script.py").read_text()
        known = set(re.findall(r"--[a-z][a-z-]*", source))
        known |= {f"--{word.replace('_', '-')}" for word in re.findall(r"\b[a-z_]+(?=:)", source)}
        assert set(re.findall(r"--[a-z][a-z-]*", usage)) <= known, f"{name}: {usage}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_blocks_can_be_read(page: Path) -> None:
    for language, body in blocks(page):
        if language == "python":
            compile(body, named(page), "exec")
        elif language == "yaml":
            yaml.safe_load(re.sub(r"\{\.\.\.\}", "{}", body))


@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=pytest.mark.slow) if p.name in SLOW else p for p in RUN], ids=named
)
def test_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are written, commands and Python run, in the order of the page."""
    for name in ("data", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    for language, body in blocks(page):
        if language == "yaml" and (file := re.match(r"# (\S+\.yaml)\n", body)):
            (tmp_path / file[1]).write_text(body, encoding="utf-8")
        elif language == "python":
            exec(compile(GIVEN.get(page.name, "") + body, named(page), "exec"), {"__name__": "__main__"})
        elif language == "sh":
            for words in command_lines(body, "torchpose"):
                with pytest.raises(SystemExit) as ended:
                    main(words)
                assert ended.value.code == 0, words

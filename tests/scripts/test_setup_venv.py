"""Making the environment: what is missing is told in one line, before anything is written."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    return tmp_path


def run(checkout: Path, python: Path) -> subprocess.CompletedProcess[str]:
    script = checkout / "scripts" / "run_sample.sh"
    environment = os.environ | {"PYTHON": str(python)}
    return subprocess.run(["bash", str(script)], cwd="/", env=environment, capture_output=True, text=True)


def fake_python(checkout: Path, body: str) -> Path:
    path = checkout / "python"
    path.write_text(f"#!/bin/sh\n{body}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("exit 1", "is not Python 3.11 or newer"),
        ('case "$*" in *ensurepip*) exit 1;; esac', "apt install python3-venv"),
    ],
    ids=["old", "no venv"],
)
def test_unsuitable_python(checkout: Path, body: str, message: str) -> None:
    done = run(checkout, fake_python(checkout, body))
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (checkout / ".venv").exists()


def test_missing_python(checkout: Path) -> None:
    done = run(checkout, checkout / "nowhere")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {checkout / 'nowhere'}: is not Python 3.11 or newer")

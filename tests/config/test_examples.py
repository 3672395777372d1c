"""Examples come with the package: by name, by copy, and in wheel and sdist."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.config.examples import EXAMPLES, KINDS, example
from torchpose.datasets.plan import load_plan
from torchpose.rig.plan import load_plan as load_capture_plan
from torchpose.rig.settings import load_rig
from torchpose.rig.twin.scene import Scene

ROOT = Path(__file__).parents[2]


def test_loaders_take_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Camera.load("acA5472_8mm_third").width == 1824
    assert len(load_plan("paper_grid")) == 875
    assert len(load_capture_plan("calibration_plan").waypoints) == 36
    assert load_rig("ur5_2mp") == load_rig(ROOT / "configs/rig/ur5_2mp.yaml")
    assert Scene.load("twin_2mp").target.name
    # a file of that name goes first, and a path is never an example
    Path("random").write_text("x")
    assert example("random", "plans") == Path("random")
    assert example("plans/random", "plans") == Path("plans/random")


def test_the_command_lists_and_copies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*words: str) -> tuple[object, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["examples", *words])
        printed = capsys.readouterr()
        return end.value.code, printed.out, printed.err

    code, out, _ = run("list")
    assert code == 0
    assert out.split() == [f"{kind}/{p.stem}" for kind in KINDS for p in sorted((EXAMPLES / kind).glob("*.yaml"))]
    assert run("list", "plans/random")[1] == "plans/random\n"
    folder = tmp_path / "new"
    assert run("copy", "-o", str(folder))[0] == 0
    copied = {path.relative_to(folder).as_posix() for path in folder.rglob("*.yaml")}
    assert copied == {f"{name}.yaml" for name in out.split()}
    assert len(load_plan(folder / "plans" / "paper_grid.yaml")) == 875  # finds the files that it names
    code, _, err = run("copy", "rig", "-o", str(folder))
    assert code == 2
    assert "is there already" in err
    assert "nothing: NAME: is no example" in run("copy", "nothing")[2]


def test_wheel_and_sdist_are_complete(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    kept = ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md")
    for name in kept:
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "torchpose", source / "torchpose", ignore=shutil.ignore_patterns("__pycache__"))
    build = "import setuptools.build_meta as b; b.build_wheel('out'); b.build_sdist('out')"
    (source / "out").mkdir()
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = (source / "out").glob("*.whl")
    (sdist,) = (source / "out").glob("*.tar.gz")
    files = {path.relative_to(source).as_posix() for path in (source / "torchpose").rglob("*") if path.is_file()}
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith("METADATA"))
        text = archive.read(metadata).decode()
    assert files - names == set()
    with tarfile.open(sdist) as archive_:
        packed = {name.partition("/")[2] for name in archive_.getnames()}
    assert (files | set(kept)) - packed == set()
    for minor in range(11, 15):
        assert f"Classifier: Programming Language :: Python :: 3.{minor}\n" in text

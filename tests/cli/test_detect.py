"""``torchpose detect`` on written pictures."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from torchpose.cli.main import main


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs the command in a folder of its own; gives the exit code and stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*words: str) -> tuple[str | int | None, str]:
        with pytest.raises(SystemExit) as ended:
            main(["detect", *map(str, words)])
        return ended.value.code, capfd.readouterr().err

    return call


def picture(width: int = 320, height: int = 240, ratio: float = 0.5) -> np.ndarray:
    frame = np.full((height, width), 210, np.uint8)
    cv2.circle(frame, (100 * 16 + 8, 90 * 16), 40 * 16, 40, -1, cv2.LINE_AA, 4)
    cv2.circle(frame, (100 * 16 + 8, 90 * 16), int(ratio * 40 * 16), 210, -1, cv2.LINE_AA, 4)
    cv2.fillPoly(frame, [np.array([[200, 140], [290, 150], [250, 215]])], 60, cv2.LINE_AA)
    return cv2.GaussianBlur(frame, (0, 0), 0.8)


def table(path: str) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_shapes_of_pictures_of_different_sizes(run: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "1.png"), picture())
    cv2.imwrite(str(tmp_path / "in" / "2.png"), picture(400, 300))
    cv2.imwrite(str(tmp_path / "in" / "10.png"), np.full((50, 60), 128, np.uint8))
    assert run("in", "--out", "shapes.csv", "--overlay", "seen") == (0, "")
    rows = table("shapes.csv")
    assert list(dict.fromkeys(row["frame"] for row in rows)) == ["1.png", "2.png"]
    header = ["frame", "kind", "cx", "cy", "a", "b", "theta", "arc", "log10_nfa", "polarity"]
    assert list(rows[0])[: len(header)] == header
    for name in ("1.png", "2.png"):
        mine = [row for row in rows if row["frame"] == name]
        assert [row["kind"] for row in mine] == ["ellipse", "ellipse", "polygon"]
        outer, inner, triangle = mine
        for row, radius, polarity in ((outer, 40, "1"), (inner, 20, "-1")):
            assert float(row["cx"]) == pytest.approx(100.5, abs=0.1)
            assert float(row["cy"]) == pytest.approx(90, abs=0.1)
            assert float(row["a"]) == pytest.approx(radius, abs=1.0)
            assert float(row["arc"]) == pytest.approx(2 * np.pi, abs=0.1)
            assert float(row["log10_nfa"]) < -20
            assert row["polarity"] == polarity
        assert float(outer["ring_ratio"]) == pytest.approx(0.5, abs=0.03)
        assert inner["ring_ratio"] == ""
        corners = np.array(triangle["vertices"].split(), float).reshape(-1, 2)
        for corner in ([200, 140], [290, 150], [250, 215]):
            assert np.linalg.norm(corners - corner, axis=1).min() < 4
    for name in ("1.png", "2.png", "10.png"):
        original = cv2.imread(str(tmp_path / "in" / name))
        seen = cv2.imread(str(tmp_path / "seen" / name))
        assert seen is not None
        assert original is not None
        assert seen.shape == original.shape


def test_explain_lists_the_rejected_with_reasons(run: Callable[..., Any], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    assert run("a.png", "--out", "plain.csv") == (0, "")
    assert run("a.png", "--out", "why.csv", "--explain", "--overlay", "seen") == (0, "")
    why = table("why.csv")
    assert {row["verdict"] for row in table("plain.csv")} == {"accepted"}
    assert [row for row in why if row["verdict"] == "accepted"] == table("plain.csv")
    assert {row["verdict"] for row in why} > {"accepted"}


def test_a_damaged_picture_is_reported_and_the_others_are_done(run: Callable[..., Any], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    (tmp_path / "b.png").write_bytes(b"no picture")
    code, error = run("a.png", "b.png", "--out", "shapes.jsonl")
    assert code == 1
    assert error.count("\n") == 1
    assert "b.png (not_an_image)" in error
    assert (tmp_path / "shapes.jsonl").read_text().count("\n") == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("missing.png", "--out", "s.csv"), "missing.png"),
        (("a.png", "--out", "s.txt"), "s.txt"),
        (("a.png",), "--out"),
        (("a.png", "--out", "s.csv", "--overlay", "a.png"), "a.png"),
    ],
)
def test_mistakes(run: Callable[..., Any], tmp_path: Path, words: tuple[str, str, str], named: str) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    code, error = run(*words)
    assert code == 2
    assert error.count("\n") == 1
    assert named in error

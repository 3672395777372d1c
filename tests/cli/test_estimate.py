"""``torchpose estimate`` as a user types it: rows, faults, exit codes, one clear line for every mistake."""

import csv
import json
import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.results import Poses
from torchpose.sim import add_noise, render
from torchpose.target import Target

WIDTH, HEIGHT = 640, 480
CAMERA = Camera(
    WIDTH,
    HEIGHT,
    torch.tensor([[1000.0, 0, 319.5], [0, 1000, 239.5], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([-0.1, 0.02, 0.0, 0.0, 0.0], dtype=torch.float64),
)
POSES = [
    ((0.10, -0.20, 0.3), (3.0, -2.0, 250.0)),
    ((-0.30, 0.10, -1.0), (-8.0, 5.0, 260.0)),
    ((0.05, 0.35, 2.0), (0.0, 0.0, 240.0)),
]
BASE_COLUMNS = [f"base_{c}" for c in ("tx", "ty", "tz", "rx", "ry", "rz", "sx", "sy", "sz", "srx", "sry", "srz")]


def png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture(scope="session")
def pictures() -> np.ndarray:
    """Frames (3, H, W) uint8 of quad40 at POSES."""
    rotation = rotations.exp(torch.tensor([r for r, _ in POSES], dtype=torch.float64))
    translation = torch.tensor([t for _, t in POSES], dtype=torch.float64)
    return add_noise(render(CAMERA, Target.load("quad40"), rotation, translation), 1.0).numpy()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs the command in a folder with camera.yaml; gives the exit code and what was printed on stderr."""
    monkeypatch.chdir(tmp_path)
    CAMERA.save("camera.yaml")

    def call(
        *words: str, camera: str = "camera.yaml", target: str = "quad40", out: str = "poses.csv"
    ) -> tuple[str | int | None, str]:
        options = ["--camera", camera, "--target", target, "--out", out, "--threads", "1"]
        with pytest.raises(SystemExit) as exit_:
            main(["estimate", *map(str, words), *options])
        captured = capfd.readouterr()
        assert captured.out == ""
        return exit_.value.code, without_note(captured.err)

    return call


def without_note(err: str) -> str:
    """What was printed, but for the note that the files of these tests state no uncertainty."""
    return "".join(line for line in err.splitlines(True) if "no uncertainty is stated" not in line)


def table(path: str = "poses.csv") -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def vector(row: dict[str, Any], *columns: str) -> np.ndarray:
    return np.array([float(row[c]) for c in columns])


def assert_near(row: dict[str, str], pose: tuple[tuple[float, float, float], tuple[float, float, float]]) -> None:
    """The row is the pose, to what these small frames allow."""
    (rotation, translation) = pose
    assert row["status"] == "ok"
    np.testing.assert_allclose(vector(row, "tx", "ty"), translation[:2], atol=0.02)
    np.testing.assert_allclose(float(row["tz"]), translation[2], atol=0.1)
    np.testing.assert_allclose(vector(row, "rx", "ry", "rz"), rotation, atol=2e-3)


def test_a_folder_gives_one_row_a_frame_in_natural_order(run: Callable[..., Any], pictures: np.ndarray) -> None:
    for i, picture in enumerate(pictures):
        png(Path(f"frames/f{i * 9 + 2}.png"), picture)  # 2, 11, 20
    assert run("frames", "--detections", "det.csv") == (0, "")
    rows = table()
    assert [row["frame"] for row in rows] == ["f2.png", "f11.png", "f20.png"]
    assert {row["target"] for row in rows} == {"quad40"}
    for row, pose in zip(rows, POSES, strict=True):
        assert_near(row, pose)
        assert row["markers"] == "4"
        assert row["reason"] == ""
        assert (vector(row, "sx", "sy", "sz", "srx", "sry", "srz") > 0).all()
    detections = table("det.csv")
    assert [(d["frame"], d["marker"]) for d in detections] == [(r["frame"], str(m)) for r in rows for m in range(4)]
    center = CAMERA.project(
        rotations.exp(torch.tensor(POSES[0][0], dtype=torch.float64)) @ Target.load("quad40").centers[3]
        + torch.tensor(POSES[0][1], dtype=torch.float64)
    )
    np.testing.assert_allclose(vector(detections[3], "u", "v"), center, atol=0.05)


def test_every_format_and_depth_gives_the_same_pose(run: Callable[..., Any], pictures: np.ndarray) -> None:
    grey = pictures[0]
    images = {
        "a8.png": grey,
        "b16.png": grey.astype(np.uint16) * 257,
        "c8.tif": grey,
        "d16.tiff": grey.astype(np.uint16) * 16,
        "e.bmp": grey,
        "f.pgm": grey,
        "g_colour.png": np.dstack([grey] * 3),
        "h_alpha.png": np.dstack([grey] * 3 + [grey]),
        "i_colour.jpg": np.dstack([grey] * 3),
    }
    for name, image in images.items():
        png(Path("frames") / name, image)
    assert run("frames") == (0, "")
    rows = table()
    assert [row["frame"] for row in rows] == list(images)
    for row in rows:
        assert_near(row, POSES[0])


def test_bad_files_have_rows_of_their_own_and_the_good_ones_beside_them_are_solved(
    run: Callable[..., Any], pictures: np.ndarray
) -> None:
    frames = Path("frames")
    for name in ("a.png", "z.jpg"):
        png(frames / name, pictures[0])
    whole = (frames / "a.png").read_bytes()
    jpeg = (frames / "z.jpg").read_bytes()
    (frames / "cut.png").write_bytes(whole[: len(whole) // 2])
    (frames / "cut_end.png").write_bytes(whole[:-12])
    (frames / "cut.jpg").write_bytes(jpeg[: len(jpeg) * 9 // 10])
    (frames / "damaged.png").write_bytes(whole[:20000] + bytes(8) + whole[20008:])
    (frames / "empty.tif").touch()
    (frames / "words.png").write_text("this is not an image")
    (frames / "folder.png").mkdir()
    (frames / "notes.txt").write_text("passed over")
    png(frames / "small.png", pictures[0][:100])
    png(frames / "turned.png", np.ascontiguousarray(pictures[0].T))
    code, error = run("frames", "--overlay", "overlays")
    assert code == 1
    assert error.count("\n") == 1
    assert error.startswith("torchpose: error: ")
    rows = {row["frame"]: row for row in table()}
    unreadable = {"cut.png", "cut_end.png", "cut.jpg", "damaged.png", "empty.tif", "words.png"}
    assert {name for name, row in rows.items() if row["status"] == "unreadable"} == unreadable
    assert "and 1 more" in error
    assert sum(name in error for name in unreadable) == 5
    assert {name: rows[name]["reason"] for name in ("small.png", "turned.png")} == {
        "small.png": "640x100",
        "turned.png": "480x640",
    }
    assert {rows[name]["status"] for name in ("small.png", "turned.png")} == {"wrong_size"}
    assert_near(rows["a.png"], POSES[0])
    assert_near(rows["z.jpg"], POSES[0])
    assert len(rows) == 10
    assert {p.name for p in Path("overlays").iterdir()} == {"a.png", "z.jpg.png"}


def test_a_wrong_size_alone_is_no_failure(run: Callable[..., Any]) -> None:
    png(Path("f/small.png"), np.zeros((10, 20), np.uint8))
    code, error = run("f")
    assert code == 0
    assert "no frame has the size of the camera file, 640x480: all frames are 20x10; give" in error
    assert error.count("\n") == 1
    (row,) = table()
    assert (row["status"], row["reason"], row["tx"], row["markers"]) == ("wrong_size", "20x10", "", "0")


@pytest.mark.parametrize("kind", ["black", "white", "noise", "noise16"])
def test_frames_without_a_target_say_so(run: Callable[..., Any], kind: str) -> None:
    generator = np.random.default_rng(0)
    images: dict[str, np.ndarray] = {
        "black": np.zeros((HEIGHT, WIDTH), np.uint8),
        "white": np.full((HEIGHT, WIDTH), 255, np.uint8),
        "noise": generator.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8),
        "noise16": generator.integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16),
    }
    png(Path("f/x.png"), images[kind])
    assert run("f") == (0, "")
    (row,) = table()
    assert row["status"] == "no_target"
    assert all(row[c] == "" for c in row if c not in ("frame", "target", "status", "markers", "reason", "instance"))


def test_several_targets_have_a_row_each(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    assert run("f", "--target", "hexa50") == (0, "")
    rows = table()
    assert [(row["frame"], row["target"]) for row in rows] == [("x.png", "hexa50"), ("x.png", "quad40")]
    assert_near(rows[1], POSES[0])
    assert rows[0]["status"] != "ok"


def test_jsonl_has_covariance_quaternion_and_solutions(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    png(Path("f/y.png"), np.zeros_like(pictures[0]))
    assert run("f", out="poses.jsonl") == (0, "")
    found, missing = [json.loads(line) for line in Path("poses.jsonl").read_text().splitlines()]
    covariance = np.array(found["covariance"])
    assert covariance.shape == (6, 6)
    np.testing.assert_allclose(np.sqrt(covariance.diagonal()), vector(found, "sx", "sy", "sz", "srx", "sry", "srz"))
    rotation = torch.from_numpy(vector(found, "rx", "ry", "rz"))
    np.testing.assert_allclose(found["quaternion"], rotations.quaternion(rotations.exp(rotation)), atol=1e-12)
    assert found["solutions"][0]["translation"] == [found[c] for c in ("tx", "ty", "tz")]
    assert missing["tx"] is None
    assert missing["covariance"] is None


def test_parquet_has_the_rows_of_the_csv_typed(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    (Path("f") / "y.png").touch()
    assert run("f")[0] == 1
    assert run("f", out="poses.parquet")[0] == 1
    typed = pq.read_table("poses.parquet").to_pylist()
    for text, row in zip(table(), typed, strict=True):
        assert {c: "" if row[c] is None else str(row[c]) for c in text} == text


def test_part_from_target_moves_the_rows_and_not_the_detections(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    text = Path("quad40.yaml")
    Target.load("quad40").save(text)
    text.write_text(text.read_text() + "part_from_target: {rotation: [0, 0, 1.5], translation: [10, 20, 30]}\n")
    run("f", "--detections", "a.csv")
    run("f", "--detections", "b.csv", target="quad40.yaml", out="part.csv")
    (target,), (part,) = table(), table("part.csv")
    r_target, r_part = (rotations.exp(torch.tensor(vector(row, "rx", "ry", "rz"))).numpy() for row in (target, part))
    turn = rotations.exp(torch.tensor([0, 0, 1.5], dtype=torch.float64)).numpy()
    np.testing.assert_allclose(r_part @ turn, r_target, atol=1e-9)
    origin = r_part @ [10, 20, 30] + vector(part, "tx", "ty", "tz")  # of the target, seen through the part
    np.testing.assert_allclose(origin, vector(target, "tx", "ty", "tz"), atol=1e-9)
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()


HAND_EYE = "{rotation: [0.3, -0.2, 2.0], translation: [700, -50, 900]}"


def base_pose(row: dict[str, str]) -> tuple[np.ndarray, np.ndarray]:
    return rotations.exp(torch.tensor(vector(row, "base_rx", "base_ry", "base_rz"))).numpy(), vector(
        row, *BASE_COLUMNS[:3]
    )


def test_hand_eye_adds_the_pose_in_the_robot_base(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    png(Path("f/y.png"), np.zeros_like(pictures[0]))
    Path("he.yaml").write_text(f"base_from_camera: {HAND_EYE}\n")
    assert run("f", "--hand-eye", "he.yaml") == (0, "")
    row, empty = table()
    assert list(row)[-12:] == BASE_COLUMNS
    turn = rotations.exp(torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)).numpy()
    rotation, translation = base_pose(row)
    np.testing.assert_allclose(translation, turn @ vector(row, "tx", "ty", "tz") + [700, -50, 900], atol=1e-9)
    camera = rotations.exp(torch.tensor(vector(row, "rx", "ry", "rz"))).numpy()
    np.testing.assert_allclose(rotation, turn @ camera, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(vector(row, *BASE_COLUMNS[6:9])), np.linalg.norm(vector(row, "sx", "sy", "sz"))
    )
    assert all(empty[c] == "" for c in BASE_COLUMNS)


def test_a_camera_on_the_tool_uses_the_robot_poses_of_the_manifest(
    run: Callable[..., Any], pictures: np.ndarray
) -> None:
    png(Path("run/i/7.png"), pictures[0])
    png(Path("run/i/3.png"), pictures[0])
    tools = {"7": [0.1, 0.2, 0.3, 0.5, 0, 0], "3": [-0.4, 0, 0.1, 0, 1.0, 0]}  # metres
    records: list[dict[str, Any]] = [{"record": "session", "units": {"length": "m"}}]
    records += [{"record": "frame", "id": i, "image": f"i/{i}.png", "robot_pose": tool} for i, tool in tools.items()]
    Path("run/manifest.jsonl").write_text("\n".join(map(json.dumps, records)) + '\n{"record": "fra')
    Path("he.yaml").write_text(f"tool_from_camera: {HAND_EYE}\n")
    assert run("run/manifest.jsonl", "--hand-eye", "he.yaml") == (0, "")
    rows = table()
    assert [row["frame"] for row in rows] == ["i/7.png", "i/3.png"]
    turn = rotations.exp(torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)).numpy()
    for row, tool in zip(rows, tools.values(), strict=True):
        in_tool = turn @ vector(row, "tx", "ty", "tz") + [700, -50, 900]
        expected = rotations.exp(torch.tensor(tool[3:], dtype=torch.float64)).numpy() @ in_tool + 1000 * np.array(
            tool[:3]
        )
        np.testing.assert_allclose(base_pose(row)[1], expected, atol=1e-9)

    code, error = run("run/i", "--hand-eye", "he.yaml")
    assert code == 2
    assert "robot_pose" in error


# --- mistakes ---

CAMERA_TEXT = "image_width: 640\nimage_height: 480\ncamera_matrix: {matrix}\ndistortion_coefficients: [0, 0, 0, 0]\n"
MATRIX = "[[1000, 0, 319.5], [0, 1000, 239.5], [0, 0, 1]]"
MARKER = "  - {{id: {0}, center: [{1}, {2}, 0], outer_radius: 5, inner_radius: {3}}}\n"
TARGET_HEAD = "name: t\nunits: mm\nbackground: light\nmarkers:\n"


def target_text(*markers: tuple[int, int, int, float], extra: str = "") -> str:
    return TARGET_HEAD + "".join(MARKER.format(*marker) for marker in markers) + extra


GOOD = ((0, -20, -20, 1.5), (1, 20, -20, 2), (2, 20, 20, 2.5), (3, -20, 20, 3))

# name: (words, named options, files to write, what the line must contain)
MISTAKES = {
    "missing input": (["gone"], {}, {}, "gone: INPUT"),
    "folder without images": (["empty"], {}, {"empty/notes.txt": ""}, "empty: INPUT"),
    "file of another kind": (["a.raw"], {}, {"a.raw": "x"}, "a.raw: INPUT"),
    "one file twice": (["f", "f/x.png"], {}, {}, "f/x.png: INPUT: is given twice"),
    "broken manifest": (["m.jsonl"], {}, {"m.jsonl": "{broken\n{}\n"}, "m.jsonl: line 1"),
    "unknown output type": (["f"], {"out": "poses.txt"}, {}, "poses.txt: --out"),
    "output is a folder": (["f"], {"out": "d.csv"}, {"d.csv/x": ""}, "d.csv: --out"),
    "output below a file": (["f"], {"out": "file/p.csv"}, {"file": ""}, "file/p.csv: --out"),
    "output unwritable": (["f"], {"out": "/proc/p.csv"}, {}, "/proc/p.csv: --out"),
    "output is the manifest": (
        ["m.jsonl"],
        {"out": "m.jsonl"},
        {"m.jsonl": '{"record": "frame", "id": 1, "image": "f/x.png"}\n'},
        "m.jsonl",
    ),
    "detections of unknown type": (["f", "--detections", "d.xls"], {}, {}, "d.xls: --detections"),
    "detections are the output": (["f", "--detections", "poses.csv"], {}, {}, "poses.csv: --detections"),
    "overlay inside the frames": (["f", "--overlay", "f/o"], {}, {}, "f/o: --overlay"),
    "overlay over the frames": (["f/x.png", "--overlay", "f"], {}, {}, "f: --overlay"),
    "overlay below a file": (["f", "--overlay", "file/o"], {}, {"file": ""}, "file/o: --overlay"),
    "no batch": (["f", "--batch", "0"], {}, {}, "--batch"),
    "unknown option": (["f", "--bogus"], {}, {}, "--bogus"),
    "camera missing": (["f"], {"camera": "no.yaml"}, {}, "no.yaml"),
    "camera not YAML": (["f"], {"camera": "c.yaml"}, {"c.yaml": "{a: [1, 2"}, "c.yaml"),
    "camera empty": (["f"], {"camera": "c.yaml"}, {"c.yaml": ""}, "c.yaml"),
    "camera is an image": (["f"], {"camera": "f/x.png"}, {}, "f/x.png"),
    "camera without matrix": (
        ["f"],
        {"camera": "c.yaml"},
        {"c.yaml": "image_width: 640\nimage_height: 480\n"},
        "camera_matrix",
    ),
    "camera with NaN": (
        ["f"],
        {"camera": "c.yaml"},
        {"c.yaml": CAMERA_TEXT.format(matrix=MATRIX.replace("319.5", ".nan"))},
        "camera_matrix",
    ),
    "camera with a negative focal length": (
        ["f"],
        {"camera": "c.yaml"},
        {"c.yaml": CAMERA_TEXT.format(matrix=MATRIX.replace("[[1000", "[[-1000"))},
        "camera_matrix",
    ),
    "camera of a list without such an entry": (["f"], {"camera": "camera.yaml#cam7"}, {}, "camera.yaml"),
    "target missing": (["f"], {"target": "no.yaml"}, {}, "no.yaml"),
    "target not built in": (["f"], {"target": "quad4000"}, {}, "quad4000"),
    "target with an unknown key": (
        ["f"],
        {"target": "t.yaml"},
        {"t.yaml": target_text(*GOOD, extra="colour: red\n")},
        "colour",
    ),
    "target with a duplicate id": (
        ["f"],
        {"target": "t.yaml"},
        {"t.yaml": target_text(*GOOD[:3], (0, -20, 20, 3))},
        "t.yaml: markers",
    ),
    "target with equal codes": (
        ["f"],
        {"target": "t.yaml"},
        {"t.yaml": target_text(*GOOD[:3], (3, -20, 20, 2.5))},
        "t.yaml: markers",
    ),
    "target with inner >= outer": (
        ["f"],
        {"target": "t.yaml"},
        {"t.yaml": target_text(*GOOD[:3], (3, -20, 20, 5))},
        "inner_radius",
    ),
    "target with two markers": (["f"], {"target": "t.yaml"}, {"t.yaml": target_text(*GOOD[:2])}, "t.yaml: markers"),
    "target with collinear markers": (
        ["f"],
        {"target": "t.yaml"},
        {"t.yaml": target_text((0, -20, 0, 1.5), (1, 0, 0, 2), (2, 20, 0, 2.5))},
        "t.yaml: markers",
    ),
    "target given twice": (["f", "--target", "quad40"], {}, {}, "quad40"),
    "hand-eye missing": (["f", "--hand-eye", "no.yaml"], {}, {}, "no.yaml"),
    "hand-eye without transform": (["f", "--hand-eye", "h.yaml"], {}, {"h.yaml": "a: 1\n"}, "h.yaml"),
    "resume without a record": (["f", "--resume"], {}, {"poses.csv": "frame\n"}, "poses.csv.run.json: --resume"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_clear_line_and_exit_code_2(run: Callable[..., Any], mistake: str) -> None:
    words, options, files, named = MISTAKES[mistake]
    png(Path("f/x.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    for name, text in files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    before = {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()}
    code, error = run(*words, **options)
    assert code == 2
    assert error.startswith("torchpose: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert named in error
    assert {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()} == before  # nothing made, nothing lost


def test_a_camera_of_another_image_size_gives_wrong_size_rows(run: Callable[..., Any], pictures: np.ndarray) -> None:
    png(Path("f/x.png"), pictures[0])
    Path("c.yaml").write_text(CAMERA_TEXT.format(matrix=MATRIX).replace("480", "500"))
    assert run("f", camera="c.yaml")[0] == 0
    (row,) = table()
    assert (row["status"], row["reason"]) == ("wrong_size", "640x480")


@pytest.mark.parametrize(
    ("words", "code", "shown"), [(["--version"], 0, "torchpose "), (["--help"], 0, "estimate"), ([], 2, "estimate")]
)
def test_version_and_help(capsys: pytest.CaptureFixture[str], words: list[str], code: int, shown: str) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(words)
    assert exit_.value.code == code
    assert shown in capsys.readouterr().out


def test_an_error_inside_is_reported_as_such_and_computed_rows_are_kept(
    run: Callable[..., Any], pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchpose.pipeline import PoseEstimator

    for i in range(6):
        png(Path(f"f/{i}.png"), pictures[i % 3])
    assert run("f", "--batch", "2", out="whole.csv") == (0, "")
    forward = PoseEstimator.forward
    calls: list[torch.Tensor] = []

    def fail_at_the_third(self: PoseEstimator, frames: torch.Tensor, *args: Any, **kwargs: Any) -> Poses:
        calls.append(frames)
        if len(calls) == 3:
            raise ZeroDivisionError("of all things")
        return forward(self, frames, *args, **kwargs)

    monkeypatch.setattr(PoseEstimator, "forward", fail_at_the_third)
    code, error = run("f", "--batch", "2")
    assert code == 70
    assert "torchpose: error: internal: ZeroDivisionError: of all things" in error
    assert not Path("poses.csv").exists()
    assert run("f", "--batch", "2", "--resume") == (0, "")
    assert len(calls) == 4
    assert Path("poses.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_resume_does_new_frames_only(
    run: Callable[..., Any], pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i in (1, 2):
        png(Path(f"f/{i}.png"), pictures[i])
    assert run("f", "--batch", "1", "--detections", "d.csv") == (0, "")
    png(Path("f/0.png"), pictures[0])
    from torchpose.pipeline import PoseEstimator

    forward, seen = PoseEstimator.forward, []

    def counted(self: PoseEstimator, frames: torch.Tensor) -> Poses:
        seen.append(len(frames))
        return forward(self, frames)

    monkeypatch.setattr(PoseEstimator, "forward", counted)
    assert run("f", "--batch", "1", "--detections", "d.csv", "--resume") == (0, "")
    assert seen == [1]
    resumed = Path("poses.csv").read_bytes(), Path("d.csv").read_bytes()
    assert run("f", "--batch", "1", "--detections", "d.csv") == (0, "")
    assert resumed == (Path("poses.csv").read_bytes(), Path("d.csv").read_bytes())
    assert run("f", "--batch", "1", "--detections", "d.csv", "--resume") == (0, "")  # nothing to do
    assert seen == [1, 1, 1, 1]
    assert resumed == (Path("poses.csv").read_bytes(), Path("d.csv").read_bytes())
    code, error = run("f", "--detections", "d.csv", "--resume", target="hexa50")
    assert (code, "--target" in error) == (2, True)


# --- processes that are ended from outside ---


FRAMES = 24
COMMAND = [sys.executable, "-m", "torchpose"]
OPTIONS = ["--camera", "camera.yaml", "--target", "quad40", "--threads", "1"]


# a run that is ended at a moment of its own: a process that watched it from outside would be late on a busy machine
ENDED = """
import os, signal, sys
from torchpose.cli.main import main
from torchpose.io.journal import Journal

lines, seconds, append = int(sys.argv.pop(1)), sys.argv.pop(1), Journal.append

def counted(journal, records):
    global lines
    places = append(journal, records)
    lines -= len(records)
    if lines <= 0 and seconds == "interrupt":
        os.kill(os.getpid(), signal.SIGINT)
    elif lines <= 0 and not signal.getitimer(signal.ITIMER_REAL)[0]:
        signal.setitimer(signal.ITIMER_REAL, float(seconds))  # its signal is not caught: the process is gone
    return places

Journal.append = counted
main()
"""


def start(*words: str, ended: tuple[str, str] | None = None) -> subprocess.Popen[str]:
    """A run; ended once it has written so many lines, by the terminal's ``interrupt`` or killed after some seconds."""
    begin = COMMAND if ended is None else [sys.executable, "-c", ENDED, *ended]
    command = [*begin, "estimate", "f", *OPTIONS, "--batch", "1", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    out, error = process.communicate(timeout=120)
    assert out == ""
    return process.returncode, error


@pytest.fixture
def many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: np.ndarray) -> None:
    """A folder of frames, one of them unreadable, one empty of targets."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    CAMERA.save("camera.yaml")
    for i in range(FRAMES):
        png(Path(f"f/{i}.png"), pictures[i % 3])
    Path("f/5.png").write_bytes(Path("f/5.png").read_bytes()[:5000])
    png(Path("f/15.png"), np.zeros_like(pictures[0]))


@pytest.mark.usefixtures("many")
def test_a_run_killed_again_and_again_and_resumed_gives_the_rows_of_an_undisturbed_one() -> None:
    assert finish(start("--out", "whole.csv", "--detections", "whole_det.csv"))[0] == 1
    chance = random.Random(3)
    journal = Path("poses.csv.partial")
    words = ["--out", "poses.csv", "--detections", "det.csv"]
    kills: list[Any] = []
    for _ in range(3):
        # two processes may be some rows ahead of the one that writes: once, so that rows are left for the others
        moment = str(chance.randint(2, 5)), str(chance.uniform(1e-6, 0.002))
        process = start(*words, *(["--resume"] if kills else ["--threads", "2"]), ended=moment)
        assert finish(process) == (-signal.SIGALRM, "")
        kills.append(journal.read_bytes().count(b"\n") - 1)
        assert not Path("poses.csv").exists()
    assert kills == sorted(kills)
    assert 0 < kills[0] < FRAMES
    code, error = finish(start(*words, "--resume"))
    assert code == 1
    assert "5.png" in error
    assert Path("poses.csv").read_bytes() == Path("whole.csv").read_bytes()
    assert Path("det.csv").read_bytes() == Path("whole_det.csv").read_bytes()
    assert [row["frame"] for row in table()] == [f"{i}.png" for i in range(FRAMES)]
    assert not journal.exists()


@pytest.mark.usefixtures("many")
def test_an_interrupted_run_says_how_to_go_on_and_prints_nothing_else() -> None:
    code, error = finish(start("--out", "poses.csv", "--threads", "2", ended=("3", "interrupt")))
    assert code == 130
    assert error.startswith("torchpose: error: interrupted: ")
    assert "--resume" in error
    assert error.count("\n") == 1
    code, error = finish(start("--out", "poses.csv", "--resume"))
    assert (code, without_note(error)) == (
        1,
        "torchpose: error: 5.png (truncated): INPUT: 1 could not be read; replace the files and run again\n",
    )
    assert [row["frame"] for row in table()] == [f"{i}.png" for i in range(FRAMES)]


@pytest.mark.usefixtures("many")
def test_a_full_disk_ends_in_one_line_and_loses_nothing() -> None:
    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (40000, 40000))

    process = subprocess.Popen(
        [*COMMAND, "estimate", "f", *OPTIONS, "--batch", "4", "--out", "poses.csv"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=small_files,
    )
    code, error = finish(process)
    assert code == 2
    assert error.startswith("torchpose: error: poses.csv.partial: --out: cannot be written (File too large)")
    assert error.count("\n") == 1
    assert Path("poses.csv.partial").read_bytes().count(b"\n") > 8
    assert finish(start("--out", "poses.csv", "--resume"))[0] == 1
    assert [row["frame"] for row in table()] == [f"{i}.png" for i in range(FRAMES)]


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
@pytest.mark.usefixtures("many")
def test_a_terminal_sees_progress_and_a_summary_unless_it_is_told_to_be_quiet() -> None:
    for words, loud in (([], True), (["--quiet"], False)):
        master, slave = os.openpty()
        process = subprocess.Popen(
            [*COMMAND, "estimate", "f/0.png", *OPTIONS, "--out", "poses.csv", *words],
            stderr=slave,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
        )
        os.close(slave)
        shown = b""
        while True:
            try:
                chunk = os.read(master, 4096)
            except OSError:  # Linux tells of the closed other end in this way
                break
            shown += chunk
            if not chunk:
                break
        os.close(master)
        assert process.wait(60) == 0
        assert (b"ok" in shown and b"poses.csv" in shown) == loud
        assert loud or shown == b""

"""``torchpose estimate --cameras`` as it is typed: folders and manifests of several cameras."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import pyarrow.parquet as pq
import pytest
import torch

import torchpose as tp
from tests.moments.rig_scenes import pictures, poses, rig
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.io.moments import MomentStore, find_moments

COUNT = 4


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four moments of three cameras: one picture is missing, one broken, one has another size."""
    root = tmp_path_factory.mktemp("rig")
    cameras = rig(0, 35, -35)
    tp.CameraRig(cameras.cameras, cameras.R, cameras.t, names=["left", "cam1", "right"]).save(root / "rig.yaml")
    R, t = poses(COUNT, 7)
    torch.save((R, t), root / "truth.pt")
    for name, frames in zip(("left", "cam1", "right"), pictures(cameras, R, t), strict=True):
        (root / "in" / name).mkdir(parents=True)
        for k, frame in enumerate(frames):
            deep = frame.to(torch.int32).mul(257).to(torch.uint16) if name == "right" else frame
            cv2.imwrite(str(root / "in" / name / f"{k}.png"), deep.numpy())
    (root / "in" / "cam1" / "0.png").unlink()
    (root / "in" / "right" / "1.png").write_bytes(b"no picture")
    cv2.imwrite(str(root / "in" / "left" / "2.png"), torch.zeros(10, 10, dtype=torch.uint8).numpy())
    return root


def run(root: Path, out: str, *more: str, given: str = "in") -> int:
    command = ["estimate", str(root / given), "--cameras", str(root / "rig.yaml"), "--target", "quad40", "-q"]
    with pytest.raises(SystemExit) as ended:
        main([*command, "--out", str(root / out), *more])
    return int(ended.value.code or 0)


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def test_a_row_a_moment(shots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(shots, "poses.csv") == 1  # a picture could not be read
    told = capsys.readouterr().err
    assert "right/1.png (not_an_image)" in told
    rows = table(shots / "poses.csv")
    assert [row["frame"] for row in rows] == ["0.png", "1.png", "2.png", "3.png"]
    assert [row["status"] for row in rows] == ["ok"] * COUNT
    assert [row["cameras"] for row in rows] == ["2", "2", "2", "3"]
    _, t = torch.load(shots / "truth.pt")
    for k, row in enumerate(rows):
        error = torch.tensor([float(row[f"t{axis}"]) for axis in "xyz"]) - t[k]
        assert float(error.norm()) < 0.005
        assert 0 < float(row["consistency_p"]) <= 1
        assert float(row["consistency"]) < 4
        assert float(row["sz"]) < 0.002


def test_json_and_parquet_have_the_shares(shots: Path) -> None:
    for name in ("poses.jsonl", "poses.parquet"):
        run(shots, name)
    lines = [json.loads(line) for line in (shots / "poses.jsonl").read_text().splitlines()]
    assert [share["camera"] for share in lines[0]["shares"]] == ["left", "cam1", "right"]
    assert lines[0]["shares"][1]["share"] == 0
    assert sum(share["share"] for share in lines[3]["shares"]) == pytest.approx(1)
    assert pq.read_table(shots / "poses.parquet").to_pylist()[0]["shares"] == lines[0]["shares"]


def test_markers_and_pictures_of_every_camera(shots: Path, tmp_path: Path) -> None:
    marks, drawn = tmp_path / "marks.csv", tmp_path / "drawn"
    run(shots, "drawn.csv", "--detections", str(marks), "--overlay", str(drawn))
    rows = table(marks)
    cameras, (R, t) = tp.CameraRig.load(shots / "rig.yaml"), torch.load(shots / "truth.pt")
    assert {(row["frame"], row["camera"]) for row in rows} == {
        (f"{k}.png", name) for k in range(COUNT) for name in cameras.names
    } - {("0.png", "cam1"), ("1.png", "right"), ("2.png", "left")}
    centers = tp.Target.load("quad40").centers
    for row in rows:
        k, number, marker = int(row["frame"][0]), cameras.names.index(row["camera"]), int(row["marker"])
        own_R, own_t = cameras.seen_by(number, R[k], t[k])
        at = cameras.cameras[number].project((own_R @ centers[marker] + own_t)[None])[0]
        assert [float(row["u"]), float(row["v"])] == pytest.approx(at.tolist(), abs=0.05)
    assert sorted(str(p.relative_to(drawn)) for p in drawn.rglob("*.png")) == sorted(
        f"{name}/{frame}" for frame, name in {(row["frame"], row["camera"]) for row in rows}
    )
    # the first axis is drawn from where each camera has the origin: bent into its own picture
    for number, name in enumerate(cameras.names):
        origin = cameras.cameras[number].project(cameras.seen_by(number, R[3], t[3])[1][None])[0]
        u, v = origin.round().int().tolist()
        picture = cv2.imread(str(drawn / name / "3.png"))
        assert picture is not None
        around = picture[v - 6 : v + 7, u - 6 : u + 7].astype(int)
        assert (around.max(-1) - around.min(-1)).max() > 100  # colours in a grey picture


@pytest.mark.parametrize("name", ["killed.csv", "killed.jsonl"])
def test_a_killed_run_goes_on(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    shutil.copy(shots / "rig.yaml", tmp_path)
    shutil.copytree(shots / "in", tmp_path / "in")
    with monkeypatch.context() as killed:
        killed.setattr(MomentStore, "finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert run(tmp_path, name, "-d", str(tmp_path / "marks.csv")) == 130
    assert run(tmp_path, name, "-d", str(tmp_path / "marks.csv"), "--resume") == 0
    run(tmp_path, f"whole_{name}", "-d", str(tmp_path / "again.csv"))
    assert (tmp_path / name).read_text() == (tmp_path / f"whole_{name}").read_text()
    assert (tmp_path / "marks.csv").read_text() == (tmp_path / "again.csv").read_text()


def test_resume_does_what_has_changed(shots: Path, tmp_path: Path) -> None:
    shutil.copytree(shots / "in", tmp_path / "in")
    shutil.copy(shots / "rig.yaml", tmp_path)
    run(tmp_path, "poses.csv")
    first = table(tmp_path / "poses.csv")
    shutil.copy(tmp_path / "in" / "right" / "0.png", tmp_path / "in" / "right" / "1.png")  # another moment's
    assert run(tmp_path, "poses.csv", "--resume") == 0
    again = table(tmp_path / "poses.csv")
    assert [a == b for a, b in zip(first, again, strict=True)] == [True, False, True, True]
    assert (again[1]["status"], again[1]["reason"]) == ("rejected", "cameras_disagree")


def test_hand_eye_of_the_first_camera(shots: Path) -> None:
    eye = tp.HandEye(
        "base", rotations.exp(torch.tensor([0.1, 0.2, 0.3]).double()), torch.tensor([10.0, 20, 30]).double()
    )
    eye.save(shots / "eye.yaml")
    run(shots, "based.csv", "--hand-eye", str(shots / "eye.yaml"))
    rows = table(shots / "based.csv")
    _, t = torch.load(shots / "truth.pt")
    at = t @ eye.rotation.T + eye.translation
    for k, row in enumerate(rows):
        assert float((torch.tensor([float(row[f"base_t{axis}"]) for axis in "xyz"]) - at[k]).norm()) < 0.005


def test_a_manifest_of_several_cameras(shots: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    shutil.copy(shots / "rig.yaml", tmp_path)
    lines = [{"record": "session", "units": {"length": "mm"}}]
    for name in ("left", "right"):
        for k in range(3, COUNT):
            shutil.copy(shots / "in" / name / f"{k}.png", tmp_path / "images" / f"{k}_{name}.png")
            lines.append({"record": "frame", "id": f"{k}_{name}", "image": f"images/{k}_{name}.png", "camera": name})
    (tmp_path / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert run(tmp_path, "poses.csv", given="manifest.jsonl") == 0
    rows = table(tmp_path / "poses.csv")
    assert [(row["frame"], row["status"], row["cameras"]) for row in rows] == [("images/3.png", "ok", "2")]


PLAN = """cameras: rig.yaml
target: quad40
seed: 3
poses:
  random: {count: 2, x: [-5, 5], y: [-4, 4], z: [116, 124], tilt_deg: [0, 20]}
sensor: {noise: 2.0}
"""


def test_plans_with_several_cameras(shots: Path, tmp_path: Path) -> None:
    shutil.copy(shots / "rig.yaml", tmp_path)
    (tmp_path / "plan.yaml").write_text(PLAN)
    with pytest.raises(SystemExit) as ended:
        main(["simulate", str(tmp_path / "plan.yaml"), "--out", str(tmp_path / "in"), "-q"])
    assert not ended.value.code
    assert run(tmp_path, "poses.csv") == 0
    for row, truth in zip(table(tmp_path / "poses.csv"), table(tmp_path / "in" / "truth.csv"), strict=True):
        assert (row["frame"], row["cameras"]) == (truth["frame"], "3")
        for name in ("x", "y", "z"):
            bound = float(truth[f"s{name}"])
            assert float(row[f"s{name}"]) == pytest.approx(bound, rel=0.25)
            assert abs(float(row[f"t{name}"]) - float(truth[f"t{name}"])) < 5 * bound
    alone = table(tmp_path / "in" / "left" / "truth.csv")
    assert float(alone[0]["sz"]) > 2 * float(table(tmp_path / "in" / "truth.csv")[0]["sz"])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--camera", "cam.yaml"], "--camera: stands beside --cameras"),
        (["--engine", "ray"], "--engine ray: is of one camera"),
        (["--instances", "2"], "--instances: several cameras look for one copy"),
        (["--method", "paper"], "method: 'paper' is of one camera"),
    ],
)
def test_what_does_not_go_with_several_cameras(
    shots: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert run(shots, "none.csv", *more) == 2
    assert message in capsys.readouterr().err


def test_pictures_without_a_moment_in_common_are_told(tmp_path: Path) -> None:
    """Cameras whose programs end names differently would have rows of one camera each, without a word."""
    camera = tp.Camera.ideal(64, 48, 50.0)
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    pair = tp.CameraRig([camera, camera], eye, [[0.0, 0, 0], [-100, 0, 0]], names=["left", "right"])
    for name in ("left/1.png", "left/2.png", "right/1.tif", "right/2.tif", "loose.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    told: list[str] = []
    assert len(find_moments(tmp_path, pair, told.append)) == 4
    assert told[0] == f"{tmp_path}: passed over 1 pictures that lie in no folder of a camera"
    assert told[1].startswith(f"{tmp_path}: no two cameras have a picture of one name (1.png, 1.tif), so every row is ")
    (tmp_path / "loose.png").unlink()
    (tmp_path / "right" / "1.tif").rename(tmp_path / "right" / "1.png")
    assert len(find_moments(tmp_path, pair, told.append)) == 3
    assert len(told) == 2, "one moment in common: the other cameras may have missed the rest"


def test_folders_are_named_as_the_cameras(shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(shots / "rig.yaml", tmp_path)
    (tmp_path / "in").mkdir()
    assert run(tmp_path, "none.csv") == 2
    assert "has none of the folders left, cam1, right" in capsys.readouterr().err
    shutil.copytree(shots / "in" / "left", tmp_path / "in" / "left")
    (tmp_path / "in" / "other").mkdir()
    assert run(tmp_path, "one.csv") == 0
    told = capsys.readouterr().err
    assert "has no folder cam1, right: these cameras contribute nothing" in told
    assert "passed over other" in told
    rows = table(tmp_path / "one.csv")
    assert [(row["status"], row["cameras"]) for row in rows] == [
        ("ok", "1"),
        ("ok", "1"),
        ("wrong_size", "0"),
        ("ok", "1"),
    ]

"""Whatever a file holds, its reader ends soon, in little memory, with what it read or one line that says what is wrong.

A normal run tries some dozen changed files of each kind. ``pytest -m fuzz tests/fuzz`` tries 100,000 of each, hours in
all; ``FUZZ_CASES=2000`` fewer, ``FUZZ_FIRST=2000`` others, ``-k poses`` those of one kind.
"""

import contextlib
import functools
import json
import os
import random
import re
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from hypothesis import HealthCheck, given, note, settings

from tests.camera.test_camera_rig import three as rig_of_three
from tests.fuzz.mutations import Change, changed, changes, drawn
from tests.io.test_store import ORIGIN, some_poses
from tests.rig.test_session_folder import IMAGE, TAKEN, begun, opened
from torchpose.analysis.evaluation import estimates_of, evaluate
from torchpose.camera import Camera, CameraRig
from torchpose.cli.evaluate import _rows_of
from torchpose.datasets.plan import load_plan
from torchpose.errors import TorchposeError
from torchpose.handeye import HandEye
from torchpose.io.journal import seal, unseal
from torchpose.io.rows import DETECTION_SCHEMA, POSE_SCHEMA, detection_rows, pose_rows
from torchpose.io.sources import find_sources
from torchpose.io.store import ResultStore
from torchpose.io.truth import Truth, read_truth, write_truth
from torchpose.io.writers import read_rows, write_rows
from torchpose.rig import plan as capture_plan
from torchpose.rig.experiment import evaluate_experiment
from torchpose.rig.settings import load_rig
from torchpose.rig.twin.scene import Scene
from torchpose.target import Target

pytestmark = pytest.mark.filterwarnings("ignore::torchpose.camera.formats.CameraWarning")

ROOT = Path(__file__).parents[2]
CASES = 40  # of a kind in a normal run
MOST_S, MOST_BYTES = 1.0, 200 << 20
FRAMES = ["a.png", "b.png", "c.png"]


@dataclass(frozen=True)
class Reader:
    """A kind of file: how it is made, in a folder of its own, and read."""

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]
    before: Callable[[bytes], bytes] = lambda text: text  # what is changed instead of the file's own bytes
    after: Callable[[bytes], bytes] = lambda text: text  # and back


@contextlib.contextmanager
def within_bounds() -> Iterator[None]:
    """Fails after more than `MOST_S` of computing time; memory beyond `MOST_BYTES` is refused."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    begin = time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.process_time() - begin < MOST_S


def copied(*names: str, text: str = "") -> Callable[[Path], None]:
    """Makes a file from one of the project, or from text."""

    def make(path: Path) -> None:
        path.write_bytes(text.encode() if text else (ROOT / names[0]).read_bytes())
        for name in names[1:]:
            (path.parent / Path(name).name).write_bytes((ROOT / name).read_bytes())

    return make


def rows() -> list[dict[str, Any]]:
    return pose_rows(some_poses(3, 1), FRAMES, ["quad40"])


def make_truth(path: Path) -> None:
    poses = some_poses(3, 1)
    vector = torch.nan_to_num(poses.rotation_vector)
    extra = {name: torch.ones(3, dtype=torch.float64) for name in ("sx", "sy", "sz", "srx", "sry", "srz", "psf_sigma")}
    write_truth(path, Truth(FRAMES, ["quad40"] * 3, torch.nan_to_num(poses.t), vector, extra))


def make_poses(path: Path) -> None:
    make_truth(path.with_name("truth.csv"))
    write_rows(path, rows(), POSE_SCHEMA)


def read_poses(path: Path) -> None:
    truth = read_truth(path.with_name("truth.csv"))
    found, _ = _rows_of(path, truth)
    evaluate(estimates_of(found), truth)
    list(read_rows(path, POSE_SCHEMA))


def make_journal(path: Path) -> None:
    detections = detection_rows(some_poses(3, 1).detections, FRAMES, ["quad40"])
    records: list[dict[str, Any]] = [
        {"frame": row["frame"], "rows": [row], "detections": [d for d in detections if d["frame"] == row["frame"]]}
        for row in rows()
    ]
    lines: list[dict[str, Any]] = [{"origin": ORIGIN}, *(record | {"file": [1, 2]} for record in records)]
    path.write_bytes(b"".join(map(seal, lines)))


def read_journal(path: Path) -> None:
    """Resumes, and writes the tables of what there is."""
    files = {"a.png": [1, 2], "b.png": [3, 4]}
    at = path.with_name(path.name.removesuffix(".partial"))
    several: dict[str, Any] = {"schema": POSE_SCHEMA, "targets": 1, "origin": ORIGIN, "files": files}
    store = ResultStore(at, path.with_name("d.csv"), resume=True, **several)
    try:
        store.finish(FRAMES)
        store.tally.whole_run.lines("640x480")
        for name, misfits in store.tally.misfits.items():
            misfits.lines(name, [0, 1, 2, 3])
    finally:
        store.close()
        at.unlink(missing_ok=True)
        at.with_name(at.name + ".run.json").unlink(missing_ok=True)


def make_run(path: Path) -> None:
    at = path.with_name(path.name.removesuffix(".run.json"))
    write_rows(at, rows(), POSE_SCHEMA)
    write_rows(path.with_name("d.csv"), [], DETECTION_SCHEMA)
    path.write_text(json.dumps(ORIGIN | {"files": {name: [1, 2] for name in FRAMES}}))


def read_run(path: Path) -> None:
    at = path.with_name(path.name.removesuffix(".run.json"))
    ResultStore(at, path.with_name("d.csv"), schema=POSE_SCHEMA, targets=1, origin=ORIGIN, resume=True).close()
    at.with_name(at.name + ".partial").unlink()


def make_session(path: Path) -> None:
    waypoints = [{"kind": "static", "id": f"{i:04d}", "origin": True} for i in range(3)]
    moved: dict[str, Any] = {"kind": "translation", "axis": "x"}
    waypoints += [{**moved, "id": f"{i:04d}", "value": 1.0 * i, "origin": not i} for i in range(3)]
    with begun(path.parent) as session:
        for i, waypoint in enumerate(waypoints):
            pose = [400.0 + i, 0.0, 300.0, 3.0, 0.0, 0.0]
            session.write(f"{i:04d}", IMAGE, **{**TAKEN, "waypoint": waypoint, "robot_pose": pose})
        session.end("complete")
    poses = some_poses(6, 1, seed=1)[:5]
    table = pose_rows(poses, [f"images/{i:04d}.png" for i in range(6)], ["quad40"])
    write_rows(path.with_name("poses.jsonl"), table, POSE_SCHEMA)


def read_session(path: Path) -> None:
    with contextlib.suppress(TorchposeError):
        opened(path.parent, resume=True)
    evaluate_experiment(path, path.with_name("poses.jsonl"))


def make_manifest(path: Path) -> None:
    frames = [
        {"record": "frame", "id": i, "image": f"f/{i}.png", "camera": "left", "robot_pose": [1, 2, 3, 0.1, 0.2, 0.3]}
        for i in range(4)
    ]
    lines = [{"record": "session", "units": {"length": "m"}}, *frames, {"record": "end"}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def read_capture_plan(path: Path) -> None:
    plan = capture_plan.load_plan(path)
    workspace = load_rig(ROOT / "configs/rig/ur5_2mp.yaml").robot.workspace
    plan.summary(workspace)
    plan.check(workspace)
    assert plan.digest


Form = Literal["json", "ros", "kalibr", "colmap"]
FORMS: tuple[Form, ...] = ("json", "ros", "kalibr", "colmap")


def camera_text(form: Form) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        Camera.load(ROOT / "data/sample/camera.yaml").save(path, form)

    return make


SIX = ", ".join(str([float(i == k) for k in range(6)]) for i in range(6))
HAND_EYE = f"base_from_camera: {{rotation: [0.1, 0.2, 0.3], translation: [700, -50, 900], covariance: [{SIX}]}}"
FULL_PLAN = """
camera: camera.yaml
target: quad40
seed: 3
poses: {random: {count: 4, x: [-5, 5], y: [-5, 5], z: [160, 200], tilt_deg: [0, 30]}}
imaging: {psf_sigma: [0.6, 0.9], dark: 30, light: 220, plate: [70, 70], motion_mm: [0, 0.3], clutter: 3, flicker: 0.1,
  speckle: 0.05, ghost: 10, haze_px: 0.1, coma_px: 1, smear_px: 2, psf_ratio: 1.5, disc_px: 1}
print: {center_sigma: 0.01, gain: 0.02, scale: 0.001, warp: 0.1, dpi: 1200, texture: {share: 0.1, length: 1}, seed: 1}
sensor: {noise: 1, full_well: 10000, bits: 8, prnu: 0.01, column_noise: 1, line_jitter: 0.1}
processing: {denoise: 3, sharpen: 1, jpeg: 90}
depth_range: [100, 300]
out_of_view: mark
"""
GRID_PLAN = """
camera: camera.yaml
target: quad40
poses: {grid: {distance: 170, angles_deg: [-5, 0, 5], positions: [[0, 0, 0], [1, 2, 3]]}}
faults: {RandomGaussianBlur: {kernel_size: [3, 3], sigma: [0.1, 2.0]}}
out_of_view: mark
"""


TWIN = re.sub("[^ ]*/cameras/.*", "camera.yaml", (ROOT / "configs/rig/twin_2mp.yaml").read_text())


def sealed(text: bytes) -> bytes:
    """Lines of records as a journal has them, so that what was changed is not told by its checksum."""
    lines = []
    for line in text.splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            record = json.loads(line)
            lines.append(seal(record) if isinstance(record, dict) and record else line + b"\n")
    return b"".join(lines)


def unsealed(text: bytes) -> bytes:
    return b"".join(json.dumps(unseal(line)).encode() + b"\n" for line in text.splitlines(keepends=True))


with_camera = functools.partial(copied, "", "data/sample/camera.yaml")
CAMERA = "data/sample/camera.yaml"
STEREO = """units: mm
image_width: 640
image_height: 480
M1: [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
D1: [-0.1, 0.02, 0, 0, 0]
M2: {rows: 3, cols: 3, data: [500.0, 0, 320, 0, 500, 240, 0, 0, 1]}
D2: [0, 0, 0, 0]
R: [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]
T: [[-100.0], [0], [3]]
"""
READERS = [
    *(Reader(f"poses{suffix}", make_poses, read_poses) for suffix in (".csv", ".jsonl", ".parquet")),
    Reader("p.csv.partial", make_journal, read_journal),
    Reader("sealed.jsonl.partial", make_journal, read_journal, unsealed, sealed),
    Reader("p.jsonl.run.json", make_run, read_run),
    Reader("manifest.jsonl", make_session, read_session),
    Reader("capture.jsonl", make_manifest, lambda path: find_sources([path, path.with_name("capture.jsonl#left")][:1])),
    Reader("truth.csv", make_truth, read_truth),
    Reader("plan.yaml", with_camera(text=FULL_PLAN), load_plan),
    Reader("grid.yaml", with_camera(text=GRID_PLAN), load_plan),
    Reader("camera.yaml", copied(CAMERA), Camera.load),
    *(Reader(f"camera_{form}", camera_text(form), Camera.load) for form in FORMS),
    Reader("cameras.yaml", lambda path: rig_of_three().save(path), CameraRig.load),
    Reader("stereo.yaml", copied(text=STEREO), CameraRig.load),
    Reader("target.yaml", copied("data/sample/target.yaml"), Target.load),
    Reader("hand_eye.yaml", copied(text=HAND_EYE), HandEye.load),
    Reader("twin.yaml", with_camera(text=TWIN), Scene.load),
    Reader("capture.yaml", copied("configs/rig/calibration_plan.yaml"), read_capture_plan),
    Reader("experiment.yaml", copied("configs/rig/paper_plan.yaml"), read_capture_plan),
    Reader("rig.yaml", copied("configs/rig/ur5_2mp.yaml"), load_rig),
]


def check(reader: Reader, path: Path, text: bytes) -> None:
    """Reads a text as the file at a path."""
    path.write_bytes(text)
    try:
        with within_bounds():
            reader.read(path)
    except TorchposeError as error:
        message = str(error)
        assert message.isprintable()
        assert 0 < len(message) <= 1100


@pytest.fixture
def at_rest(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No waiting for the disk, and one thread: each has a stack that counts as memory."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=READERS, ids=lambda reader: reader.name)
def made(request: pytest.FixtureRequest, tmp_path: Path, at_rest: None) -> tuple[Reader, Path]:
    """A reader and a right file, which it has read once: what is imported then is not the case's own."""
    reader: Reader = request.param
    path = tmp_path / reader.name
    reader.make(path)
    right = path.read_bytes()
    reader.read(path)
    path.write_bytes(right)
    return reader, path


def test_changed_files_end_in_one_line_or_are_read(made: tuple[Reader, Path]) -> None:
    reader, path = made
    right = reader.before(path.read_bytes())

    @settings(max_examples=CASES, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(changes)
    def one(several: list[Change]) -> None:
        text = reader.after(changed(right, several))
        note(repr(text[:2000]))
        check(reader, path, text)

    one()


# cases of the long run below that once failed, by their number
FOUND = [("plan.yaml", 13657)]  # 65,536 frames took 1.2 s to look for their markers


@pytest.mark.parametrize(("name", "number"), FOUND)
def test_what_the_long_run_found(name: str, number: int, tmp_path: Path, at_rest: None) -> None:
    reader = next(reader for reader in READERS if reader.name == name)
    path = tmp_path / name
    reader.make(path)
    right = reader.before(path.read_bytes())
    check(reader, path, reader.after(changed(right, drawn(random.Random(number)))))


@pytest.mark.fuzz
@pytest.mark.timeout(0)
def test_very_many_changed_files(made: tuple[Reader, Path]) -> None:
    reader, path = made
    right = reader.before(path.read_bytes())
    faults: list[tuple[int, str]] = []
    first, cases = (int(os.environ.get(f"FUZZ_{name}", most)) for name, most in (("FIRST", 0), ("CASES", 100_000)))
    for number in range(first, first + cases):
        text = reader.after(changed(right, drawn(random.Random(number))))
        try:
            check(reader, path, text)
        except Exception as error:
            faults.append((number, f"{type(error).__name__}: {error} of {text[:1000]!r}"))
    assert not faults, f"{len(faults)}: {faults[:3]}"

"""Rows, tables and the journal: exact round trips, whole files or none, resuming after any cut."""

import csv
import errno
import io
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import torch

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.journal import seal, unseal
from torchpose.io.rows import (
    BASE_SCHEMA,
    DETECTION_SCHEMA,
    POSE_SCHEMA,
    base_cells,
    detection_rows,
    fault_row,
    pose_rows,
)
from torchpose.io.store import ResultStore
from torchpose.io.writers import read_rows, read_table, write_rows
from torchpose.results import Detections, Poses, Reason, Status

CONTRACT = (
    "frame,target,status,tx,ty,tz,rx,ry,rz,sx,sy,sz,srx,sry,srz,rms_px,markers,nx,ny,nz,nrx,nry,nrz,"
    "reason,instance,copies,misfit,chi2,dof"
)
DETECTION_CONTRACT = "frame,target,marker,u,v,su,sv,outer_a,outer_b,outer_theta,inner_a,inner_b,inner_theta,instance"
NAN = float("nan")


def some_poses(frames: int = 3, targets: int = 2, seed: int = 0) -> Poses:
    """Random poses; the last row has none, the last but one is ambiguous with a second solution."""
    g = torch.Generator().manual_seed(seed)
    n = frames * targets

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    root = normal(n, 6, 6)
    vectors = normal(n, 3)
    gone, second = torch.arange(n) == n - 1, torch.arange(n) == n - 2
    k = 4 * n
    detections = Detections(
        frame=torch.arange(frames).repeat_interleave(4 * targets),
        target=torch.arange(targets).repeat_interleave(4).repeat(frames),
        instance=torch.zeros(4 * n, dtype=torch.int64),
        marker=torch.tensor([3, 2, 1, 0]).repeat(n),
        center=100 + normal(k, 2),
        center_cov=torch.diag_embed(normal(k, 2).square()),
        outer=normal(k, 5),
        inner=normal(k, 5),
    )
    return Poses(
        frame=torch.arange(frames).repeat_interleave(targets),
        target=torch.arange(targets).repeat(frames),
        instance=torch.zeros(n, dtype=torch.int64),
        copies=torch.ones(n, dtype=torch.int64),
        R=torch.where(gone[:, None, None], NAN, rotations.exp(vectors)),
        t=torch.where(gone[:, None], NAN, 500 * normal(n, 3)),
        covariance=torch.where(gone[:, None, None], NAN, root @ root.mT),
        noise=torch.where(gone[:, None, None], NAN, 0.5 * root @ root.mT),
        systematic=torch.where(gone[:, None, None], NAN, 0.5**0.5 * root),
        place=torch.zeros(n, 4, 5, dtype=torch.float64),
        misfit=torch.zeros(n, dtype=torch.int64),
        residual_chi2=torch.where(gone, NAN, normal(n).square()),
        freedom=torch.where(gone, 0, 18),
        rms=torch.where(gone, NAN, normal(n).square()),
        status=torch.where(gone, Status.REJECTED, torch.where(second, Status.AMBIGUOUS, Status.OK)),
        reason=torch.where(gone, Reason.RING_SHAPE, torch.where(second, Reason.TWO_SOLUTIONS, Reason.NONE)),
        markers=torch.where(gone, 2, 4),
        chi2=torch.where(gone, NAN, normal(n).square()),
        R_alt=torch.where(second[:, None, None], rotations.exp(-vectors), NAN),
        t_alt=torch.where(second[:, None], 500 * normal(n, 3), NAN),
        rms_alt=torch.where(second, normal(n).square(), NAN),
        chi2_alt=torch.where(second, normal(n).square(), NAN),
        detections=detections,
    )


FRAMES, TARGETS = ["b.png", "a,1.png", 'c "x"\n.png'], ["left", "right"]


def rows_with_base() -> list[dict[str, Any]]:
    poses = some_poses()
    cells = base_cells(poses.seen_from(rotations.exp(torch.tensor([0.1, 0.2, 0.3])), torch.tensor([1.0, 2.0, 3.0])))
    return [row | cell for row, cell in zip(pose_rows(poses, FRAMES, TARGETS), cells, strict=True)]


def test_rows_hold_the_poses_exactly() -> None:
    poses = some_poses()
    rows = pose_rows(poses, FRAMES, TARGETS)
    assert [(row["frame"], row["target"]) for row in rows] == [(f, t) for f in FRAMES for t in TARGETS]
    assert [row["status"] for row in rows] == ["ok"] * 4 + ["ambiguous", "rejected"]
    assert [row["reason"] for row in rows] == [None] * 4 + ["two_solutions", "ring_shape"]
    for i, row in enumerate(rows[:-1]):
        assert [row[c] for c in ("tx", "ty", "tz")] == poses.t[i].tolist()
        assert [row[c] for c in ("rx", "ry", "rz")] == rotations.log(poses.R[i]).tolist()
        assert [row[c] for c in ("sx", "sy", "sz", "srx", "sry", "srz")] == poses.covariance[
            i
        ].diagonal().sqrt().tolist()
        assert row["covariance"] == poses.covariance[i].tolist()
        assert row["rms_px"] == float(poses.rms[i])
        assert row["solutions"][0]["translation"] == poses.t[i].tolist()
        assert row["solutions"][0]["chi2"] == float(poses.chi2[i])
        assert (row["chi2"], row["dof"]) == (float(poses.residual_chi2[i]), 18)
    assert [len(row["solutions"] or []) for row in rows] == [1, 1, 1, 1, 2, 0]
    assert rows[4]["solutions"][1]["translation"] == poses.t_alt[4].tolist()
    without = ("status", "reason", "frame", "target", "markers", "instance", "copies")
    assert rows[5]["markers"] == 2
    assert all(value is None for column, value in rows[5].items() if column not in without)


def test_detection_rows_are_ordered_by_frame_target_and_marker() -> None:
    poses = some_poses()
    rows = detection_rows(poses.detections, FRAMES, TARGETS)
    assert [(r["frame"], r["target"], r["marker"]) for r in rows] == [
        (f, t, m) for f in FRAMES for t in TARGETS for m in range(4)
    ]
    assert (rows[0]["u"], rows[0]["outer_b"]) == (
        float(poses.detections.center[3, 0]),
        float(poses.detections.outer[3, 3]),
    )
    assert rows[0]["sv"] == math.sqrt(poses.detections.center_cov[3, 1, 1])


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_tables_read_back_to_the_same_bits(tmp_path: Path, suffix: str) -> None:
    schema = POSE_SCHEMA | BASE_SCHEMA
    rows = [
        *rows_with_base(),
        fault_row("bad.png", "left", Status.UNREADABLE, "truncated") | dict.fromkeys(BASE_SCHEMA),
    ]
    path = tmp_path / f"t{suffix}"
    write_rows(path, iter(rows), schema)
    kept = [c for c, kind in schema.items() if suffix != ".csv" or kind is not list]
    assert list(read_rows(path, schema)) == [{c: row[c] for c in kept} for row in rows]
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("row", ["a.png", "a.png,quad,3"])
def test_a_row_with_another_number_of_cells_is_refused(tmp_path: Path, row: str) -> None:
    (tmp_path / "t.csv").write_text(f"frame,target\n{row}\n")
    with pytest.raises(ConfigError, match=r"t\.csv: POSES: cannot be read \(a row has another number of cells"):
        read_table(tmp_path / "t.csv", POSE_SCHEMA, ())


def test_csv_has_the_columns_of_the_contract(tmp_path: Path) -> None:
    write_rows(tmp_path / "a.csv", [], POSE_SCHEMA)
    write_rows(tmp_path / "b.csv", [], POSE_SCHEMA | BASE_SCHEMA)
    write_rows(tmp_path / "d.csv", [], DETECTION_SCHEMA)
    assert (tmp_path / "a.csv").read_text() == CONTRACT + "\n"
    assert (tmp_path / "b.csv").read_text().startswith(CONTRACT + ",base_tx,base_ty,base_tz,base_rx,")
    assert (tmp_path / "d.csv").read_text() == DETECTION_CONTRACT + "\n"


def test_csv_cells_are_empty_where_there_is_no_pose(tmp_path: Path) -> None:
    write_rows(tmp_path / "a.csv", rows_with_base()[-1:], POSE_SCHEMA)
    (row,) = csv.DictReader(io.StringIO((tmp_path / "a.csv").read_text(), newline=""))
    empty = {c for c, kind in POSE_SCHEMA.items() if kind is float} | {"misfit", "dof"}
    assert {c for c, v in row.items() if v == ""} == empty
    assert (row["markers"], row["reason"]) == ("2", "ring_shape")


def test_jsonl_is_strict_json_and_parquet_is_typed(tmp_path: Path) -> None:
    rows = rows_with_base()
    write_rows(tmp_path / "a.jsonl", rows, POSE_SCHEMA)
    write_rows(tmp_path / "a.parquet", rows, POSE_SCHEMA)

    def refuse(text: str) -> None:
        raise AssertionError(text)

    parsed = [json.loads(line, parse_constant=refuse) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert parsed[-1]["covariance"] is None
    assert torch.tensor(parsed[0]["covariance"]).shape == (6, 6)
    types = {field.name: str(field.type) for field in pq.read_schema(tmp_path / "a.parquet")}
    assert (types["frame"], types["tx"], types["markers"]) == ("string", "double", "int64")


def test_a_failed_write_leaves_the_old_table(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    write_rows(path, [fault_row("old", "t", Status.UNREADABLE, "empty")], POSE_SCHEMA)
    before = path.read_bytes()

    def rows() -> Iterator[dict[str, Any]]:
        yield fault_row("new", "t", Status.UNREADABLE, "empty")
        raise OSError(28, "No space left on device")

    with pytest.raises(ConfigError, match="No space left"):
        write_rows(path, rows(), POSE_SCHEMA)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


# --- the journal ---

ORIGIN: dict[str, Any] = {"--camera": "c1", "--target": [["quad", "t1"]]}
NAMES = [f"{i}.png" for i in range(5)]


def record(name: str) -> dict[str, list[dict[str, Any]] | str]:
    number = int(name.split(".")[0])
    row = fault_row(name, "quad", Status.OK, "") | {"reason": None, "tx": number + 0.1, "markers": 4}
    detection = dict.fromkeys(DETECTION_SCHEMA) | {"frame": name, "target": "quad", "marker": 1, "u": number / 3}
    return {"frame": name, "rows": [row], "detections": [detection]}


def store(folder: Path, *, resume: bool = False, origin: dict[str, Any] = ORIGIN, suffix: str = ".csv") -> ResultStore:
    return ResultStore(
        folder / f"p{suffix}", folder / "d.csv", schema=POSE_SCHEMA, targets=1, origin=origin, resume=resume
    )


def tables(folder: Path, suffix: str = ".csv") -> tuple[bytes, bytes]:
    return (folder / f"p{suffix}").read_bytes(), (folder / "d.csv").read_bytes()


def complete(folder: Path, names: list[str] = NAMES, resume: bool = False, **options: Any) -> list[str]:
    with_rows = store(folder, resume=resume, **options)
    done = [name for name in names if name in with_rows]
    with_rows.append([record(name) for name in names if name not in with_rows])
    with_rows.finish(names)
    return done


@pytest.fixture
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    complete(folder)
    return tables(folder)


def test_a_completed_run_leaves_tables_and_their_origin_only(tmp_path: Path) -> None:
    complete(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"p.csv", "d.csv", "p.csv.run.json"}
    assert json.loads((tmp_path / "p.csv.run.json").read_text()) == ORIGIN


def test_a_journal_cut_at_any_byte_is_resumed_to_the_same_tables(tmp_path: Path, whole: tuple[bytes, bytes]) -> None:
    first = store(tmp_path)
    first.append([record(name) for name in NAMES[:2]])
    first.append([record(NAMES[2])])
    first.close()
    journal = tmp_path / "p.csv.partial"
    content = journal.read_bytes()
    ends = [i + 1 for i, byte in enumerate(content) if byte == ord("\n")]
    for cut in {*range(0, len(content), 53), *ends, *(end - 1 for end in ends)}:
        journal.write_bytes(content[:cut])
        finished = max(0, sum(end <= cut for end in ends) - 1)  # the first line is the origin
        assert complete(tmp_path, resume=True) == NAMES[:finished]
        assert tables(tmp_path) == whole
        assert not journal.exists()
        for leftover in tmp_path.iterdir():
            leftover.unlink()


def test_a_journal_that_ends_in_zeros_is_resumed(tmp_path: Path, whole: tuple[bytes, bytes]) -> None:
    first = store(tmp_path)
    first.append([record(name) for name in NAMES[:3]])
    first.close()
    with (tmp_path / "p.csv.partial").open("ab") as file:
        file.write(bytes(4096) + b"\n")
    assert complete(tmp_path, resume=True) == NAMES[:3]
    assert tables(tmp_path) == whole


def test_frames_are_written_in_the_order_asked_for(tmp_path: Path, whole: tuple[bytes, bytes]) -> None:
    first = store(tmp_path)
    first.append([record(name) for name in reversed(NAMES)])
    first.finish(NAMES)
    assert tables(tmp_path) == whole


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_finished_tables_are_resumed_with_their_rows_kept(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "a").mkdir()
    complete(tmp_path / "a", suffix=suffix)
    (tmp_path / "b").mkdir()
    complete(tmp_path / "b", NAMES[1:3], suffix=suffix)
    assert complete(tmp_path / "b", resume=True, suffix=suffix) == NAMES[1:3]
    assert tables(tmp_path / "b", suffix) == tables(tmp_path / "a", suffix)
    assert complete(tmp_path / "b", resume=True, suffix=suffix) == NAMES
    assert tables(tmp_path / "b", suffix) == tables(tmp_path / "a", suffix)


def test_rows_of_frames_that_are_gone_are_kept_in_front(tmp_path: Path) -> None:
    complete(tmp_path, NAMES[:2])
    complete(tmp_path, NAMES[1:], resume=True)
    assert [row["frame"] for row in read_rows(tmp_path / "p.csv", POSE_SCHEMA)] == NAMES


def test_counts_and_unreadable_frames_include_those_of_the_earlier_run(tmp_path: Path) -> None:
    first = store(tmp_path)
    bad = {"frame": "x.png", "rows": [fault_row("x.png", "quad", Status.UNREADABLE, "empty")], "detections": []}
    first.append([record(NAMES[0]), bad])
    first.close()
    second = store(tmp_path, resume=True)
    second.append([record(NAMES[1])])
    assert second.tally.counts == {"ok": 2, "unreadable": 1}
    assert second.tally.unreadable == {"x.png": "empty"}
    second.close()


@pytest.mark.parametrize("finished", [True, False])
def test_resuming_with_another_origin_is_refused_and_changes_nothing(tmp_path: Path, finished: bool) -> None:
    first = store(tmp_path)
    first.append([record(name) for name in NAMES])
    if finished:
        first.finish(NAMES)
    first.close()
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match=r"--resume: .* another --camera; run without --resume"):
        store(tmp_path, resume=True, origin=ORIGIN | {"--camera": "c2"})
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_a_table_of_unknown_origin_is_not_resumed(tmp_path: Path) -> None:
    complete(tmp_path)
    (tmp_path / "p.csv.run.json").unlink()
    with pytest.raises(ConfigError, match=r"p\.csv\.run\.json: --resume: missing"):
        store(tmp_path, resume=True)


def test_without_resume_everything_starts_over_and_the_old_table_stays_until_the_end(
    tmp_path: Path, whole: tuple[bytes, bytes]
) -> None:
    complete(tmp_path)
    second = store(tmp_path)
    assert NAMES[0] not in second
    second.append([record(NAMES[0])])
    assert tables(tmp_path) == whole
    second.finish(NAMES)
    assert len(list(read_rows(tmp_path / "p.csv", POSE_SCHEMA))) == 1


def test_two_runs_cannot_write_one_table(tmp_path: Path) -> None:
    first = store(tmp_path)
    with pytest.raises(ConfigError, match="another run is writing"):
        store(tmp_path)
    first.append([record(NAMES[0])])
    first.close()
    second = store(tmp_path, resume=True)
    assert NAMES[0] in second
    second.close()


def test_a_killed_run_holds_no_lock(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from tests.io.test_store import NAMES, Path, record, store\n"
        "one = store(Path(sys.argv[2])); one.append([record(NAMES[0])]); print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parents[2]), str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ConfigError, match=r"p\.csv\.partial: --out: another run is writing it; wait for it or"):
            store(tmp_path, resume=True)
        other.kill()
    assert complete(tmp_path, resume=True) == NAMES[:1]
    assert {p.name for p in tmp_path.iterdir()} == {"p.csv", "d.csv", "p.csv.run.json"}


def test_places_without_locks_are_written_unguarded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("torchpose.io.journal.lock_descriptor", missing)
    assert complete(tmp_path) == []


@pytest.mark.parametrize(
    "line", ["[1]", '{"frame": "0.png"}', '{"frame": "0.png", "rows": [], "detections": []}', '{"rows": [{}]}', "3"]
)
@pytest.mark.parametrize("first", [True, False])
def test_a_journal_of_another_program_is_one_clear_line(tmp_path: Path, line: str, first: bool) -> None:
    head = "" if first else json.dumps({"origin": ORIGIN}) + "\n"
    (tmp_path / "p.csv.partial").write_text(head + line + "\n")
    with pytest.raises(ConfigError, match=r"p\.csv\.partial: --resume: not written by torchpose; run without --resume"):
        store(tmp_path, resume=True)


ROW = {"frame": "0.png", "target": "quad40", "status": "ok", "reason": None}


@pytest.mark.parametrize(
    "cell",
    [
        {"place": 5},
        {"nx": "abc"},
        {"sx": -1.0},
        {"instance": -1},
        {"instance": 10**12},
        {"status": "[/x]"},
        {"frame": "1.png"},
        {"target": None},
        {"covariance": [[1.0]]},
        {"solutions": [{"translation": "x"}]},
    ],
    ids=str,
)
def test_cells_of_another_kind_in_a_journal_are_one_clear_line(tmp_path: Path, cell: dict[str, Any]) -> None:
    record = {"frame": "0.png", "rows": [{**ROW, **cell}], "detections": []}
    (tmp_path / "p.csv.partial").write_bytes(seal({"origin": ORIGIN}) + seal(record))
    with pytest.raises(ConfigError, match="--resume: not written by torchpose"):
        store(tmp_path, resume=True)


@pytest.mark.parametrize("place", ["p.txt", "p", "folder.csv", "file/p.csv", "/proc/p.csv"])
def test_places_that_cannot_be_written_are_refused_at_once(tmp_path: Path, place: str) -> None:
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="--out: ") as caught:
        ResultStore(tmp_path / place, None, schema=POSE_SCHEMA, targets=1, origin=ORIGIN, resume=False)
    assert "\n" not in str(caught.value)
    assert {p.name for p in tmp_path.iterdir()} == {"folder.csv", "file"}


def test_a_journal_from_before_there_were_instances_is_resumed(tmp_path: Path, whole: tuple[bytes, bytes]) -> None:
    """Its rows are those of the only copy; how many there were is not known."""
    first = store(tmp_path)
    first.append([record(name) for name in NAMES[:3]])
    first.close()
    journal = tmp_path / "p.csv.partial"
    lines = [unseal(line) or {} for line in journal.read_bytes().splitlines(keepends=True)]
    for line in lines[1:]:
        for row in [*line["rows"], *line["detections"]]:
            row.pop("instance")
            row.pop("copies", None)
    journal.write_bytes(b"".join(map(seal, lines)))
    assert complete(tmp_path, resume=True, origin=ORIGIN | {"--instances": 1}) == NAMES[:3]
    rows = read_rows(tmp_path / "p.csv", POSE_SCHEMA)
    assert [(row["instance"], row["copies"]) for row in rows] == [(0, None)] * 5


@pytest.mark.parametrize("column", sorted(set(POSE_SCHEMA) - {"frame", "target", "status"}))
def test_a_cell_that_a_journal_lacks_is_an_empty_one(tmp_path: Path, column: str) -> None:
    """In the tally and in the table alike, whatever the column."""
    record = {"frame": "0.png", "rows": [{key: cell for key, cell in ROW.items() if key != column}], "detections": []}
    (tmp_path / "p.csv.partial").write_bytes(seal({"origin": ORIGIN}) + seal(record))
    resumed = store(tmp_path, resume=True)
    resumed.finish(["0.png"])
    resumed.close()
    (row,) = read_rows(tmp_path / "p.csv", POSE_SCHEMA)
    assert row.get(column) == (0 if column == "instance" else None)  # a CSV file has no matrices


def test_copies_without_a_row_are_counted(tmp_path: Path) -> None:
    """Frames that show more copies than they have rows, of every target the most."""
    of = store(tmp_path)

    def rows(frame: str, copies: int, count: int) -> dict[str, Any]:
        row = fault_row(frame, "quad", Status.OK, None) | {"copies": copies}
        return {"frame": frame, "rows": [row | {"instance": i} for i in range(count)], "detections": []}

    of.append([rows("a", 3, 3), rows("b", 4, 2), rows("c", 6, 1)])
    of.close()
    again = store(tmp_path, resume=True)
    for one in (of, again):
        assert one.tally.crowded == {"b", "c"}
        assert one.tally.most == {"quad": 6}
    again.finish(["a", "b", "c"])
    done = store(tmp_path, resume=True)
    assert len(done) == 3
    assert done.tally.crowded == {"b", "c"}
    done.close()

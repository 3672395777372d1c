"""A table that grows: rows once, whatever a killed run has left."""

from pathlib import Path
from typing import Any

import pytest

from torchpose.errors import ConfigError
from torchpose.io.growing import GrowingTable
from torchpose.io.rows import POSE_SCHEMA, fault_row
from torchpose.io.writers import read_rows
from torchpose.results import Status

ORIGIN = {"--camera": "a", "INPUT": ["/x"]}


def record(name: str) -> dict[str, Any]:
    rows = [fault_row(name, target, Status.NO_TARGET, None) for target in ("left", "right")]
    return {"frame": name, "rows": rows, "detections": []}


def opened(out: Path, **origin: Any) -> GrowingTable:
    return GrowingTable(out, POSE_SCHEMA, ORIGIN | origin)


def frames(out: Path) -> list[str]:
    return [row["frame"] for row in read_rows(out, POSE_SCHEMA)]


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_rows_are_there_as_they_are_appended_and_once(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / "new" / f"p{suffix}"
    table = opened(out)
    table.append([record("a"), record("b,\n")])
    assert frames(out) == ["a", "a", "b,\n", "b,\n"]
    table.append([record("c")])
    table.close()
    table = opened(out)
    assert len(table) == table.earlier == 3
    assert all(name in table for name in ("a", "b,\n", "c"))
    table.append([record("d")])
    table.close()
    assert frames(out)[-4:] == ["c", "c", "d", "d"]


@pytest.mark.parametrize("gone", ["p.csv", "p.csv.watch"])
@pytest.mark.parametrize("how", ["removed", "moved", "written anew"])
def test_a_table_that_is_taken_away_while_it_grows_is_told(tmp_path: Path, gone: str, how: str) -> None:
    """Its rows would go into a file that nobody can open, and would count as written."""
    table = opened(tmp_path / "p.csv")
    table.append([record("a")])
    if how == "moved":
        (tmp_path / gone).rename(tmp_path / "elsewhere")
    else:
        (tmp_path / gone).unlink()
    if how == "written anew":
        (tmp_path / gone).write_text("")
    with pytest.raises(ConfigError, match=r"p.csv: --out: it, or p.csv.watch, was moved or removed by another program"):
        table.append([record("b")])
    assert "b" not in table
    table.close()


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_run_killed_anywhere_leaves_nothing_missing_or_twice(tmp_path: Path, suffix: str) -> None:
    """Every length of the table from before the last batch to its end, and every length of the journal's last line."""
    out, journal = tmp_path / f"p{suffix}", tmp_path / f"p{suffix}.watch"
    table = opened(out)
    table.append([record("a")])
    before, noted = out.read_bytes(), journal.read_bytes()
    table.append([record("b"), record("c")])
    table.close()
    after, known = out.read_bytes(), journal.read_bytes()
    cuts = [(length, len(noted)) for length in range(len(before), len(after) + 1, 61)]
    cuts += [(len(after), length) for length in range(len(noted), len(known), 5)]
    for rows, lines in cuts:
        out.write_bytes(after[:rows])
        journal.write_bytes(known[:lines])
        table = opened(out)
        assert len(table) == 1
        table.append([record("b"), record("c")])
        table.close()
        assert out.read_bytes() == after
        assert journal.read_bytes() == known


def test_what_is_not_its_own_is_left_as_it_is(tmp_path: Path) -> None:
    out = tmp_path / "p.jsonl"
    table = opened(out)
    with pytest.raises(ConfigError, match="another run is writing it"):
        opened(out)
    table.append([record("a")])
    table.close()
    whole = out.read_bytes()
    with pytest.raises(ConfigError, match="the rows there were made with another --camera"):
        opened(out, **{"--camera": "b"})
    for other in (whole.replace(b"left", b"lift"), whole[:-5], b""):
        out.write_bytes(other)
        with pytest.raises(ConfigError, match="was changed by another program since"):
            opened(out)
        assert out.read_bytes() == other
    out.write_bytes(whole)
    journal = tmp_path / "p.jsonl.watch"
    lines = journal.read_bytes()
    journal.write_bytes(lines.replace(b'"frames"', b'"fames"'))
    with pytest.raises(ConfigError, match="damaged; move it and"):
        opened(out)
    journal.unlink()
    with pytest.raises(ConfigError, match="has rows that torchpose watch did not write"):
        opened(out)
    assert out.read_bytes() == whole
    assert not journal.exists()
    with pytest.raises(ConfigError, match="cannot grow"):
        opened(tmp_path / "p.parquet")


def test_the_tone_of_the_first_run_is_kept(tmp_path: Path) -> None:
    table = opened(tmp_path / "p.csv")
    assert table.tone is None
    table.keep_tone("gamma: 2.2")
    table.append([record("a")])
    table.close()
    table = opened(tmp_path / "p.csv")
    table.close()
    assert (table.tone, len(table)) == ("gamma: 2.2", 1)

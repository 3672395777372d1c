from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchpose.errors import ConfigError
from torchpose.io.truth import Truth, read_truth, write_truth

F64 = torch.float64


def some_truth() -> Truth:
    generator = torch.Generator().manual_seed(1)
    numbers = torch.randn(3, 8, dtype=F64, generator=generator)
    return Truth(
        frame=["a.png", "left/b, c.png", 'd "e".png'],
        target=["quad40", "quad40", "hexa50"],
        t=numbers[:, :3] * 100,
        rotation_vector=numbers[:, 3:6],
        extra={"tilt_deg": numbers[:, 6] * 1e-9, "sx": numbers[:, 7].abs()},
    )


def test_round_trip_is_exact(tmp_path: Path) -> None:
    truth = some_truth()
    write_truth(tmp_path / "truth.csv", truth)
    again = read_truth(tmp_path / "truth.csv")
    assert (again.frame, again.target, list(again.extra)) == (truth.frame, truth.target, ["tilt_deg", "sx"])
    assert torch.equal(again.t, truth.t)
    assert torch.equal(again.rotation_vector, truth.rotation_vector)
    assert all(torch.equal(again.extra[k], v) for k, v in truth.extra.items())
    assert len(again) == 3
    assert list(tmp_path.iterdir()) == [tmp_path / "truth.csv"]


def test_rotation_matrix(tmp_path: Path) -> None:
    R = some_truth().R
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=F64).expand(3, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3, dtype=F64))


def test_columns_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("rz,noise,frame,ry,rx,tz,target,ty,tx\n6,7,f.png,5,4,3,q,2,1\n")
    truth = read_truth(path)
    assert truth.t.tolist() == [[1, 2, 3]]
    assert truth.rotation_vector.tolist() == [[4, 5, 6]]
    assert truth.extra["noise"].tolist() == [7]


def test_header_only(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("frame,target,tx,ty,tz,rx,ry,rz\n")
    truth = read_truth(path)
    assert len(truth) == 0
    assert truth.t.shape == truth.rotation_vector.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("frame,target,tx,ty,tz,rx,ry\n", "rz"),
        ("frame,target,tx,ty,tz,rx,ry,rz,tx\n", "tx"),
        ("frame,target,tx,ty,tz,rx,ry,rz\nf,q,1,2,3,4,5\n", "line 2"),
        ("frame,target,tx,ty,tz,rx,ry,rz\nf,q,1,2,3,4,5,6\nf,q,1,2,east,4,5,6\n", "tz"),
    ],
)
def test_errors_name_file_and_field(tmp_path: Path, text: str, field: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_truth(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {field}: ")
    assert ";" in message
    assert "\n" not in message


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        read_truth(tmp_path / "none.csv")

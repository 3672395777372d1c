"""scripts/wrong_model_statistics.py: each kind of fault is what it says it is, and rows name it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does where a script is started
statistics = importlib.import_module("wrong_model_statistics")

FRAMES = torch.arange(3 * 120 * 160).view(3, 120, 160).remainder(200).to(torch.uint8)


@pytest.mark.parametrize(
    ("name", "misfit"), [("gamma-as-linear", "tone"), ("principal-3px", "camera"), ("gain-30um", "print")]
)
def test_rows_name_what_is_wrong_and_their_covariance_holds(name: str, misfit: str) -> None:
    line = statistics.run(statistics.MODELS[name], 2, 1)
    assert line["ok"] == 2
    assert line["rows_say"] == f"{misfit} 2"
    assert line["beyond"] == 0


def test_there_are_forty_models_or_more_of_every_kind() -> None:
    kinds = {model.kind for model in statistics.MODELS.values()}
    assert kinds == {"none", "camera", "target", "motion", "optics", "sensor", "transport"}
    assert len(statistics.MODELS) > 40


def test_a_lost_line_moves_what_follows_up() -> None:
    lost = statistics.rows_lost(60, 1)(FRAMES)
    assert torch.equal(lost[:, :60], FRAMES[:, :60])
    assert torch.equal(lost[:, 60:-1], FRAMES[:, 61:])
    assert lost.shape == FRAMES.shape


def test_rows_move_by_the_shift_theorem() -> None:
    """Against a sine that is moved exactly."""
    import numpy as np

    u = torch.arange(160.0)
    wave = torch.sin(2 * torch.pi * u / 32).expand(1, 8, -1)
    moved = statistics.rows_moved(lambda rows: np.full(rows, 0.3))(wave)
    exact = torch.sin(2 * torch.pi * (u - 0.3) / 32)
    torch.testing.assert_close(moved[0, 4, 40:-40], exact[40:-40], rtol=0, atol=2e-3)

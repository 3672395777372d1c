"""What cameras beside their places leave possible, beside a draw of everything that may be."""

from dataclasses import fields

import pytest
import torch
from torch import Tensor

from torchpose.moments.joint import JointPose
from torchpose.moments.places import _second_moment, widened

F64 = torch.float64
STEPS = 2000


def told(seed: int, strength: float) -> tuple[Tensor, Tensor]:
    """Information and right side about the places of two cameras."""
    g = torch.Generator().manual_seed(seed)
    root = torch.randn(12, 12, dtype=F64, generator=g)
    information = root @ root.mT
    noise = torch.linalg.cholesky(information) @ torch.randn(12, dtype=F64, generator=g)
    knocked = torch.zeros(12, dtype=F64)
    knocked[7] = strength / information[7, 7].sqrt()
    return information, information @ knocked + noise


@pytest.mark.parametrize("strength", [0.0, 3.0])
def test_mean_squares_are_those_of_all_that_may_be(strength: float) -> None:
    information, right = told(1, strength)
    total, weights = torch.zeros(12, 12, dtype=F64), 0.0
    some = [[0, 1], [6, 7], [*range(6)], [*range(6, 12)], [*range(12)]]
    decades = 4 * (torch.arange(STEPS, dtype=F64) + 0.5) / STEPS - 1
    for index in some:
        own, pull, count = information[index][:, index], right[index], len(index)
        size = 10**decades / torch.linalg.eigvalsh(own)[-1].sqrt()
        # normal numbers of these sizes, and what the data say of them (Bayes)
        spread = torch.linalg.inv(own + torch.eye(count, dtype=F64) / size[:, None, None] ** 2)
        mean = spread @ pull
        weight = (0.5 * mean @ pull + 0.5 * torch.logdet(spread) - count * size.log()).exp() / (len(some) * STEPS)
        weights += float(weight.sum())
        full = torch.zeros(12, 12, dtype=F64)
        full[torch.tensor(index)[:, None], torch.tensor(index)] = torch.einsum(
            "g,gij->ij", weight, spread + mean[:, :, None] * mean[:, None]
        )
        total += full
    expected = total / (1 + weights)
    found = _second_moment(information, right)
    scale = expected.diagonal().sqrt()
    # steps of 1.5 against many small ones
    assert float(((found - expected) / (scale[:, None] * scale)).abs().max()) < 0.1


def pose_of(information: Tensor, right: Tensor, rows: int) -> JointPose:
    """Rows that all tell the same of the places, beside one number that they share."""
    g = torch.Generator().manual_seed(3)
    shared = torch.zeros(13, 13, dtype=F64)
    shared[1:, 1:] = information
    values = {
        "R": torch.eye(3, dtype=F64).expand(rows, 3, 3),
        "t": torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(rows, 3),
        "covariance": torch.eye(6, dtype=F64).expand(rows, 6, 6),
        "told": shared.expand(rows, 13, 13),
        "pull": torch.cat([torch.zeros(1, dtype=F64), right]).expand(rows, 13),
        "by_place": torch.randn(rows, 6, 12, dtype=F64, generator=g),
        "known": torch.ones(rows, dtype=torch.bool),
    }
    shapes = {"noise": (6, 6), "systematic": (6, 1), "place": (4, 5), "look": (4, 5), "share": (2,)}
    kinds = dict.fromkeys(("misfit", "freedom", "between_freedom", "odd"), torch.int64)
    kinds |= {"explained": torch.bool, "torn": torch.bool}
    for field in fields(JointPose):
        empty = torch.zeros(rows, *shapes.get(field.name, ()), dtype=kinds.get(field.name, F64))
        values.setdefault(field.name, empty)
    return JointPose(**values)


def test_moments_add_up() -> None:
    information, right = told(1, 0.0)
    four = widened(pose_of(information, right, 4), torch.ones(4, dtype=torch.bool))
    moment = _second_moment(4 * information, 4 * right)
    expected = torch.eye(6, dtype=F64) + four.by_place @ moment @ four.by_place.mT
    torch.testing.assert_close(four.covariance, expected)
    # rows that are rejected tell nothing, and nothing told widens nothing
    seen = torch.tensor([True, False, False, False])
    alone = widened(pose_of(information, right, 4), seen)
    by = alone.by_place[:1]
    expected = torch.eye(6, dtype=F64) + by @ _second_moment(information, right) @ by.mT
    torch.testing.assert_close(alone.covariance[:1], expected)
    none = widened(pose_of(information, right, 4), ~seen & seen)
    assert torch.equal(none.covariance, torch.eye(6, dtype=F64).expand(4, 6, 6))

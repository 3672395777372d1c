"""Poses moved to other frames, against composed transforms and propagated covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch

from torchpose.geometry import rotations
from torchpose.results import Detections, Poses, Status


def detections(count: int = 3) -> Detections:
    generator = torch.Generator().manual_seed(3)

    def floats(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    index = torch.arange(count)
    return Detections(index % 2, 0 * index, 0 * index, index + 2**40, floats(2), floats(2, 2), floats(5), floats(5))


@pytest.fixture
def poses() -> Poses:
    generator = torch.Generator().manual_seed(8)

    def floats(*shape: int) -> torch.Tensor:
        return torch.randn(4, *shape, generator=generator, dtype=torch.float64)

    root = floats(6, 6)
    status = torch.tensor([Status.OK, Status.AMBIGUOUS, Status.OK, Status.NO_TARGET])
    result = Poses(
        frame=torch.arange(4),
        target=torch.zeros(4, dtype=torch.int64),
        instance=torch.zeros(4, dtype=torch.int64),
        copies=torch.ones(4, dtype=torch.int64),
        R=rotations.exp(floats(3)),
        t=100 * floats(3),
        covariance=root @ root.mT,
        noise=0.25 * root @ root.mT,
        systematic=0.75**0.5 * root,
        place=torch.zeros(4, 4, 5, dtype=torch.float64),
        misfit=torch.zeros(4, dtype=torch.int64),
        residual_chi2=torch.zeros(4, dtype=torch.float64),
        freedom=torch.zeros(4, dtype=torch.int64),
        rms=floats().abs(),
        status=status,
        reason=torch.zeros(4, dtype=torch.int64),
        markers=torch.full((4,), 4),
        chi2=floats().abs(),
        R_alt=rotations.exp(floats(3)),
        t_alt=floats(3),
        rms_alt=floats().abs(),
        chi2_alt=floats().abs(),
        detections=detections(),
    )
    for name in ("R", "t", "covariance", "noise", "systematic"):
        getattr(result, name)[3] = torch.nan
    return result


TRANSFORM = rotations.exp(torch.tensor([0.3, -1.1, 0.4]).double()), torch.tensor([5.0, -20, 70]).double()


def numeric_covariance(poses: Poses, change: Callable[..., Any]) -> torch.Tensor:
    """Covariance of the changed pose from central differences of the left-multiplied state (t, w)."""
    step, columns = 1e-6, []
    base = change(poses)
    for k in range(6):
        ends = []
        for sign in (1, -1):
            d = torch.zeros(6, dtype=torch.float64)
            d[k] = sign * step
            R, t = rotations.exp(d[3:]) @ poses.R, poses.t + d[:3]
            moved = change(Poses(**{**{f.name: getattr(poses, f.name) for f in fields(poses)}, "R": R, "t": t}))
            ends.append(torch.cat([moved.t, rotations.log(moved.R @ base.R.mT)], -1))
        columns.append((ends[0] - ends[1]) / (2 * step))
    jacobian = torch.stack(columns, -1)
    return jacobian @ poses.covariance @ jacobian.mT


def test_moved(poses: Poses) -> None:
    r, t = TRANSFORM
    x_target = torch.randn(3, dtype=torch.float64)
    x_part = r @ x_target + t
    moved = poses.moved(r, t)
    torch.testing.assert_close((moved.R @ x_part + moved.t)[:3], (poses.R @ x_target + poses.t)[:3])
    torch.testing.assert_close(moved.R_alt @ x_part + moved.t_alt, poses.R_alt @ x_target + poses.t_alt)
    expected = numeric_covariance(poses[:3], lambda p: p.moved(r, t))
    torch.testing.assert_close(moved.covariance[:3], expected, rtol=1e-6, atol=1e-5)
    assert moved.t[3].isnan().all()


@pytest.mark.parametrize("batched", [False, True])
def test_seen_from(poses: Poses, batched: bool) -> None:
    r, t = TRANSFORM
    if batched:
        r, t = r.expand(4, 3, 3), t.expand(4, 3)
    x = torch.randn(3, dtype=torch.float64)
    seen = poses.seen_from(r, t)
    x_camera = poses.R @ x + poses.t
    torch.testing.assert_close((seen.R @ x + seen.t)[:3], (x_camera @ TRANSFORM[0].mT + TRANSFORM[1])[:3])
    expected = numeric_covariance(poses[:3], lambda p: p.seen_from(TRANSFORM[0], TRANSFORM[1]))
    torch.testing.assert_close(seen.covariance[:3], expected, rtol=1e-6, atol=1e-6)


def test_moving_back(poses: Poses) -> None:
    r, t = TRANSFORM
    back = poses.moved(r, t).moved(*rotations.inverse(r, t))
    for name in ("R", "t", "covariance", "R_alt", "t_alt"):
        torch.testing.assert_close(getattr(back, name), getattr(poses, name), equal_nan=True, rtol=1e-9, atol=1e-9)


def test_columns(poses: Poses) -> None:
    assert len(poses) == 4
    assert poses.ok.tolist() == [True, False, True, False]
    torch.testing.assert_close(rotations.exp(poses.rotation_vector[:3]), poses.R[:3])
    torch.testing.assert_close(poses.std[:3].square(), poses.covariance[:3].diagonal(dim1=1, dim2=2))
    assert poses.rotation_vector[3].isnan().all()
    assert poses.std[3].isnan().all()


def test_selection_keeps_the_detections(poses: Poses) -> None:
    picked = poses[poses.ok]
    assert picked.frame.tolist() == [0, 2]
    assert torch.equal(picked.t, poses.t[[0, 2]])
    assert picked.detections is poses.detections
    assert len(poses[:0]) == 0
    assert poses.detections[torch.tensor([2, 0])].frame.tolist() == [0, 0]


@pytest.mark.parametrize("target", [torch.float32, "meta"])
def test_to_reaches_everything(poses: Poses, target: str | torch.dtype) -> None:
    moved = poses.to(target)
    for bundle, original in ((moved, poses), (moved.detections, poses.detections)):
        for f in fields(bundle):
            value, before = getattr(bundle, f.name), getattr(original, f.name)
            if not isinstance(value, torch.Tensor):
                continue
            if target == "meta":
                assert (value.device.type, value.dtype) == ("meta", before.dtype)
            else:
                assert value.dtype == (torch.float32 if before.is_floating_point() else before.dtype)
    if target == torch.float32:
        # ids beyond the 24 bits of a float32 survive
        assert torch.equal(moved.detections.marker, poses.detections.marker)


def drawn(rows: int, numbers: int, of_camera: int, seed: int = 4) -> tuple[Poses, torch.Tensor, torch.Tensor]:
    """True poses, and how they err with noise of their own and numbers that they share."""
    g = torch.Generator().manual_seed(seed)

    def floats(*shape: int) -> torch.Tensor:
        return torch.randn(rows, *shape, generator=g, dtype=torch.float64)

    noise, systematic = 1e-4 * floats(6, 6), 1e-3 * floats(6, numbers)
    noise = noise @ noise.mT
    none = floats() * torch.nan
    whole = torch.zeros(rows, dtype=torch.int64)
    poses = Poses(
        frame=torch.arange(rows),
        target=torch.arange(rows) % 2,
        instance=whole,
        copies=whole + 1,
        R=rotations.exp(floats(3)),
        t=floats(3),
        covariance=noise + systematic @ systematic.mT,
        noise=noise,
        systematic=systematic,
        place=torch.zeros(rows, 4, 5, dtype=torch.float64),
        misfit=whole,
        residual_chi2=none,
        freedom=whole,
        rms=none,
        status=whole.clone(),
        reason=whole,
        markers=whole + 4,
        chi2=none,
        R_alt=none[:, None, None].expand(-1, 3, 3),
        t_alt=none[:, None].expand(-1, 3),
        rms_alt=none,
        chi2_alt=none,
        detections=detections(),
        of_camera=of_camera,
    )
    return poses, noise, systematic


@pytest.mark.parametrize(("i", "j"), [(0, 2), (0, 1)])
def test_motions_have_the_covariance_of_their_scatter(i: int, j: int) -> None:
    """20,000 draws: of one target all its numbers cancel as far as they do, of two targets the camera's alone."""
    poses, noise, systematic = drawn(4, 5, 2)
    motion, draws, g = poses.between(i, j), 20000, torch.Generator().manual_seed(9)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    lens, prints = normal(draws, 2), normal(2, draws, 3)
    seen = []
    for row, of in ((i, 0), (j, 0 if i % 2 == j % 2 else 1)):
        error = normal(draws, 6) @ torch.linalg.cholesky(noise[row]).T
        error = error + torch.cat([lens, prints[of]], -1) @ systematic[row].T
        seen.append((rotations.exp(error[:, 3:]) @ poses.R[row], poses.t[row] + error[:, :3]))
    (r_i, t_i), (r_j, t_j) = seen
    r, t = r_i.mT @ r_j, (r_i.mT @ (t_j - t_i)[..., None])[..., 0]
    error = torch.cat([t - motion.t, rotations.log(r @ motion.R.mT)], -1)
    scatter = error.T @ error / draws
    root = torch.linalg.cholesky(motion.covariance[0])
    whitened = torch.linalg.solve_triangular(
        root, torch.linalg.solve_triangular(root, scatter, upper=False).T, upper=False
    )
    torch.testing.assert_close(whitened, torch.eye(6, dtype=torch.float64), rtol=0, atol=0.06)
    torch.testing.assert_close(poses.R[j], poses.R[i] @ motion.R[0], rtol=0, atol=1e-12)


def test_one_part_in_the_frame_of_another() -> None:
    poses, _, _ = drawn(4, 5, 2)
    poses = replace(poses, frame=torch.tensor([0, 0, 1, 1]))
    poses.status[2] = Status.AMBIGUOUS
    inside = poses.relative_to(0)
    assert inside.target.tolist() == [1, 1]
    assert inside.frame.tolist() == [0, 1]
    assert inside.status.tolist() == [Status.OK, Status.AMBIGUOUS]
    expected = poses.between(torch.tensor([0, 2]), torch.tensor([1, 3]))
    torch.testing.assert_close(inside.t, expected.t)
    torch.testing.assert_close(inside.covariance, expected.covariance)


def test_a_motion_from_many_rows_to_one() -> None:
    poses, _, _ = drawn(3, 5, 2)
    expected = poses.between(torch.tensor([0, 1]), torch.tensor([2, 2]))
    torch.testing.assert_close(poses.between(torch.tensor([0, 1]), 2).covariance, expected.covariance)


def test_no_row_is_in_the_frame_of_a_reference_that_is_not_there() -> None:
    poses, _, _ = drawn(5, 5, 2)
    poses = replace(poses, frame=torch.tensor([0, 0, 1, 2, 2]), target=torch.tensor([0, 1, 1, 0, 1]))
    inside = poses.relative_to(0)
    assert inside.status.tolist() == [Status.OK, Status.NO_TARGET, Status.OK]
    assert inside.covariance.isfinite().flatten(1).all(1).tolist() == [True, False, True]
    assert inside.t.isfinite().all(1).tolist() == [True, False, True]
    assert poses.relative_to(7).status.tolist() == [Status.NO_TARGET] * 5
    assert len(poses[:0].relative_to(0)) == 0


def test_the_first_copy_of_a_reference_counts() -> None:
    poses, _, _ = drawn(3, 5, 2)
    poses = replace(
        poses,
        frame=torch.tensor([0, 0, 0]),
        target=torch.tensor([0, 0, 1]),
        instance=torch.tensor([0, 1, 0]),
    )
    torch.testing.assert_close(poses.relative_to(0).t, poses.between(0, 2).t)

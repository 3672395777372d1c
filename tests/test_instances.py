"""Several copies of a target in a frame, from grey values to rows: every copy once, none mixed, from left to right."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import F64, pinhole
from torchpose.geometry import rotations
from torchpose.sim import add_noise, shapes
from torchpose.sim.shapes import Shapes
from torchpose.sim.trays import moved, render_tray

QUAD = tp.Target.load("quad40")
CAMERA = dataclasses.replace(pinhole(), distortion=torch.tensor([-0.08, 0.02, 0, 0], dtype=F64))


def side_by_side(columns: int, rows: int, depth: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Touching plates of 70 mm in one tilted plane, each turned by quarter turns."""
    g = torch.Generator().manual_seed(seed)
    base = rotations.exp(torch.tensor([0.25, -0.15, 0.1], dtype=F64))
    i, j = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="ij")
    at = torch.stack([i - (columns - 1) / 2, j - (rows - 1) / 2, 0.0 * i], -1).flatten(0, 1).to(F64) * 70.0
    turn = torch.zeros_like(at)
    turn[:, 2] = torch.randint(0, 4, (len(at),), generator=g) * (math.pi / 2)
    return base @ rotations.exp(turn), at @ base.T + torch.tensor([0.0, 0.0, depth], dtype=F64)


def picture(R: Tensor, t: Tensor, covers: Shapes | None = None, noise: float = 1.5) -> Tensor:
    return add_noise(render_tray(CAMERA, QUAD, R, t, plate=(70.0, 70.0), covers=covers)[None], noise, seed=3)


def assert_every_copy_once(poses: tp.Poses, R: Tensor, t: Tensor) -> None:
    """One row a copy, in order, its pose within its covariance and its detections its own."""
    order = CAMERA.project(t)[:, 0].argsort()
    assert poses.instance.tolist() == list(range(len(t)))
    assert poses.ok.all()
    assert (poses.copies == len(t)).all()
    error = torch.cat([poses.t - t[order], rotations.log(poses.R @ R[order].mT)], -1)
    nees = (error[:, None] @ torch.linalg.inv(poses.covariance) @ error[..., None]).flatten()
    assert nees.max() < 40  # chance gives 34 once in 100,000
    seen = poses.detections
    place = QUAD.centers[seen.marker]
    of = order[seen.instance]
    true = CAMERA.project((R[of] @ place[..., None]).squeeze(-1) + t[of])
    assert torch.linalg.vector_norm(seen.center - true, dim=-1).max() < 1.0


@pytest.mark.parametrize(("columns", "rows", "depth"), [(2, 1, 280.0), (3, 2, 400.0), (5, 4, 640.0)])
def test_touching_plates(columns: int, rows: int, depth: float) -> None:
    R, t = side_by_side(columns, rows, depth)
    poses = tp.PoseEstimator(CAMERA, QUAD, instances=30)(picture(R, t))
    assert_every_copy_once(poses, R, t)
    assert (poses.markers == 4).all()


def test_partly_covered_plates() -> None:
    """Three of six copies with a ring wholly under a square, and a quarter of another one under a strip."""
    R, t = side_by_side(3, 2, 400.0, seed=1)
    covers = []
    for copy in (0, 3, 4):
        (x, y, _), (a, b, _) = QUAD.centers[copy % 4].tolist(), QUAD.centers[(copy + 2) % 4].tolist()
        covers.append(moved(shapes.rectangle((x, y), 12.0, 12.0, level=140.0), R[copy], t[copy]))
        covers.append(moved(shapes.rectangle((a + 4.8, b), 2.5, 10.0, level=120.0), R[copy], t[copy]))
    poses = tp.PoseEstimator(CAMERA, QUAD, instances=10)(picture(R, t, Shapes.cat(covers)))
    assert_every_copy_once(poses, R, t)
    order = CAMERA.project(t)[:, 0].argsort()
    assert poses.markers.tolist() == [3 if copy in (0, 3, 4) else 4 for copy in order.tolist()]


def test_plates_of_different_planes() -> None:
    """Loose parts, each tilted its own way, two of them with touching edges."""
    R = rotations.exp(torch.tensor([[0.5, 0.1, 0.4], [-0.4, 0.2, 1.2], [0.1, -0.6, -0.8]], dtype=F64))
    t = torch.tensor([[-75.0, -20, 330], [0.0, 20, 330], [85.0, -10, 340]], dtype=F64)
    poses = tp.PoseEstimator(CAMERA, QUAD, instances=3)(picture(R, t))
    assert_every_copy_once(poses, R, t)


def test_fewer_rows_than_copies_are_the_best_supported() -> None:
    R, t = side_by_side(3, 1, 330.0)
    cover = moved(shapes.rectangle((20.0, 20.0), 12.0, 12.0, level=140.0), R[1], t[1])
    frame = picture(R, t, cover)
    poses = tp.PoseEstimator(CAMERA, QUAD, instances=2)(frame)
    assert poses.instance.tolist() == [0, 1]
    assert poses.copies.tolist() == [3, 3]
    assert torch.cdist(poses.t, t).argmin(1).tolist() == [0, 2]
    one = tp.PoseEstimator(CAMERA, QUAD)(frame)
    assert len(one) == 1
    assert one.ok.all()
    assert (one.markers[0], one.copies[0], one.instance[0]) == (4, 3, 0)


def test_rows_of_frames_with_and_without_copies() -> None:
    """Two copies, none and one of a target, beside one that is nowhere: at least a row each, as in each frame alone."""
    R, t = side_by_side(2, 1, 280.0)
    frames = torch.cat(
        [picture(R, t), torch.full((1, CAMERA.height, CAMERA.width), 128, dtype=torch.uint8), picture(R[:1], t[:1])]
    )
    estimator = tp.PoseEstimator(CAMERA, [QUAD, tp.Target.load("quad40_dark")], instances=4)
    poses = estimator(frames)
    assert poses.frame.tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert poses.target.tolist() == [0, 0, 1, 0, 1, 0, 1]
    assert poses.instance.tolist() == [0, 1, 0, 0, 0, 0, 0]
    assert poses.copies.tolist() == [2, 2, 0, 0, 0, 1, 0]
    assert poses.ok.tolist() == [True, True, False, False, False, True, False]
    for i in range(3):
        alone = estimator(frames[i : i + 1])
        own = poses[poses.frame == i]
        assert alone.status.tolist() == own.status.tolist()
        torch.testing.assert_close(alone.t, own.t, rtol=0, atol=1e-6, equal_nan=True)
    assert sorted({*zip(poses.detections.frame.tolist(), poses.detections.instance.tolist(), strict=True)}) == [
        (0, 0),
        (0, 1),
        (2, 0),
    ]


def test_one_copy_is_the_same_with_and_without_instances() -> None:
    R, t = side_by_side(1, 1, 200.0)
    frame = picture(R, t)
    one, several = (tp.PoseEstimator(CAMERA, QUAD, instances=k)(frame) for k in (1, 8))
    assert len(several) == 1
    assert torch.equal(one.copies, several.copies)
    assert torch.equal(one.instance, several.instance)
    # the rings are found at one scale or another: the same pose to a fiftieth of its deviations
    deviations = one.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((one.t - several.t).abs() < 0.02 * deviations[:, :3]).all()
    torch.testing.assert_close(one.covariance, several.covariance, rtol=0.02, atol=1e-12)


def test_targets_that_look_alike_are_refused() -> None:
    """Whatever their names, ids, scale and frame of reference."""
    turn = rotations.exp(torch.tensor([0.0, 0.0, 0.7], dtype=F64))
    same = dataclasses.replace(QUAD, name="twin", ids=QUAD.ids + 10, centers=QUAD.centers @ turn.T + 5)
    double = dataclasses.replace(QUAD, name="twin", centers=2 * QUAD.centers, radii=2 * QUAD.radii)
    for other in (same, double):
        with pytest.raises(tp.ConfigError, match=r"'quad40' and 'twin' cannot be told apart.*--instances"):
            tp.PoseEstimator(CAMERA, [QUAD, other])


def test_targets_that_differ_are_not_refused() -> None:
    mirrored = QUAD.centers * torch.tensor([-1.0, 1, 1], dtype=F64)
    swapped, wider = QUAD.centers[[1, 0, 2, 3]], QUAD.centers * torch.tensor([1.0, 1.05, 1], dtype=F64)
    for centers in (mirrored, swapped, wider):
        tp.PoseEstimator(CAMERA, [QUAD, dataclasses.replace(QUAD, name="other", centers=centers)])
    tp.PoseEstimator(CAMERA, [QUAD, dataclasses.replace(QUAD, name="other", background="dark")])


@pytest.mark.parametrize("instances", [0, -1])
def test_no_copies_are_refused(instances: int) -> None:
    with pytest.raises(tp.ConfigError, match="instances"):
        tp.PoseEstimator(CAMERA, QUAD, instances=instances)

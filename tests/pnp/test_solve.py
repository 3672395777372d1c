"""`solve`: accuracy beside OpenCV and scipy, covariance, codes, options, gradients."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.pnp.scenes import CUBOID, F64, FOCAL, GRID, MATRIX, SQUARE, errors, pixels, project, views
from torchpose import ConfigError, kernels, pnp
from torchpose.camera import Camera
from torchpose.errors import ArgumentError
from torchpose.geometry import rotations
from torchpose.pnp import PnPCode, PnPResult
from torchpose.pnp.verdict import relevant

LENS = Camera(1280, 960, [[1111.0, 0, 640], [0, 1115, 480], [0, 0, 1]], [-0.2, 0.05, 1e-3, -5e-4, 0.01])
FISHEYE = Camera(1280, 960, [[700.0, 0, 640], [0, 702, 480], [0, 0, 1]], [0.02, -0.01, 0.003, 0.0], "kannala_brandt")


def mahalanobis(result: PnPResult, r: Tensor, t: Tensor) -> Tensor:
    """Squared, by the documented order: translation first, rotation from the left."""
    error = torch.cat([t - result.t, rotations.log(r @ result.R.mT)], -1)[..., None]
    return (error.mT @ torch.linalg.solve(result.covariance, error)).flatten()


@pytest.mark.parametrize("points", [SQUARE, GRID, CUBOID, CUBOID[:5]], ids=["4", "9", "solid", "solid-5"])
@pytest.mark.parametrize("camera", [MATRIX, LENS, FISHEYE], ids=["matrix", "brown-conrady", "kannala-brandt"])
def test_exact_points_give_the_exact_pose(points: Tensor, camera: Camera | Tensor) -> None:
    r, t, xy = views(points, 100, tilt_deg=(20, 60))
    image = pixels(xy) if isinstance(camera, Tensor) else camera.distort(xy)
    result = pnp.solve(points, image, camera, sigma_px=0.01)
    angle, distance = errors(result.R, result.t, r, t)
    assert bool(result.converged.all())
    assert angle.max() < 1e-9
    assert distance.max() < 1e-9
    assert result.rms.max() < 1e-8


def test_arrays_are_taken_as_tensors() -> None:
    r, t, xy = views(GRID, 6, tilt_deg=(20, 60))
    weights, image = torch.linspace(0.5, 1, 9, dtype=F64), pixels(xy)
    wanted = pnp.solve(GRID, image, MATRIX, initial=(r, t), weights=weights)
    arrays: list[Any] = [value.numpy() for value in (GRID, image, MATRIX, weights, r, t)]
    found = pnp.solve(*arrays[:3], initial=(arrays[4], arrays[5]), weights=arrays[3])
    torch.testing.assert_close(found.t, wanted.t, rtol=0, atol=0)


@pytest.mark.parametrize("camera", [MATRIX, LENS], ids=["matrix", "lens"])
def test_cost_equals_the_optimum_of_scipy(camera: Camera | Tensor) -> None:
    r, t, xy = views(GRID, 20, tilt_deg=(20, 60))
    lens = Camera(1280, 960, camera, []) if isinstance(camera, Tensor) else camera
    noise = torch.randn(xy.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    image = lens.distort(xy) + 0.3 * noise
    result = pnp.solve(GRID, image, camera, sigma_px=0.3)
    for i in range(20):

        def residual(step: np.ndarray, i: int = i) -> np.ndarray:
            x = torch.from_numpy(step)
            moved = GRID @ rotations.exp(x[:3]).T @ r[i].T + t[i] + x[3:]
            return ((lens.project(moved) - image[i]) / 0.3).flatten().numpy()

        best = least_squares(residual, np.zeros(6), method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert float(result.chi2[i]) == pytest.approx(2 * best.cost, rel=1e-9)
        assert float(result.rms[i]) == pytest.approx(0.3 * math.sqrt(2 * best.cost / 9), rel=1e-7)


@pytest.mark.parametrize("points", [SQUARE, GRID], ids=["4", "9"])
def test_cost_is_never_above_that_of_opencv(points: Tensor) -> None:
    _, _, xy = views(points, 200, tilt_deg=(0, 75))
    image = pixels(xy, 0.2)
    result = pnp.solve(points, image, MATRIX, sigma_px=0.2)
    for i in range(200):
        _, rvec, tvec = cv2.solvePnP(points.numpy(), image[i].numpy(), MATRIX.numpy(), None)
        theirs, _ = cv2.projectPoints(points.numpy(), rvec, tvec, MATRIX.numpy(), None)
        cost = float(((torch.from_numpy(theirs[:, 0]) - image[i]) / 0.2).square().sum())
        assert float(result.chi2[i]) <= cost * (1 + 1e-6)


def test_covariance_is_the_scatter_of_the_poses() -> None:
    points = CUBOID + torch.tensor([30.0, -20, 50], dtype=F64)  # off the origin: translation and rotation correlate
    r, t, _ = views(CUBOID, 1, seed=5)
    t = t - r @ torch.tensor([30.0, -20, 50], dtype=F64)
    result = pnp.solve(points, pixels(project(points, r, t).expand(4000, -1, -1), 0.2), MATRIX, sigma_px=0.2)
    assert bool(result.converged.all())
    squared = mahalanobis(result, r, t)
    # mean of a chi-squared with six degrees of freedom over 4000: standard deviation 0.055
    assert float(squared.mean()) == pytest.approx(6, abs=0.25)
    assert float((squared > 16.81).double().mean()) == pytest.approx(0.01, abs=0.006)


def test_covariances_and_weights_of_points_enter_as_they_should() -> None:
    g = torch.Generator().manual_seed(1)
    r, t, xy = views(CUBOID, 1500)
    root = 0.3 * torch.randn(1500, 8, 2, 2, generator=g, dtype=F64) + 0.05 * torch.eye(2, dtype=F64)
    image = pixels(xy) + (root @ torch.randn(1500, 8, 2, 1, generator=g, dtype=F64)).squeeze(-1)
    result = pnp.solve(CUBOID, image, MATRIX, covariances=root @ root.mT)
    assert float(mahalanobis(result, r, t)[result.converged].mean()) == pytest.approx(6, abs=0.45)
    assert float(result.chi2[result.converged].mean()) == pytest.approx(10, abs=0.6)
    # a scalar covariance, the same as sigma, the same as a weight
    image = pixels(xy[:50], 0.2)
    eye = 0.04 * torch.eye(2, dtype=F64).expand(8, 2, 2)
    by_sigma = pnp.solve(CUBOID, image, MATRIX, sigma_px=0.2)
    by_covariance = pnp.solve(CUBOID, image, MATRIX, covariances=eye)
    by_weight = pnp.solve(CUBOID, image, MATRIX, weights=torch.full((50, 8), 25.0, dtype=F64))
    for other in (by_covariance, by_weight):
        torch.testing.assert_close(other.covariance, by_sigma.covariance, rtol=1e-6, atol=1e-14)
        torch.testing.assert_close(other.t, by_sigma.t, rtol=1e-8, atol=1e-8)


def test_uncertain_intrinsics_widen_the_covariance_as_finite_differences_say() -> None:
    sigma = torch.diag(torch.tensor([4.0, 5.0, 1.0, 2.0], dtype=F64))
    sigma[0, 1] = sigma[1, 0] = 3.0
    _, _, xy = views(CUBOID, 4)
    image = LENS.distort(xy)
    wide = Camera(LENS.width, LENS.height, LENS.matrix, LENS.distortion, covariance=sigma)
    narrow, widened = (pnp.solve(CUBOID, image, c, sigma_px=0.1) for c in (LENS, wide))
    columns = []
    for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)):
        shifted = []
        for sign in (-1, 1):
            matrix = LENS.matrix.clone()
            matrix[row, column] += sign * 1e-3
            shifted.append(pnp.solve(CUBOID, image, Camera(1280, 960, matrix, LENS.distortion), sigma_px=0.1))
        low, high = shifted
        change = torch.cat([high.t - low.t, rotations.log(high.R @ low.R.mT)], -1)
        columns.append(change / 2e-3)
    slope = torch.stack(columns, -1)
    torch.testing.assert_close(widened.covariance, narrow.covariance + slope @ sigma @ slope.mT, rtol=0.01, atol=1e-7)


def test_random_planar_scenes_obey_their_covariance() -> None:
    from scripts import pnp_statistics

    row = pnp_statistics.table(pnp_statistics.run(14_000, seed=1))[0]
    assert 5.7 < row["decided_nees"] < 6.3
    assert row["decided_converged"] > 0.95
    assert row["wrong_per_10000"] <= 1
    converged = row["decided"] * row["decided_converged"] + (1 - row["decided"]) * row["rest_converged"]
    assert converged > 0.66, "flagging everything is no way out"


def test_no_pose_creeps_off_a_saddle() -> None:
    """Other minima that start near a saddle held the whole batch up."""
    from scripts import bench_pnp

    for points in bench_pnp.TARGETS.values():
        result = pnp.solve(points, bench_pnp.scene(points, 65536), bench_pnp.MATRIX, sigma_px=bench_pnp.SIGMA_PX)
        assert int(result.iterations.max()) <= 25, "38 with the steps of Gauss-Newton as they are"
        assert not bool((result.code > pnp.PnPCode.AMBIGUOUS).any())


def test_a_frontal_view_is_not_ambiguous_and_a_far_tilted_one_is() -> None:
    _, _, xy = views(GRID, 40, tilt_deg=(0.0, 0.0), near=4, far=4)
    assert bool(pnp.solve(GRID, pixels(xy), MATRIX, sigma_px=0.05).converged.all())
    r, _, xy = views(SQUARE, 40, tilt_deg=(30, 30), near=80, far=80)
    result = pnp.solve(SQUARE, pixels(xy), MATRIX, sigma_px=0.3)
    assert bool((result.code == PnPCode.AMBIGUOUS).all())
    best = rotations.angle_between(torch.stack([result.R, result.R_alt]), r).amin(0)
    assert best.max() < 1e-4, "exact points: one of both minima is the truth"
    assert bool((result.rms_alt >= result.rms).all())
    torch.testing.assert_close(result.ratio, result.rms_alt / result.rms)


def _nothing(result: PnPResult) -> bool:
    floats = [getattr(result, f.name) for f in fields(result)]
    return all(bool(v.isnan().all()) for v in floats if v.is_floating_point())


def test_code_of_collinear_points() -> None:
    line = torch.tensor([[x, 2 * x, 5.0] for x in (-20, -5, 3, 20, 30)], dtype=F64)
    result = pnp.solve(line, pixels(project(line, *views(line, 5)[:2])), MATRIX)
    assert bool((result.code == PnPCode.DEGENERATE).all())
    assert _nothing(result)


def test_code_of_coincident_points() -> None:
    for spot in (torch.zeros(4, 3, dtype=F64), torch.full((4, 3), 7.0, dtype=F64)):
        result = pnp.solve(spot, pixels(views(SQUARE, 5)[2]), MATRIX)
        assert bool((result.code == PnPCode.DEGENERATE).all())
        assert _nothing(result)


def test_code_of_points_of_which_only_a_line_was_seen() -> None:
    _, _, xy = views(GRID, 4)
    mask = torch.zeros(4, 9, dtype=torch.bool)
    mask[:2, [0, 1, 2]] = True  # three of a row
    mask[2:, [0, 4, 8]] = True
    wide = torch.cat([GRID, GRID[:1] + torch.tensor([60.0, 0, 0], dtype=F64)])
    xy = torch.cat([xy, xy[:, :1]], 1)
    mask = torch.cat([mask, torch.tensor([[True], [True], [False], [False]])], 1)
    result = pnp.solve(wide, pixels(xy), MATRIX, mask=mask)
    assert result.code.tolist() == [PnPCode.DEGENERATE] * 2 + [PnPCode.TOO_FEW] * 2


def test_code_of_too_few_points() -> None:
    _, _, xy = views(SQUARE, 3)
    assert bool((pnp.solve(SQUARE[:3], pixels(xy[:, :3]), MATRIX).code == PnPCode.TOO_FEW).all())
    mask = torch.tensor([[True, True, True, False], [True] * 4, [False] * 4])
    result = pnp.solve(SQUARE, pixels(xy), MATRIX, mask=mask)
    assert result.code[[0, 2]].tolist() == [PnPCode.TOO_FEW] * 2
    assert int(result.code[1]) <= PnPCode.AMBIGUOUS
    assert bool(result.t[[0, 2]].isnan().all())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_code_of_numbers_that_are_none(bad: float) -> None:
    r, t, xy = views(SQUARE, 4)
    image = pixels(xy)
    image[1, 2, 0] = bad
    own = SQUARE.repeat(4, 1, 1)
    own[2, 0, 1] = bad
    result = pnp.solve(own, image, MATRIX, sigma_px=0.01)
    assert result.code[[1, 2]].tolist() == [PnPCode.NOT_FINITE] * 2
    assert bool(result.t[[1, 2]].isnan().all())
    angle, _ = errors(result.R[[0, 3]], result.t[[0, 3]], r[[0, 3]], t[[0, 3]])
    assert angle.max() < 1e-6, "the others are not touched by it"
    covariances = torch.eye(2, dtype=F64).repeat(4, 4, 1, 1)
    covariances[3, 1] = torch.tensor([[1.0, 2.0], [2.0, 1.0]])
    assert int(pnp.solve(SQUARE, pixels(xy), MATRIX, covariances=covariances).code[3]) == PnPCode.NOT_FINITE


def test_code_of_points_behind_the_camera() -> None:
    r, t, _ = views(CUBOID, 20)
    behind = pnp.solve(CUBOID, pixels(project(CUBOID, r, -t)), MATRIX)
    assert bool((behind.code == PnPCode.BEHIND_CAMERA).all())
    # of a plane through the camera, some points lie behind
    through = torch.tensor([[0.0, 0.0, 10.0]], dtype=F64)
    steep = rotations.exp(torch.tensor([[1.2, 0.0, 0.0]], dtype=F64))
    image = pixels(project(GRID, steep, through))
    result = pnp.solve(GRID, image, MATRIX, sigma_px=0.1)
    assert result.code.tolist() == [PnPCode.BEHIND_CAMERA]
    assert _nothing(result)
    start = pnp.solve(CUBOID, pixels(project(CUBOID, r, t)), MATRIX, initial=(r, -t))
    assert bool((start.code == PnPCode.BEHIND_CAMERA).all())


def test_six_points_of_which_epnp_makes_little_are_not_behind_the_camera() -> None:
    g = torch.Generator().manual_seed(3)
    points = 40 * (torch.rand(1000, 6, 3, generator=g, dtype=F64) - 0.5)
    r, t, _ = views(points[0], 1000, near=3)
    result = pnp.solve(points, pixels(project(points, r, t), 0.5), MATRIX, sigma_px=0.5)
    assert bool(result.converged.all())


def test_code_of_poses_that_need_more_iterations() -> None:
    r, t, xy = views(GRID, 10)
    away = rotations.exp(torch.full((10, 3), 0.2, dtype=F64)) @ r
    short = pnp.solve(GRID, pixels(xy, 0.1), MATRIX, initial=(away, 1.2 * t), max_iterations=1)
    assert bool((short.code == PnPCode.NOT_CONVERGED).all())
    assert _nothing(short)
    enough = pnp.solve(GRID, pixels(xy, 0.1), MATRIX, sigma_px=0.1, initial=(away, 1.2 * t))
    assert bool(enough.converged.all())
    assert errors(enough.R, enough.t, r, t)[0].max() < 0.02


def test_failure_can_raise_and_names_the_pose() -> None:
    image = pixels(views(SQUARE, 3)[2])
    image[2, 0, 0] = torch.nan
    with pytest.raises(pnp.PnPError, match="pose 2: NOT_FINITE; 1 of 3 poses failed"):
        pnp.solve(SQUARE, image, MATRIX, raise_on_failure=True)


def test_missing_points_may_hold_anything_and_do_not_count() -> None:
    _, _, xy = views(GRID, 60)
    image = pixels(xy, 0.1)
    mask = torch.ones(60, 9, dtype=torch.bool)
    mask[:, 8] = False
    spoiled = torch.where(mask[..., None], image, torch.nan)
    masked = pnp.solve(GRID, spoiled, LENS, sigma_px=0.1, mask=mask)
    without = pnp.solve(GRID[:8], image[:, :8], LENS, sigma_px=0.1)
    assert masked.code.tolist() == without.code.tolist()
    for name in ("t", "R", "rms", "chi2"):
        torch.testing.assert_close(getattr(masked, name), getattr(without, name), rtol=1e-6, atol=1e-6)


def test_huber_cost_bounds_the_pull_of_an_outlier() -> None:
    r, t, xy = views(CUBOID, 30)
    image = pixels(xy, 0.1)
    image[:, 3] += 40
    plain, robust = (pnp.solve(CUBOID, image, MATRIX, sigma_px=0.1, huber=k) for k in (math.inf, 1.5))
    off, on = (errors(s.R, s.t, r, t)[0] for s in (plain, robust))
    assert bool(robust.converged.all())
    assert on.max() < 0.02
    assert on.median() < 0.05 * off.median()


def test_one_matrix_for_each_pose_and_a_skewed_one() -> None:
    r, t, xy = views(CUBOID, 6)
    matrix = MATRIX.repeat(6, 1, 1)
    matrix[:, 0, 0] += torch.arange(6) * 10
    matrix[:, 0, 1] = 3.0
    image = (torch.cat([xy, torch.ones_like(xy[..., :1])], -1) @ matrix.mT)[..., :2]
    result = pnp.solve(CUBOID, image, matrix)
    assert errors(result.R, result.t, r, t)[0].max() < 1e-9


@pytest.mark.parametrize("method", ["planar", "epnp", "posit", "p3p"])
def test_closed_forms_are_no_better_than_the_estimate(method: pnp.Method) -> None:
    _, _, xy = views(GRID, 100, tilt_deg=(20, 60))
    image = pixels(xy, 0.1)
    best = pnp.solve(GRID, image, MATRIX, sigma_px=0.1)
    form = pnp.solve(GRID, image, MATRIX, sigma_px=0.1, method=method)
    valid = form.code <= PnPCode.AMBIGUOUS
    assert bool(valid.all())
    assert bool((form.chi2 >= best.chi2 * (1 - 1e-9)).all())
    assert bool((form.iterations == 0).all())


def test_many_chunks_are_the_same_as_one() -> None:
    _, _, xy = views(SQUARE, 9000, tilt_deg=(0, 75))
    image = pixels(xy, 0.1)
    many = pnp.solve(SQUARE, image, MATRIX, sigma_px=0.1)
    few = pnp.solve(SQUARE, image[8000:], MATRIX, sigma_px=0.1)
    assert many.code[8000:].tolist() == few.code.tolist()
    good = few.converged
    torch.testing.assert_close(many.t[8000:][good], few.t[good], rtol=1e-7, atol=1e-6)
    assert len(pnp.solve(SQUARE, image[:0], MATRIX)) == 0


@pytest.mark.parametrize("points", [SQUARE, GRID, CUBOID], ids=["4", "9", "solid"])
def test_a_pose_does_not_depend_on_its_batch(points: Tensor) -> None:
    image = pixels(views(points, 300, tilt_deg=(10, 60))[2], 0.1)
    many = pnp.solve(points, image, MATRIX, sigma_px=0.1)
    for few in (1, 12):
        alone = pnp.solve(points, image[:few], MATRIX, sigma_px=0.1)
        assert alone.code.tolist() == many.code[:few].tolist()
        torch.testing.assert_close(alone.t, many.t[:few], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(alone.R, many.R[:few], rtol=0, atol=1e-9)


def test_float32_input_is_solved_in_float64() -> None:
    r, t, xy = views(GRID, 30, tilt_deg=(20, 60))
    result = pnp.solve(GRID.float(), pixels(xy).float(), MATRIX.float(), sigma_px=0.01)
    assert result.t.dtype == F64
    assert errors(result.R, result.t, r, t)[0].max() < 1e-4


def test_gradients_follow_the_implicit_function_theorem() -> None:
    _, _, xy = views(CUBOID, 2)
    image = pixels(xy, 2.0).requires_grad_()  # residuals of pixels: the Gauss-Newton Hessian would fail here
    matrix = MATRIX.clone().requires_grad_()
    points = CUBOID.clone().requires_grad_()

    def pose(image: Tensor, points: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
        scale = torch.diag(torch.cat([focal / FOCAL, torch.ones(1, dtype=F64)]))
        result = pnp.solve(points, image, matrix.detach() @ scale)
        return result.t, rotations.log(result.R)

    focal = torch.tensor([FOCAL, FOCAL], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(pose, (image, points, focal), eps=1e-3, atol=1e-5, rtol=1e-3)


def test_gradient_through_a_lens_and_past_a_failure() -> None:
    _, _, xy = views(CUBOID, 3)
    image = LENS.distort(xy)
    image[1, 0] = torch.nan
    image.requires_grad_()
    result = pnp.solve(CUBOID, image, LENS)
    result.t[[0, 2]].sum().backward()
    assert image.grad is not None
    assert bool(image.grad[[0, 2]].isfinite().all())
    assert bool((image.grad[[0, 2]].abs() > 0).any())


def test_wrong_arguments_are_named() -> None:
    image = pixels(views(SQUARE, 3)[2])
    for arguments, message in (
        ({"method": "magic"}, "method: is 'magic'; choose one of"),
        ({"mask": torch.ones(2, 4, dtype=torch.bool)}, "mask: has shape"),
        ({"weights": torch.ones(3)}, "weights: has shape"),
        ({"covariances": torch.ones(3, 4, 2)}, "covariances: has shape"),
        ({"initial": (torch.zeros(2, 3, 3), torch.zeros(2, 3))}, "initial: has shapes"),
        ({"mask": torch.ones(3, 4)}, "mask: has dtype"),
        ({"weights": -torch.ones(4)}, "weights: is negative"),
        ({"sigma_px": 0.0}, "sigma_px: is 0.0; give a number above 0"),
        ({"sigma_px": -1.0}, "sigma_px: is -1.0"),
        ({"huber": 0.0}, "huber: is 0.0"),
        ({"mask": torch.ones(3, 4, dtype=torch.bool, device="meta")}, "mask: is on meta, but image_points on cpu"),
        ({"max_iterations": 0}, "max_iterations: is 0"),
        ({"covariances": torch.tensor([[1.0, 0.5], [0.0, 1.0]]).expand(4, 2, 2)}, "covariances: are not symmetric"),
    ):
        with pytest.raises(ArgumentError, match=message):
            pnp.solve(SQUARE, image, MATRIX, **arguments)
    with pytest.raises(ArgumentError, match="object_points: has shape"):
        pnp.solve(GRID, image, MATRIX)
    with pytest.raises(ArgumentError, match="camera: has shape"):
        pnp.solve(SQUARE, image, MATRIX[:2])
    with pytest.raises(ArgumentError, match="image_points: has no points"):
        pnp.solve(SQUARE[:0], image[:, :0], MATRIX)


def test_compile_without_a_compiler_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    kernels.compiled.cache_clear()
    with pytest.raises(ConfigError, match="compile: needs a C\\+\\+ compiler"):
        pnp.solve(SQUARE, pixels(views(SQUARE, 5)[2]), MATRIX, compile=True)


def test_a_start_is_left_once_its_minimum_is_sure_to_stay_above() -> None:
    """Of the mirror images of tilted squares: what was left ends above in a minimisation of its own, what was not is
    followed to the same minimum."""
    r, t, xy = views(SQUARE, 200, tilt_deg=(5, 70), near=4, far=40)
    image = pixels(xy, 0.3)
    towards = torch.nn.functional.normalize(t, dim=-1)
    turned = torch.eye(3, dtype=F64) - 2 * towards[..., :, None] * towards[..., None, :]
    mirror = turned @ r @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=F64))
    both = pnp.solve(SQUARE, image, MATRIX, sigma_px=0.3, initial=(torch.stack([r, mirror], 1), torch.stack([t, t], 1)))
    alone = pnp.solve(SQUARE, image, MATRIX, sigma_px=0.3, initial=(r, t))
    other = pnp.solve(SQUARE, image, MATRIX, sigma_px=0.3, initial=(mirror[:, None], t[:, None]))
    torch.testing.assert_close(both.chi2, torch.minimum(alone.chi2, other.chi2), rtol=1e-6, atol=1e-6)
    truth, most = torch.maximum(alone.chi2, other.chi2), relevant(both.chi2)
    meet = truth - both.chi2 < 1e-6 * (1 + both.chi2)
    near, far = both.chi2_alt <= most, both.chi2_alt > most
    torch.testing.assert_close(both.chi2_alt[near], truth[near], rtol=1e-6, atol=1e-6)
    # what leads to the best minimum, too, is none of its own
    assert bool((meet | (truth > most))[far].all())
    assert bool((meet | (truth <= most))[near].all())
    assert (far & ~meet).double().mean() > 0.3

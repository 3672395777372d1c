"""Points that several cameras see: against exact scenes, their statistics, and the solver of one camera."""

import math

import pytest
import torch
from torch import Tensor

import torchpose as tp
from torchpose.geometry import rotations

F64 = torch.float64
SIGMA = 0.1


def rig(*angles_deg: float, covariance: Tensor | None = None) -> tp.CameraRig:
    """Cameras around what is 300 mm in front of the first, the second one with a lens that bends."""
    first = tp.Camera.ideal(1824, 1216, 1111.0)
    bent = tp.Camera(1200, 900, [[900.0, 0, 600], [0, 905, 450], [0, 0, 1]], [-0.1, 0.02, 1e-4, -2e-4])
    R = rotations.exp(torch.tensor([[0.0, math.radians(a), 0.0] for a in angles_deg], dtype=F64))
    middle = torch.tensor([0.0, 0, 300], dtype=F64)
    t = middle - R @ middle
    cameras = [first if n != 1 else bent for n in range(len(angles_deg))]
    return tp.CameraRig(cameras, R, torch.where(t.abs() < 1e-12, 0.0, t), covariance)


def scene(cameras: tp.CameraRig, count: int, batch: int, *, flat: bool, seed: int = 0) -> tuple[Tensor, ...]:
    """Points (N, 3), poses, cameras of the points, and their pixels without noise."""
    g = torch.Generator().manual_seed(seed)
    points = 40 * torch.rand(count, 3, dtype=F64, generator=g) - 20
    if flat:
        points[:, 2] = 0
    R = rotations.exp(0.5 * torch.randn(batch, 3, dtype=F64, generator=g))
    spread = torch.tensor([30.0, 30, 40], dtype=F64)
    t = torch.tensor([0.0, 0, 300], dtype=F64) + spread * (torch.rand(batch, 3, dtype=F64, generator=g) - 0.5)
    index = torch.arange(count) % len(cameras)
    return points, R, t, index, projected(cameras, points @ R.mT + t[:, None], index)


def projected(cameras: tp.CameraRig, at: Tensor, index: Tensor) -> Tensor:
    each = [c.project(at @ r.T + t) for c, r, t in zip(cameras.cameras, cameras.R, cameras.t, strict=True)]
    return torch.stack(each, 2)[:, torch.arange(len(index)), index]


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("angles", [(0, 35), (0, 5, 90), (0, 170)])
def test_exact_points_have_exact_poses(angles: tuple[float, ...], flat: bool) -> None:
    cameras = rig(*angles)
    points, R, t, index, pixels = scene(cameras, 7, 40, flat=flat)
    found = tp.pnp.solve(points, pixels, cameras, camera_index=index, sigma_px=1e-3)
    assert bool((found.code == tp.pnp.PnPCode.CONVERGED).all())
    assert float(rotations.angle_between(found.R, R).max()) < 1e-6
    assert float((found.t - t).abs().max()) < 1e-4
    assert float(found.rms.max()) < 1e-5


def test_errors_are_as_the_covariance_says() -> None:
    """With places of the cameras that vary as their covariance says, and noise."""
    size = torch.tensor([0.05, 0.05, 0.05, 2e-4, 2e-4, 2e-4], dtype=F64)
    covariance = torch.diag(size.square())
    cameras = rig(0, 40, covariance=covariance)
    points, R, t, index, _ = scene(cameras, 10, 400, flat=True)
    g = torch.Generator().manual_seed(1)
    moved = size * torch.randn(400, 6, dtype=F64, generator=g)
    at = points @ R.mT + t[:, None]
    pixels = []
    for k, camera in enumerate(cameras.cameras):
        turn = rotations.exp(moved[:, 3:]) @ cameras.R[1] if k else cameras.R[:1]
        shift = cameras.t[1] + moved[:, :3] if k else cameras.t[:1]
        pixels.append(camera.project(at @ turn.mT + shift[:, None]))
    image = torch.stack(pixels, 2)[:, torch.arange(10), index]
    image = image + SIGMA * torch.randn(image.shape, dtype=F64, generator=g)
    found = tp.pnp.solve(points, image, cameras, camera_index=index, sigma_px=SIGMA)
    good = found.converged
    assert int(good.sum()) > 380
    error = torch.cat([found.t - t, rotations.log(found.R @ R.mT)], -1)
    nees = (error * torch.linalg.solve(found.covariance, error)).sum(-1)[good]
    assert 5.3 < float(nees.mean()) < 6.7  # 6, 400 poses: deviation 0.17
    assert 13 < float(found.chi2[good].mean()) < 15  # 2 * 10 - 6
    # as if the places were exact, the claim is too small
    exact = tp.CameraRig(cameras.cameras, cameras.R, cameras.t)
    bold = tp.pnp.solve(points, image, exact, camera_index=index, sigma_px=SIGMA)
    assert float(bold.chi2.nanmean()) > 20


def test_one_camera_of_a_rig_is_that_camera() -> None:
    camera = tp.Camera(1200, 900, [[900.0, 0, 600], [0, 905, 450], [0, 0, 1]], [-0.1, 0.02, 1e-4, -2e-4])
    alone = tp.CameraRig.alone(camera)
    points, _, _, index, pixels = scene(alone, 8, 50, flat=False)
    pixels = pixels + 0.02 * torch.randn(pixels.shape, dtype=F64, generator=torch.Generator().manual_seed(2))
    one = tp.pnp.solve(points, pixels, camera, sigma_px=0.02)
    same = tp.pnp.solve(points, pixels, alone, camera_index=index, sigma_px=0.02)
    assert torch.equal(one.code, same.code)
    std = one.covariance.diagonal(dim1=1, dim2=2).sqrt()
    # the weights are those of the measured pixels, not of the projected ones: a thousandth of a deviation
    assert float(((one.t - same.t) / std[:, :3]).abs().max()) < 0.02
    torch.testing.assert_close(same.covariance, one.covariance, rtol=0.02, atol=1e-12)
    torch.testing.assert_close(same.rms, one.rms, rtol=1e-4, atol=0)


def test_two_and_two_markers_are_enough_and_what_is_open_is_said() -> None:
    cameras = rig(0, 60)
    points, R, _, index, pixels = scene(cameras, 4, 60, flat=True)
    found = tp.pnp.solve(points, pixels, cameras, camera_index=index, sigma_px=0.02)
    known = found.converged | (found.code == tp.pnp.PnPCode.AMBIGUOUS)
    assert int(known.sum()) >= 58
    best = torch.minimum(
        rotations.angle_between(found.R, R), rotations.angle_between(found.R_alt, R).nan_to_num(nan=9.0)
    )
    assert float(best[known].max()) < 0.02
    mask = torch.ones(60, 4, dtype=torch.bool)
    mask[0, :2] = False
    few = tp.pnp.solve(points, pixels, cameras, camera_index=index, mask=mask)
    assert few.code[0] == tp.pnp.PnPCode.TOO_FEW
    pixels[1, 0, 0] = torch.nan
    assert tp.pnp.solve(points, pixels, cameras, camera_index=index).code[1] == tp.pnp.PnPCode.NOT_FINITE


def test_wrong_arguments_are_named() -> None:
    cameras = rig(0, 60)
    points, _, _, index, pixels = scene(cameras, 4, 2, flat=True)
    for wrong, message in (
        ({}, "camera_index: is missing"),
        ({"camera_index": index + 1}, "camera_index: goes from 1 to 2; give integers from 0 to 1"),
        ({"camera_index": index[:3]}, r"camera_index: has shape \(3,\)"),
        ({"camera_index": index, "method": "epnp"}, "method: is 'epnp'"),
    ):
        with pytest.raises(tp.ArgumentError, match=message):
            tp.pnp.solve(points, pixels, cameras, **wrong)
    with pytest.raises(tp.ArgumentError, match="camera_index: goes with a CameraRig"):
        tp.pnp.solve(points, pixels, cameras.cameras[0], camera_index=index)

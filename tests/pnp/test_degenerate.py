"""Random point sets that hardly fix a pose: the right one, or a code that says why not, never a wrong one."""

from __future__ import annotations

import cv2
import pytest
import torch
from torch import Tensor

from tests.pnp.scenes import F64, MATRIX, errors, pixels, project, views
from torchpose import pnp
from torchpose.pnp import PnPCode, PnPResult

COUNT = 300


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def scene(kind: str, count: int = COUNT, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points (B, N, 3), their true R and t, and exact pixels."""
    points = 40 * uniform(count, 6, 3, seed=seed) - 20
    points[:, :, 2] = 0
    share = uniform(count, 4, 1, seed=seed + 1)
    if kind == "coincident":
        points = torch.cat([points[:, :3], points[:, :1]], 1)
    elif kind == "three distinct":
        points = points[:, [0, 1, 2, 0, 1, 0]]
    elif kind == "doubled":
        points = points[:, [0, 1, 2, 3, 0]]
    elif kind == "doubled in space":
        points[:, :, 2] = 40 * uniform(count, 6, seed=seed + 2) - 20
        points = points[:, [0, 1, 2, 3, 0]]
    elif kind == "three on a line":
        points = torch.cat([points[:, :3], points[:, :1] + share[:, :1] * (points[:, 1:2] - points[:, :1])], 1)
    elif kind == "all but one on a line":
        points = torch.cat([points[:, :3], points[:, :1] + share[:, :3] * (points[:, 1:2] - points[:, :1])], 1)
    elif kind == "nearly flat":
        points[:, :, 2] = 0.4 * (uniform(count, 6, seed=seed + 2) - 0.5)
        points = points[:, :4]
    else:
        points = points[:, :4]
    r, t, _ = views(points[0], count, seed=seed)
    return points, r, t, pixels(project(points, r, t))


KINDS = ("doubled", "doubled in space", "three on a line", "all but one on a line", "nearly flat", "flat")


def missed(found: PnPResult, least: PnPResult) -> Tensor:
    """Poses given as an answer though there is a better minimum."""
    return (found.code <= PnPCode.AMBIGUOUS) & (least.chi2 + 1e-3 + 1e-4 * least.chi2 < found.chi2)


@pytest.mark.parametrize("kind", KINDS)
def test_exact_points_give_the_exact_pose_or_a_reason(kind: str) -> None:
    points, r, t, image = scene(kind)
    found = pnp.solve(points, image, MATRIX, sigma_px=1e-3)
    angle, off = errors(found.R, found.t, r, t)
    right = (angle < 1e-3) & (off < 1e-4)
    assert not bool((found.converged & ~right).any()), "never converged and wrong"
    assert float(found.converged.double().mean()) > 0.9, "and mostly there is a pose"
    assert not bool((found.code == PnPCode.BEHIND_CAMERA).any())


@pytest.mark.parametrize("kind", KINDS)
def test_noise_hides_no_better_minimum(kind: str) -> None:
    """Beside the minimum that the true pose leads to, and OpenCV's from every start of its own."""
    points, r, t, image = scene(kind, seed=5)
    image = image + 0.3 * torch.randn(image.shape, generator=torch.Generator().manual_seed(7), dtype=F64)
    found = pnp.solve(points, image, MATRIX, sigma_px=0.3)
    near = pnp.solve(points, image, MATRIX, sigma_px=0.3, initial=(r, t))
    assert int(missed(found, near).sum()) <= 1, "scripts/pnp_degenerate.py has the rates"
    assert float((found.code <= PnPCode.AMBIGUOUS).double().mean()) > 0.95
    for k in range(60):
        if int(found.code[k]) <= PnPCode.AMBIGUOUS:
            done, rotation, translation = cv2.solvePnP(
                points[k].numpy(), image[k].numpy(), MATRIX.numpy(), None, flags=cv2.SOLVEPNP_SQPNP
            )
            if done:
                turned = torch.from_numpy(cv2.Rodrigues(rotation)[0])
                seen = points[k] @ turned.mT + torch.from_numpy(translation).T
                off = pixels(seen[None, :, :2] / seen[None, :, 2:])[0] - image[k]
                cost = float(off.square().sum() / 0.09) if bool((seen[:, 2] > 0).all()) else float("inf")
                assert float(found.chi2[k]) < cost * (1 + 1e-6) + 1e-6


@pytest.mark.parametrize("kind", ["coincident", "three distinct"])
@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_points_that_coincide_count_once(kind: str, sigma: float) -> None:
    points, _, _, image = scene(kind)
    image = image + sigma * torch.randn(image.shape, generator=torch.Generator().manual_seed(3), dtype=F64)
    code = pnp.solve(points, image, MATRIX, sigma_px=sigma or 1.0).code
    assert set(code.tolist()) <= {PnPCode.TOO_FEW, PnPCode.DEGENERATE}
    assert float((code == PnPCode.TOO_FEW).double().mean()) > 0.98
    if sigma == 0:
        assert pnp.planar(points, (image - MATRIX[:2, 2]) / MATRIX[0, 0]).R.isnan().all(), "of no homography"


def test_points_that_share_a_line_are_shared_by_all_poses() -> None:
    points = torch.tensor([[-20.0, -20, 0], [20, -20, 0], [3, -20, 0], [5, 20, 0]], dtype=F64)
    r, t, xy = views(points, 50)
    found = pnp.solve(points, pixels(xy), MATRIX, sigma_px=1e-3)
    alone = pnp.solve(points.expand(50, -1, -1), pixels(xy), MATRIX, sigma_px=1e-3)
    assert found.code.tolist() == alone.code.tolist()
    assert float(found.converged.double().mean()) > 0.9
    good = found.converged
    assert errors(found.R[good], found.t[good], r[good], t[good])[0].max() < 1e-3


def test_closed_forms_return_rotations() -> None:
    """Also where an iteration has gone astray: deep objects, noise beyond any use."""
    points = 40 * uniform(2000, 5, 3) - 20
    image = uniform(2000, 5, 2, seed=1) - 0.5
    for solver in (pnp.posit, pnp.epnp, pnp.p3p):
        r = solver(points, image).R
        r = r[r.isfinite().all(-1).all(-1)]
        assert (torch.linalg.det(r) - 1).abs().max() < 1e-6


def test_many_shared_points_cost_what_their_number_costs() -> None:
    points = 40 * uniform(2000, 3) - 20
    r, t, _ = views(points[:4], 3, near=6)
    found = pnp.solve(points, pixels(project(points, r, t), 0.1), MATRIX, sigma_px=0.1)
    assert bool(found.converged.all())
    assert errors(found.R, found.t, r, t)[0].max() < 1e-3

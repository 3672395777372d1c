"""`solve` with ``compile``: the poses, covariances and codes are those of eager mode."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.pnp.scenes import CUBOID, F64, FOCAL, GRID, MATRIX, SQUARE, pixels, views
from torchpose import kernels, pnp
from torchpose.camera import Camera
from torchpose.kernels import functions, has_compiler
from torchpose.kernels.build import Kernel, build
from torchpose.pnp import PnPCode, PnPResult

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler (apt-get install g++)")
LENS = Camera(1280, 960, [[1111.0, 0, 640], [0, 1115, 480], [0, 0, 1]], [-0.2, 0.05, 1e-3, -5e-4, 0.01])
FISHEYE = Camera(1280, 960, [[700.0, 0, 640], [0, 702, 480], [0, 0, 1]], [0.02, -0.01, 0.003, 0.0], "kannala_brandt")
UNSURE = Camera(1280, 960, MATRIX, [], covariance=torch.diag(torch.tensor([1.0, 1.0, 0.5, 0.5])))


def same(fast: PnPResult, plain: PnPResult, factor: float = 1) -> None:
    """Poses to what a decrease of the cost by 1e-12 of it moves them, the rest to rounding."""
    assert fast.code.tolist() == plain.code.tolist()
    good = (plain.code <= PnPCode.AMBIGUOUS).nonzero().squeeze(1)
    assert len(good), "nothing to compare"
    scale = plain.covariance[good].diagonal(dim1=1, dim2=2).sqrt()
    moved = 1e-6 * factor * (1 + plain.chi2[good].sqrt())[:, None] * scale
    assert bool(((fast.t[good] - plain.t[good]).abs() < moved[:, :3]).all())
    torch.testing.assert_close(fast.R[good], plain.R[good], rtol=0, atol=float(moved[:, 3:].max()))
    spread = scale[:, :, None] * scale[:, None]
    assert float(((fast.covariance[good] - plain.covariance[good]).abs() / spread).max()) < 1e-6 * factor
    for name in ("chi2", "rms"):
        torch.testing.assert_close(
            getattr(fast, name)[good], getattr(plain, name)[good], rtol=1e-9 * factor**2, atol=1e-12
        )
    for name in ("R", "t", "covariance", "chi2", "rms", "rms_alt", "t_alt"):
        ours, theirs = getattr(fast, name), getattr(plain, name)
        assert ours.shape == theirs.shape
        torch.testing.assert_close(ours.isnan(), theirs.isnan())


def both(points: Tensor, image: Tensor, camera: Camera | Tensor, **options: Any) -> tuple[PnPResult, PnPResult]:
    options = {"sigma_px": 0.1, **options}
    return pnp.solve(points, image, camera, compile=True, **options), pnp.solve(points, image, camera, **options)


# each of these traces and compiles for ten seconds; what the others compile as well waits for `-m slow`
SLOW = pytest.mark.slow


@pytest.mark.parametrize("points", [SQUARE, GRID, pytest.param(CUBOID, marks=SLOW)], ids=["4", "9", "solid"])
def test_poses_are_the_same(points: Tensor) -> None:
    """Near planes with two minima, tilted ones that decide at once, and points in space."""
    same(*both(points, pixels(views(points, 1500, tilt_deg=(0, 75), far=60)[2], 0.1), MATRIX))


@pytest.mark.parametrize("camera", [LENS, FISHEYE, UNSURE], ids=["brown-conrady", "kannala-brandt", "unsure"])
def test_cameras(camera: Camera) -> None:
    same(*both(SQUARE, camera.distort(views(SQUARE, 60)[2]) + 0.1 * pixels(torch.zeros(60, 4, 2)).sin(), camera))


def test_cameras_share_what_was_compiled() -> None:
    xy = views(SQUARE, 40)[2]
    for k in (0.0, 0.03):
        camera = Camera(
            1280, 960, [[1111.0 + 100 * k, 0, 640], [0, 1115, 480], [0, 0, 1]], [-0.2 + k, 0.05, 1e-3, 0, 0]
        )
        result = pnp.solve(SQUARE, camera.distort(xy), camera, compile=True)
        assert float(result.rms.max()) < 1e-7, "the camera of the call, not the one that was compiled for"


@pytest.mark.parametrize(
    "kind",
    ["mask", "covariances", "huber", "initials"]
    + [pytest.param(kind, marks=SLOW) for kind in ("own", "weights", "initial", "matrices")],
)
def test_options(kind: str) -> None:
    g = torch.Generator().manual_seed(5)
    r, t, xy = views(GRID, 80)
    options: dict[str, Any] = {}
    points, image, camera = GRID, pixels(xy, 0.1), MATRIX
    if kind == "own":
        points = GRID.expand(80, -1, -1) * torch.linspace(1, 1.5, 80, dtype=F64)[:, None, None]
        camera_points = points @ r.mT + t[:, None]
        image = pixels(camera_points[..., :2] / camera_points[..., 2:], 0.1)
    elif kind == "mask":
        # with six points seen, four of them always are a quadrangle
        options["mask"] = torch.rand(80, 9, generator=g).argsort(1) >= torch.arange(80)[:, None] % 4
    elif kind == "weights":
        options["weights"] = 0.5 + torch.rand(80, 9, generator=g, dtype=F64)
    elif kind == "covariances":
        root = 0.1 * torch.eye(2, dtype=F64) + 0.02 * torch.randn(9, 2, 2, generator=g, dtype=F64)
        options["covariances"] = root @ root.mT
    elif kind == "huber":
        image[:, 0] += 3 * torch.rand(80, 2, generator=g, dtype=F64)
        options["huber"] = 1.5
    elif kind == "initial":
        options["initial"] = (r, t)
    elif kind == "initials":
        options["initial"] = (torch.stack([r, r.roll(1, 1)], 1), torch.stack([t, t], 1))
    else:
        camera = (
            MATRIX.expand(80, 3, 3) + torch.diag(torch.tensor([1.0, 1, 0], dtype=F64)) * torch.arange(80)[:, None, None]
        )
        image = (xy * (FOCAL + torch.arange(80, dtype=F64))[:, None, None]) + MATRIX[:2, 2]
    # a pose at which a residual is just at the limit of Huber's square comes to its end in many small steps
    same(*both(points, image, camera, **options), factor=100 if kind == "huber" else 1)


@pytest.mark.parametrize("robust", [False, True], ids=["squares", "huber"])
def test_noise_and_the_limit_of_huber_are_no_reason_to_compile_anew(
    robust: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def counted(source: str) -> Kernel:
        made.append(source)
        return build(source)

    monkeypatch.setattr(functions, "build", counted)
    kernels.compiled.cache_clear()
    kernels.repeated.cache_clear()
    image = pixels(views(SQUARE, 80, tilt_deg=(0, 75), far=60)[2], 0.1)
    image[::3, 0] += 2 * torch.rand(27, 2, generator=torch.Generator().manual_seed(5), dtype=F64)
    # all that a call may need, with some poses left over by the first pass
    pnp.solve(SQUARE, image, MATRIX, sigma_px=0.15, huber=1.7 if robust else math.inf, compile=True)
    first = len(made)
    assert first > 1
    for sigma_px, huber in ((0.1, 1.5), (0.2, 1.5), (0.1, 3.0)):
        options = {"sigma_px": sigma_px, "huber": huber} if robust else {"sigma_px": sigma_px}
        same(*both(SQUARE, image, MATRIX, **options), factor=100 if robust else 1)
        assert len(made) == first


@pytest.mark.parametrize("batch", [0, 1, 3, 7, 8, 9, 63, 16385])
def test_batches_of_any_size(batch: int) -> None:
    fast, plain = both(SQUARE, pixels(views(SQUARE, max(batch, 1))[2], 0.1)[:batch], MATRIX)
    assert len(fast) == batch
    if batch:
        same(fast, plain)


def test_poses_without_an_answer_have_their_codes() -> None:
    image = pixels(views(SQUARE, 30)[2], 0.1)
    image[3, 1, 0] = torch.nan
    image[7, 2] = torch.inf
    image[11] = image[11, :1]  # all at one place
    mask = torch.ones(30, 4, dtype=torch.bool)
    mask[5, 0] = False
    fast, plain = both(SQUARE, image, MATRIX, mask=mask)
    same(fast, plain)
    assert fast.code[3] == fast.code[7] == PnPCode.NOT_FINITE
    assert fast.code[5] == PnPCode.TOO_FEW
    line = torch.tensor([[x, 2 * x, 0] for x in (0.0, 1, 2, 3)], dtype=F64)
    fast, plain = both(line, pixels(views(line, 12)[2]), MATRIX)
    assert fast.code.tolist() == plain.code.tolist() == 12 * [PnPCode.DEGENERATE]


def test_more_points_than_are_compiled_are_solved_all_the_same() -> None:
    points = torch.rand(140, 3, generator=torch.Generator().manual_seed(2), dtype=F64) * torch.tensor([40.0, 40, 0])
    image = pixels(views(points, 10)[2], 0.1)
    fast, plain = both(points, image, MATRIX)
    torch.testing.assert_close(fast.t, plain.t, rtol=0, atol=0)

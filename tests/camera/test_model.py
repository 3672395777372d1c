"""Camera models against OpenCV, against their own inverse, and their derivatives against finite differences."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchpose.camera import Camera
from torchpose.errors import ConfigError

K = [[2400.0, 0.0, 1311.25], [0.0, 2410.0, 903.5], [0.0, 0.0, 1.0]]
BROWN = {
    "none": [],
    "barrel": [-0.3, 0.12, 1e-3, -2e-3],
    "pincushion": [0.35, 0.1, -1e-3, 5e-4, 0.02],
    "rational": [0.9, 0.3, 1e-3, -2e-3, 0.05, 1.2, 0.45, 0.08],
}
FISHEYE = [0.05, -0.02, 0.003, -0.001]


def camera(distortion: list[float], model: str = "brown_conrady") -> Camera:
    return Camera(2624, 1808, K, distortion, model)  # type: ignore[arg-type]


def points_ahead(n: int = 400, half_angle: float = 0.7) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    xy = (2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1) * math.tan(half_angle)
    z = 50 + 500 * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    return torch.cat([xy * z, z], -1)


@pytest.mark.parametrize("name", BROWN)
def test_projects_as_opencv(name: str) -> None:
    points = points_ahead()
    expected, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), np.array(K), np.array(BROWN[name]))
    np.testing.assert_allclose(camera(BROWN[name]).project(points).numpy(), expected[:, 0], rtol=0, atol=1e-9)


def test_projects_as_opencv_fisheye() -> None:
    points = torch.cat([points_ahead(half_angle=1.3), torch.tensor([[0.0, 0.0, 100.0], [1e-3, 0.0, 100.0]])])
    expected, _ = cv2.fisheye.projectPoints(
        points.numpy()[:, None], np.zeros(3), np.zeros(3), np.array(K), np.array(FISHEYE)
    )
    projected = camera(FISHEYE, "kannala_brandt").project(points)
    np.testing.assert_allclose(projected.numpy(), expected[:, 0], rtol=0, atol=1e-9)


def test_points_behind_the_camera_have_no_image() -> None:
    points = torch.tensor([[1.0, 2.0, 100.0], [1.0, 2.0, 0.0], [1.0, 2.0, -100.0]], dtype=torch.float64)
    points.requires_grad_()
    pixels = camera(BROWN["barrel"]).project(points)
    assert pixels.isnan().any(-1).tolist() == [False, True, True]
    pixels[0].sum().backward()
    assert points.grad is not None
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("name", BROWN)
def test_undistortion_inverts_strong_distortion_to_the_corner(name: str) -> None:
    cam = camera(BROWN[name])
    u, v = torch.meshgrid(torch.linspace(0, 2623, 60), torch.linspace(0, 1807, 40), indexing="ij")
    uv = torch.stack([u, v], -1).double()
    xy = cam.undistort_points(uv)
    assert xy.shape == (60, 40, 2)
    assert (cam.distort(xy) - uv).abs().max() < 1e-10 * 2624
    assert (cam.undistort_points(cam.distort(xy)) - xy).abs().max() < 1e-10


@given(
    k1=st.floats(-0.3, 0.4),
    k2=st.floats(-0.1, 0.2),
    p=st.tuples(st.floats(-5e-3, 5e-3), st.floats(-5e-3, 5e-3)),
    rational=st.sampled_from([(), (0.02,), (0.02, 0.3, 0.1, 0.01)]),
    radius=st.floats(0, 0.9),
    angle=st.floats(0, 2 * math.pi),
)
@settings(deadline=None, max_examples=150)
def test_round_trip_within_the_fold(
    k1: float, k2: float, p: tuple[float, float], rational: tuple[float, ...], radius: float, angle: float
) -> None:
    cam = camera([k1, k2, *p, *rational])
    r = min(radius, 0.8 * cam.fold_radius)
    xy = torch.tensor([r * math.cos(angle), r * math.sin(angle)], dtype=torch.float64)
    assert (cam.undistort_points(cam.distort(xy)) - xy).abs().max() < 1e-11


@given(degrees=st.floats(0, 89.5), angle=st.floats(0, 2 * math.pi))
@settings(deadline=None, max_examples=100)
def test_fisheye_round_trip(degrees: float, angle: float) -> None:
    cam = camera(FISHEYE, "kannala_brandt")
    r = math.tan(math.radians(degrees))
    xy = torch.tensor([r * math.cos(angle), r * math.sin(angle)], dtype=torch.float64)
    assert (cam.undistort_points(cam.distort(xy)) - xy).norm() <= 1e-10 * (1 + r)


def test_undistortion_agrees_with_opencv_iterated_to_the_end() -> None:
    cam = camera(BROWN["barrel"])
    uv = torch.tensor([[12.0, 7.0], [1300.0, 900.0], [2600.0, 1790.0]], dtype=torch.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT, 500, 0.0)
    expected = cv2.undistortPoints(
        uv.numpy()[:, None], np.array(K), np.array(BROWN["barrel"]), None, None, None, criteria
    )
    np.testing.assert_allclose(cam.undistort_points(uv).numpy(), expected[:, 0], rtol=0, atol=1e-12)


def test_fold_radius_is_where_the_radius_stops_growing() -> None:
    # r - 0.3 r^3 has its maximum at r = 1 / sqrt(0.9)
    assert camera([-0.3, 0.0, 0.0, 0.0]).fold_radius == pytest.approx(1 / math.sqrt(0.9), rel=1e-12)
    assert camera([0.3, 0.0, 0.0, 0.0]).fold_radius == math.inf
    # theta - theta^3 / 3 has its maximum at theta = 1
    assert camera([-1 / 3, 0.0, 0.0, 0.0], "kannala_brandt").fold_radius == pytest.approx(math.tan(1), rel=1e-12)


@pytest.mark.parametrize(
    ("distortion", "model", "largest"),
    [([-0.3, 0.0, 0.0, 0.0], "brown_conrady", 2 / 3 / math.sqrt(0.9)), ([-1 / 3, 0, 0, 0], "kannala_brandt", 2 / 3)],
)
def test_no_inverse_beyond_the_fold(distortion: list[float], model: str, largest: float) -> None:
    cam = camera(distortion, model)
    edge = torch.tensor([[0.999 * largest, 0.0], [1.001 * largest, 0.0], [3.0, 0.0], [math.nan, 0.0], [math.inf, 0.0]])
    uv = edge.double() * torch.tensor([2400.0, 2410.0]) + torch.tensor([1311.25, 903.5])
    xy = cam.undistort_points(uv)
    assert xy.isnan().any(-1).tolist() == [False, True, True, True, True]
    assert 0.9 * cam.fold_radius < xy[0, 0] < cam.fold_radius


@pytest.mark.parametrize(
    ("distortion", "model"), [*((d, "brown_conrady") for d in BROWN.values()), (FISHEYE, "kannala_brandt")]
)
def test_jacobian_and_gradients(distortion: list[float], model: str) -> None:
    cam = camera(distortion, model)
    xy = torch.tensor([[0.0, 0.0], [1e-4, 2e-4], [0.4, -0.3], [-0.2, 0.25]], dtype=torch.float64, requires_grad=True)
    expected = torch.stack([torch.autograd.functional.jacobian(cam.distort, p) for p in xy.detach()])
    torch.testing.assert_close(cam.J_distort(xy), expected, rtol=0, atol=1e-8)
    uv = cam.distort(xy).detach().requires_grad_()
    ahead = torch.cat([xy.detach(), torch.ones(4, 1, dtype=torch.float64)], -1).requires_grad_()
    assert torch.autograd.gradcheck(cam.distort, xy, atol=1e-4)
    assert torch.autograd.gradcheck(cam.project, ahead, atol=1e-4)
    assert torch.autograd.gradcheck(cam.undistort_points, uv, eps=1e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("distortion", "model"),
    [(BROWN["barrel"], "brown_conrady"), (BROWN["rational"], "brown_conrady"), (FISHEYE, "kannala_brandt")],
)
def test_calibration_gradients(distortion: list[float], model: str) -> None:
    """Points and undistortion are differentiable in the intrinsics and the coefficients."""
    xy = torch.tensor([[0.4, -0.3], [-0.2, 0.25]], dtype=torch.float64)
    uv = camera(distortion, model).distort(xy)

    def run(focal: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        matrix = torch.tensor(K, dtype=torch.float64) * torch.tensor([[1.0, 1, 1], [1, 0, 1], [1, 1, 1]])
        matrix = matrix + torch.diag(torch.stack([torch.zeros_like(focal), focal, torch.zeros_like(focal)]))
        cam = Camera(2624, 1808, matrix, coefficients, model)  # type: ignore[arg-type]
        return cam.distort(xy), cam.undistort_points(uv)

    focal = torch.tensor(2410.0, dtype=torch.float64, requires_grad=True)
    coefficients = torch.tensor(distortion, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(run, (focal, coefficients), atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_points(dtype: torch.dtype) -> None:
    cam = camera(BROWN["barrel"])
    uv = torch.tensor([[100.0, 200.0], [2000.0, 1500.0]], dtype=dtype)
    xy = cam.undistort_points(uv)
    assert xy.dtype == cam.distort(xy).dtype == cam.J_distort(xy).dtype == dtype
    assert (cam.distort(xy) - uv).abs().max() < 2624 * 8 * torch.finfo(dtype).eps


def test_to_copies_only_what_changes() -> None:
    cam = Camera(8, 6, K, FISHEYE, "kannala_brandt", torch.eye(4, dtype=torch.float64))
    assert cam.to(torch.float64) is cam
    single = cam.to(torch.float32)
    assert single.matrix.dtype == torch.float32
    assert single.covariance is not None
    assert single.covariance.dtype == torch.float32
    assert (single.model, single.width, single.height) == ("kannala_brandt", 8, 6)


def test_thin_prism_coefficients_are_accepted_when_zero() -> None:
    assert camera([*BROWN["rational"], 0.0, 0.0, 0.0, 0.0]).distortion.tolist() == BROWN["rational"]
    with pytest.raises(ConfigError, match=r"^distortion_coefficients: thin-prism"):
        camera([*BROWN["rational"], 0.0, 1e-4, 0.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "image_width: is 0; "),
        ({"height": 10.5}, "image_height: is 10.5; "),
        ({"matrix": [[1, 2], [3, 4]]}, r"camera_matrix: has shape \(2, 2\); "),
        ({"matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "camera_matrix: last row "),
        ({"matrix": [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]}, "camera_matrix: has a skew entry "),
        ({"matrix": [[-5, 0, 0], [0, 1, 0], [0, 0, 1]]}, "camera_matrix: focal length fx is -5"),
        ({"matrix": [[1, 0, math.nan], [0, 1, 0], [0, 0, 1]]}, "camera_matrix: holds NaN "),
        ({"matrix": [["a"]]}, "camera_matrix: is not a table of numbers; "),
        ({"distortion": [0.1, 0.2, 0.3]}, "distortion_coefficients: 3 coefficients for brown_conrady; "),
        ({"distortion": [], "model": "kannala_brandt"}, "distortion_coefficients: 0 coefficients for kannala_brandt; "),
        ({"distortion": [[0.1, 0, 0, 0]]}, "distortion_coefficients: has shape "),
        ({"model": "omni"}, "distortion_model: is 'omni'; "),
        ({"covariance": torch.eye(3)}, r"camera_matrix_covariance: has shape \(3, 3\); "),
        ({"covariance": torch.eye(4).roll(1, 0)}, "camera_matrix_covariance: is not symmetric; "),
        (
            {"covariance": torch.diag(torch.tensor([1.0, 1, 1, -1]))},
            "camera_matrix_covariance: has a negative eigenvalue; ",
        ),
    ],
)
def test_wrong_fields_are_named(changes: dict[str, object], message: str) -> None:
    fields: dict[str, object] = {"width": 10, "height": 10, "matrix": K, "distortion": BROWN["barrel"]}
    with pytest.raises(ConfigError, match=f"^{message}"):
        Camera(**{**fields, **changes})  # type: ignore[arg-type]


def test_moving_checks_and_reads_nothing() -> None:
    """No value of a camera is read at each move: on a device that would wait for all that is queued."""

    class NoReads(TorchDispatchMode):
        def __torch_dispatch__(
            self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
        ) -> Any:
            assert func not in (torch.ops.aten._local_scalar_dense.default, torch.ops.aten.isfinite.default), func
            return func(*args, **(kwargs or {}))

    for cam in (camera(BROWN["barrel"]), camera(FISHEYE, "kannala_brandt"), camera([0.0] * 4), camera([])):
        cam.to(torch.float32)  # what follows from the coefficients is found once
        with NoReads():  # type: ignore[no-untyped-call]
            moved = cam.to(torch.float32).to("meta")
        assert moved.fold_radius == cam.fold_radius
        assert moved.matrix.device.type == moved.distortion.device.type == "meta"
    points = torch.ones(3, 2, device="meta", dtype=torch.float64)
    assert moved.undistort_points(points).device.type == "meta"


def test_coefficients_are_looked_at_where_they_changed() -> None:
    """A lens that is estimated from zero: used once, then given a gradient, then moved in place."""
    matrix = torch.tensor([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(640, 480, matrix, torch.zeros(4, dtype=torch.float64))
    pixel = torch.tensor([10.0, 20.0], dtype=torch.float64)
    straight = camera.undistort_points(pixel)
    camera.distortion.requires_grad_()
    assert camera.undistort_points(pixel).requires_grad
    camera.distortion.requires_grad_(False)
    camera.distortion[0] = 0.1
    assert (camera.undistort_points(pixel) - straight).abs().max() > 1e-3

"""Which lens a file speaks of, under whatever key; what no camera can be; and lenses that cannot be inverted."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpose as tp
from torchpose.camera import Camera
from torchpose.camera.formats import CameraWarning
from torchpose.camera.formats.models import MODELS
from torchpose.camera.plausible import check_intrinsics, share_without_ray
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.sim import render

K = [[1111.1, 0.0, 911.5], [0.0, 1111.1, 607.5], [0.0, 0.0, 1.0]]
FISH = [-0.012, 0.004, -0.003, 0.0006]
BASE: dict[str, object] = {
    "image_width": 1824,
    "image_height": 1216,
    "camera_matrix": K,
    "distortion_coefficients": FISH,
}
KEYS = (
    "camera_model",
    "model",
    "model_type",
    "calibration_model",
    "lens_model",
    "projection",
    "type",
    "distortion_type",
    "cameraModel",
    "LensType",
    "projection_type",
    "lens",
    "dist_model",
    "undistortion-model",
    "dist",
    "distName",
)


def load(tmp_path: Path, entries: dict[str, object], comment: str = "") -> Camera:
    text = comment + json.dumps({key: value for key, value in (BASE | entries).items() if value is not None})
    (tmp_path / "cam.yaml").write_text(text)
    return Camera.load(tmp_path / "cam.yaml")


@pytest.mark.parametrize("key", KEYS)
def test_a_fisheye_under_any_key_is_one(tmp_path: Path, key: str) -> None:
    for name in ("fisheye", "Kannala-Brandt", "equidistant", "KB4", "opencv_fisheye", "pinhole_equi"):
        assert load(tmp_path, {key: name}).model == "kannala_brandt"
        assert load(tmp_path, {"left": {"deep": [{key: name}]}}).model == "kannala_brandt"
    others: tuple[object, ...] = (
        "omni",
        "mei",
        "double_sphere",
        "FOV",
        "division",
        "something else",
        3,
        1.5,
        True,
        ["fisheye"],
    )
    for other in others:
        with pytest.raises(
            ConfigError, match=f"cam.yaml: {re.escape(key)}: .* is not supported; use one of brown_conr"
        ):
            load(tmp_path, {key: other})
    assert load(tmp_path, {key: "radtan"}).model == load(tmp_path, {key: "pinhole"}).model == "brown_conrady"


@pytest.mark.parametrize("key", ["is_fisheye", "fisheye", "fisheye_model", "useFisheye", "equidistant"])
def test_flags(tmp_path: Path, key: str) -> None:
    for value, model in (
        (True, "kannala_brandt"),
        (1, "kannala_brandt"),
        ("yes", "kannala_brandt"),
        (0, "brown_conrady"),
    ):
        assert load(tmp_path, {key: value}).model == model
    with pytest.raises(ConfigError, match=f"{key}: 7 is not supported; "):
        load(tmp_path, {key: 7})


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"xi": 1.2}, "xi: 1.2 is not supported"),
        ({"mirror_parameters": {"xi": 1.2}}, "mirror_parameters.xi: 1.2 is not supported"),
        ({"alpha": 0.5, "beta": 1.1}, "alpha: 0.5 is not supported"),
        ({"xi": 1.2, "distortion_model": "radtan"}, "xi: 1.2 is not supported"),
        ({"distortion_center": [3.0, 4.0], "distortion_model": "radtan"}, "distortion_center: a list of 2 is not supp"),
        ({"camera_model": "omni", "distortion_model": "radtan"}, "camera_model: 'omni' is not supported"),
        ({"is_omnidirectional": True, "distortion_model": "radtan"}, "is_omnidirectional: True is not supported"),
        (
            {"camera_model": "fisheye", "distortion_model": "plumb_bob"},
            "distortion_model: 'plumb_bob' contradicts camera_m",
        ),
        ({"camera_name": "left_fisheye"}, "distortion_model: is missing, and the file speaks of 'fisheye'; write "),
        ({"notes": {"calibrated": ["by omnidir"]}}, "distortion_model: is missing, and the file speaks of 'omni'; "),
        ({"distortion_model": "none"}, "distortion_model: is 'none', and the coefficients are not zero; "),
        ({"calibration": "UCM"}, "distortion_model: is missing, and the file speaks of 'UCM'; write "),
        ({"thin_prism": [0.1, 0.2], "distortion_model": "radtan"}, "thin_prism: a list of 2 is not supported"),
        ({"skew": 0.5, "distortion_model": "radtan"}, "skew: 0.5 is not supported"),
        ({"distortion_model": ""}, "distortion_model: '' is not supported; use one of "),
        ({"fisheye_camera_matrix": K}, "distortion_model: is missing, and the file speaks of 'fisheye'; "),
    ],
)
def test_what_could_name_another_lens_is_refused(tmp_path: Path, entries: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=f"cam.yaml: {message}") as caught:
        load(tmp_path, entries)
    assert "contradicts" in message or "'none'" in message or ", ".join(MODELS) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_comment_that_speaks_of_a_fisheye_counts(tmp_path: Path) -> None:
    text = "# cv2.fisheye.calibrate, 12 views\n"
    with pytest.raises(ConfigError, match="distortion_model: is missing, and the file speaks of 'fisheye'"):
        load(tmp_path, {}, text)
    assert load(tmp_path, {"distortion_model": "fisheye"}, text).model == "kannala_brandt"


@pytest.mark.parametrize(
    "entries",
    [
        {"camera_model": "acA5472-17um", "lens": "V1227-MPY2 12 mm", "distortion_model": "brown_conrady"},
        {
            "camera_name": "narrow",
            "frame_id": "left",
            "rms": 0.1,
            "avg_reprojection_error": 0.2,
            "mean_reprojection": 1.0,
        },
        {"projection_matrix": {"rows": 1, "cols": 1, "data": [1]}, "rectification_matrix": [1.0]},
        {"board": {"type": "chessboard"}, "pattern_type": "circles", "sensor_type": "global shutter", "flags": 0},
        {"distance": 300, "working_distance_mm": 150.0, "skew": 0, "rectified": False},
        {"xi": 0, "alpha": 0.0, "is_fisheye": False},
    ],
)
def test_what_names_no_lens_is_passed_over(tmp_path: Path, entries: dict[str, object]) -> None:
    assert load(tmp_path, entries).model == "brown_conrady"


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (
            [[0.609, 0, 0.5], [0, 0.914, 0.5], [0, 0, 1]],
            "put a corner of the frame of 1824 x 1216 px .* impossible field",
        ),
        (
            [[8.0, 0, 6.56], [0, 8.0, 4.37], [0, 0, 1]],
            "put a corner of the frame .* write fx fy cx cy in px of this frame",
        ),
        ([[1111.1, 0, 911.5], [0, 1.1, 607.5], [0, 0, 1]], "put a corner of the frame"),
        ([[1111.1, 0, 9115.0], [0, 1111.1, 607.5], [0, 0, 1]], "put a corner of the frame"),
        ([[1e5, 0, 5e4], [0, 1e5, 607.5], [0, 0, 1]], "cx is 50000, far outside the frame of 1824 px"),
        ([[1111.1, 0, 911.5], [0, 1e9, 607.5], [0, 0, 1]], "fy is 1e\\+09 for 1216 px, an impossibly narrow field"),
    ],
)
def test_what_is_not_in_px_is_refused(tmp_path: Path, matrix: list[list[float]], message: str) -> None:
    with pytest.raises(ConfigError, match=f"cam.yaml: camera_matrix: .*{message}"):
        load(tmp_path, {"camera_matrix": matrix, "distortion_coefficients": []})
    camera = Camera(1824, 1216, matrix, [])
    with pytest.raises(ConfigError, match=message):
        tp.PoseEstimator(camera, tp.Target.load("quad40"))


@pytest.mark.parametrize(
    ("width", "height", "f", "c", "model"),
    [
        (640, 480, 280.0, (319.5, 239.5), "brown_conrady"),  # 110 degrees across the diagonal
        (1024, 1024, 330.0, (511.5, 511.5), "kannala_brandt"),  # a whole circle of 190 degrees
        (64, 64, 5000.0, (-4000.0, 2000.0), "brown_conrady"),  # a window at the rim of a large sensor
        (1280, 1024, 2e6, (639.5, 511.5), "brown_conrady"),  # a microscope seen as a pinhole
    ],
)
def test_unusual_cameras_are_taken(width: int, height: int, f: float, c: tuple[float, float], model: str) -> None:
    matrix = torch.tensor([[f, 0, c[0]], [0, f, c[1]], [0, 0, 1]])
    check_intrinsics(matrix, width, height, model)  # type: ignore[arg-type]


SQUARE = torch.tensor([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], dtype=torch.float64)
SEEN = SQUARE + torch.tensor([3.0, -4.0, 150.0])
PIXELS = Camera(1824, 1216, K, []).project(SEEN)[None]


def test_pnp_refuses_a_matrix_in_another_unit() -> None:
    matrix = torch.tensor(K, dtype=torch.float64)
    good = tp.pnp.solve(SQUARE, PIXELS, matrix)
    normalised = (SEEN[:, :2] / SEEN[:, 2:])[None]
    same = tp.pnp.solve(SQUARE, normalised, torch.eye(3, dtype=torch.float64), sigma_px=1e-3)
    torch.testing.assert_close(good.t, same.t, rtol=0, atol=1e-6)
    for unit in (1 / 1824, 0.0072):
        scaled = matrix * unit
        scaled[2, 2] = 1
        with pytest.raises(ConfigError, match=r"camera: half of the image points lie .* focal lengths and more off"):
            tp.pnp.solve(SQUARE, PIXELS, scaled)
    with pytest.raises(ConfigError, match="camera: half of the image points"):
        tp.pnp.solve(SQUARE, PIXELS.expand(3, 4, 2), torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
    with pytest.raises(ConfigError, match="camera: is no pinhole matrix; write "):
        tp.pnp.solve(SQUARE, PIXELS, matrix.T)
    with pytest.raises(ConfigError, match="camera: a focal length is not positive; "):
        tp.pnp.solve(SQUARE, PIXELS, matrix * torch.tensor([1.0, -1.0, 1.0]))


def test_pnp_looks_at_the_points_that_count() -> None:
    """What a missing point holds is ignored, and a point that is astray is left to the fit."""
    pixels = PIXELS.clone()
    pixels[0, 3] = 1e9
    mask = torch.tensor([[True, True, True, False]])
    tp.pnp.solve(SQUARE, pixels, torch.tensor(K, dtype=torch.float64), mask=mask, method="p3p")
    pixels[0, 3] = torch.nan
    assert tp.pnp.solve(SQUARE, pixels, torch.tensor(K, dtype=torch.float64)).code.item() == tp.pnp.PnPCode.NOT_FINITE


def cancelling(excess: float, pole: float = 0.45) -> list[float]:
    """A lens (1 + 0.3 u) / (1 + 0.1 u), u = r^2, times (1 - (1 + excess) u / pole) / (1 - u / pole)."""
    n = np.polymul([0.3, 1], [-(1 + excess) / pole, 1])
    q = np.polymul([0.1, 1], [-1 / pole, 1])
    return [n[1], n[0], 0, 0, 0, q[1], q[0], 0]


def rays(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels of the whole frame, and all their rays (N, S) by brute force along the radius, up to 60 degrees."""
    d = camera.distortion
    r = torch.linspace(0, math.tan(math.radians(60)), 40_001, dtype=torch.float64)
    u = r * r
    bent = r * (1 + u * (d[0] + u * (d[1] + u * d[4]))) / (1 + u * (d[5] + u * (d[6] + u * d[7])))
    return r, bent


def looked_back(camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distorted radii along u, the rays found for them, which but the first have one, and where the lens is real.

    Checks that each of these rays is the only one.
    """
    radius = torch.linspace(0, 1.0, 100, dtype=torch.float64)
    found = camera.undistort_points(torch.stack([radius * 1111.1 + 911.5, torch.full_like(radius, 607.5)], -1))[:, 0]
    r, bent = rays(camera)
    # stretches on which the lens is one that exists: it grows, by less than three times what a ray turns
    slope = bent.diff() / r.diff()
    real = (bent[:-1] > 0) & (slope > 0) & (slope * r[:-1] <= 3.0 * bent[:-1])
    crossings = ((bent[None, :-1] <= radius[1:, None]) & (bent[None, 1:] > radius[1:, None]) & real).sum(1)
    valid = found[1:].isfinite()
    assert (crossings[valid] == 1).all()
    return radius, found, valid, real


@pytest.mark.parametrize("excess", [-1e-2, -1e-3, -1e-4, 1e-4, 1e-3, 1e-2])
def test_near_a_pole_no_ray_is_returned_that_another_could_replace(excess: float) -> None:
    camera = Camera(1824, 1216, K, cancelling(excess))
    radius, found, valid, _ = looked_back(camera)
    assert 0.5 < valid.double().mean() < 0.8  # the pole is at r = 0.67
    assert (camera.distort(torch.stack([found, torch.zeros_like(found)], -1))[:, 0] - radius * 1111.1 - 911.5)[
        found.isfinite()
    ].abs().max() < 1e-8


def beside_the_axis(excess: float, apart: float, spot: float = 0.45) -> list[float]:
    """A lens and a pair of complex poles at u = spot (1 +- i apart), which nearly cancel: a spike, no pole."""
    pair = [1 / spot**2, -2 / spot, 1 + apart**2]
    n = np.polymul([0.1, 1], np.add(pair, [0, 0, excess]) / (1 + apart**2 + excess))
    q = np.asarray(pair) / (1 + apart**2)
    return [n[2], n[1], 0.0, 0.0, n[0], q[1], q[0], 0.0]


@pytest.mark.parametrize("apart", [0.0, 1e-3, 0.03, 0.1])
@pytest.mark.parametrize("excess", [-1e-3, 1e-3, 0.02, 1.0])
def test_a_spike_without_a_pole_ends_the_inverse_too(excess: float, apart: float) -> None:
    *_, valid, real = looked_back(Camera(1824, 1216, K, beside_the_axis(excess, apart)))
    # nothing is lost where the spike is none
    assert bool(valid.all()) or not bool(real[1:].all())


def test_markers_without_a_ray_make_no_pose_that_is_wrong() -> None:
    """A lens, and a fit of it that has a pole at r = 0.67; the target moves out of the part with rays."""
    matrix: list[list[float]] = [[550.0, 0, 455.5], [0, 550.0, 303.5], [0, 0, 1]]
    lens, fit = Camera(912, 608, matrix, [0.3, 0, 0, 0, 0, 0.1, 0, 0]), Camera(912, 608, matrix, cancelling(1e-6))
    target, count = tp.Target.load("quad40"), 8
    t = torch.zeros(count, 3, dtype=torch.float64) + torch.tensor([0.0, 6.0, 150.0])
    t[:, 0] = torch.linspace(20, 130, count)
    R = rotations.exp(torch.tensor([[0.2, -0.1, 0.3]], dtype=torch.float64)).expand(count, 3, 3)
    noise = torch.randn(count, 608, 912, generator=torch.Generator().manual_seed(3))
    frames = (render(lens, target, R, t) + noise).clamp(0, 255).round().to(torch.uint8)
    poses = tp.PoseEstimator(fit, target)(frames)
    places = (R @ target.centers.T).mT + t[:, None]
    seen = ((places[..., :2] / places[..., 2:]).norm(dim=-1) < fit.fold_radius).sum(1)
    assert {0, 4} <= set(seen.tolist())
    assert (poses.markers <= seen).all()
    ok = poses.status == tp.Status.OK
    assert ok[seen == 4].any()
    assert not ok[seen < 3].any()
    sigma = poses.covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sqrt()
    assert ((poses.t - t).abs() < 5 * sigma)[ok].all()


def test_a_pole_outside_the_frame_costs_nothing() -> None:
    camera = Camera(1824, 1216, K, cancelling(-1e-3, pole=2.0))
    assert share_without_ray(camera) == 0
    # division model: a pincushion with a true pole, beyond which nothing is imaged
    assert share_without_ray(Camera(1824, 1216, K, [0, 0, 0, 0, 0, -0.3, 0, 0])) == 0
    assert Camera(1824, 1216, K, [-2.2e-313, 0, 0, 0]).fold_radius == math.inf


@pytest.mark.parametrize(
    ("distortion", "model", "share"),
    [
        ([-1.9, -1.1, 0, 0, 0.1, -2.2, 0, 0], "brown_conrady", 0.49),  # fold at r = 0.56, before the pole
        ([-0.6, 0, 0, 0], "brown_conrady", None),
        ([-0.6, 0, 0, 0], "kannala_brandt", None),
    ],
)
def test_a_frame_without_rays_is_told_at_load(
    tmp_path: Path, distortion: list[float], model: str, share: float | None
) -> None:
    entries: dict[str, object] = {"distortion_coefficients": distortion, "distortion_model": model}
    with pytest.warns(
        CameraWarning, match=r"cam.yaml: distortion_coefficients: no ray reaches [\d.]+ % of the frame"
    ) as told:
        camera = load(tmp_path, entries)
    # the largest image radius, by brute force
    r, bent = rays(Camera(1824, 1216, K, [*distortion, *[0.0] * (8 - len(distortion))]))
    if model == "kannala_brandt":
        bent = torch.atan(r) * (1 + distortion[0] * torch.atan(r) ** 2)
    largest = float(bent[: int((bent.diff() < 0).nonzero()[0]) + 1].max())
    v, u = np.mgrid[:1216:4, :1824:4]
    expected = float((np.hypot(u - 911.5, v - 607.5) > largest * 1111.1).mean())
    assert float(re.findall(r"([\d.]+) %", str(told[0].message))[0]) == pytest.approx(100 * expected, abs=2)
    assert share is None or expected == pytest.approx(share, abs=0.01)
    assert share_without_ray(camera) == pytest.approx(expected, abs=0.02)


@pytest.mark.filterwarnings("default::torchpose.camera.formats.CameraWarning")
def test_the_command_line_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries: dict[str, object] = {"distortion_coefficients": [-1.9, -1.1, 0, 0, 0.1, -2.2, 0, 0]}
    (tmp_path / "pole.json").write_text(json.dumps(BASE | entries))
    (tmp_path / "omni.json").write_text(json.dumps(BASE | {"camera_model": "omni"}))
    frame = Path(__file__).parents[2] / "data" / "sample" / "frames" / "005.png"
    for name, code, line in (
        ("pole.json", 0, "torchpose: warning: .*pole.json: distortion_coefficients: no ray reaches 49 % of the frame"),
        (
            "omni.json",
            2,
            "torchpose: error: .*omni.json: camera_model: 'omni' is not supported; use one of brown_conrady",
        ),
    ):
        arguments = [
            "estimate",
            str(frame),
            "--camera",
            str(tmp_path / name),
            "--target",
            "quad40",
            "--method",
            "centers",
        ]
        with pytest.raises(SystemExit) as ended:
            main([*arguments, "--out", str(tmp_path / "poses.csv")])
        told = capsys.readouterr().err
        assert ended.value.code == code, told
        assert len([found for found in told.splitlines() if re.match(line, found)]) == 1, told
        assert "CameraWarning" not in told

"""Camera files: every format is read and written exactly, and every mistake gets one line that names it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.camera import Camera
from torchpose.errors import ConfigError

# awkward on purpose: no short decimals, and a principal point that crosses a power of two with COLMAP's half pixel
K = [[1111.1111111111111, 0.0, 1023.7000000000001], [0.0, 7786.3 / 7, 1e-5 / 3], [0.0, 0.0, 1.0]]
BROWN = [-0.1 / 3, 1e-5, 1.2345678901234567e-07, -2e-3]
COVARIANCE = torch.tensor([[4.0, 3.9, 0.1, 0.0], [3.9, 4.0, 0.0, 0.1], [0.1, 0.0, 1 / 3, 0.0], [0.0, 0.1, 0.0, 0.3]])


def same(a: Camera, b: Camera) -> bool:
    """Equal bit by bit; missing distortion coefficients count as zero."""
    pad = [torch.nn.functional.pad(c.distortion, (0, 8 - len(c.distortion))) for c in (a, b)]
    covariance = (a.covariance is None and b.covariance is None) or (
        a.covariance is not None and b.covariance is not None and torch.equal(a.covariance, b.covariance)
    )
    return (a.width, a.height, a.model) == (b.width, b.height, b.model) and (
        torch.equal(a.matrix, b.matrix) and torch.equal(*pad) and covariance
    )


def load(tmp_path: Path, text: str, name: str = "cam.yaml", selector: str = "") -> Camera:
    path = tmp_path / name
    path.write_text(text)
    return Camera.load(f"{path}{selector}")


@pytest.mark.parametrize("covariance", [None, COVARIANCE.double()])
@pytest.mark.parametrize("distortion", [[], BROWN, [*BROWN, 0.1], [*BROWN, 0.1, 0.2, 0.3, -0.4]])
@pytest.mark.parametrize("format", ["opencv", "json", "ros", "kalibr", "colmap"])
@pytest.mark.filterwarnings("ignore::torchpose.camera.formats.CameraWarning")
def test_brown_conrady_round_trip(
    tmp_path: Path, format: str, distortion: list[float], covariance: torch.Tensor | None
) -> None:
    camera = Camera(2048, 1536, K, distortion, covariance=covariance)
    path = tmp_path / "cam.any"
    if format == "kalibr" and len(distortion) > 4:
        with pytest.raises(ConfigError, match=f"^{path}: distortion_coefficients: Kalibr holds k1 k2 p1 p2 only; "):
            camera.save(path, format="kalibr")
        assert not path.exists()
        return
    camera.save(path, format=format)  # type: ignore[arg-type]
    if format == "colmap":  # has no place for it
        camera = Camera(2048, 1536, K, distortion)
    assert same(Camera.load(path), camera)


@pytest.mark.parametrize("format", ["opencv", "json", "ros", "kalibr", "colmap"])
def test_kannala_brandt_round_trip(tmp_path: Path, format: str) -> None:
    camera = Camera(2048, 1536, K, [0.1 / 3, 1e-5, 1.2345678901234567e-07, 2e-3], "kannala_brandt")
    camera.save(tmp_path / "cam.any", format=format)  # type: ignore[arg-type]
    assert same(Camera.load(tmp_path / "cam.any"), camera)


@given(
    st.lists(st.floats(1e2, 1e5), min_size=2, max_size=2),
    # COLMAP's half pixel is added in 28 decimals
    st.lists(st.floats(-1e2, 1e2).map(lambda c: c if abs(c) > 1e-9 else 0.0), min_size=2, max_size=2),
    st.lists(st.floats(-10, 10), min_size=8, max_size=8),
    st.sampled_from([".yaml", ".json", ".txt"]),
)
@settings(deadline=None, max_examples=60)
@pytest.mark.filterwarnings("ignore::torchpose.camera.formats.CameraWarning")
def test_written_numbers_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, focal: list[float], center: list[float], d: list[float], suffix: str
) -> None:
    camera = Camera(20, 10, [[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]], d)
    path = tmp_path_factory.mktemp("camera") / f"camera{suffix}"
    camera.save(path)
    assert same(Camera.load(path), camera)


def test_opencv_reads_what_we_write(tmp_path: Path) -> None:
    path = tmp_path / "cam.yml"
    Camera(2048, 1536, K, BROWN, covariance=COVARIANCE.double()).save(path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("image_width").real() == 2048
    assert storage.getNode("image_height").real() == 1536
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), np.array(K))
    np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat(), np.array([BROWN]))
    np.testing.assert_array_equal(storage.getNode("camera_matrix_covariance").mat(), COVARIANCE.double().numpy())
    assert storage.getNode("distortion_model").string() == "brown_conrady"


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_reads_what_opencv_writes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cam{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 1 Jan 2024")
    storage.write("image_width", 2048)
    storage.write("image_height", 1536)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array(BROWN)[:, None])
    storage.write("avg_reprojection_error", 0.1)
    storage.release()
    assert same(Camera.load(path), Camera(2048, 1536, K, BROWN))


OLD_OPENCV = """%YAML:1.0
---
calibration_time: "Fri 01 Mar 2024"
nr_of_frames: 25
image_width: 640
image_height: 480
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.5e+02, 0., 3.195e+02, 0., 651., 2.395e+02, 0.,
       0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.8e-01, 1e-2, 0., 0., .5 ]
per_view: !!opencv-nd-matrix
   sizes: [ 1, 2 ]
   dt: f
   data: [ .Nan, 1. ]
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [650, 0, 319.5, 0, 651, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 1e-2, 0, 0, 0.5]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [600, 0, 300, 0, 0, 600, 200, 0, 0, 0, 1, 0]}
"""
ROS_MESSAGE = """header: {seq: 0, frame_id: cam}
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.28, 0.01, 0.0, 0.0, 0.5]
K: [650.0, 0.0, 319.5, 0.0, 651.0, 239.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
---
"""
PLAIN = """image_width: 640
image_height: 480
camera_matrix: [[650, 0, 319.5], [0, 651, 239.5], [0, 0, 1]]
distortion_coefficients: [[-0.28, 0.01, 0, 0, 0.5]]
"""
PLAIN_JSON = json.dumps(yaml.safe_load(PLAIN), indent="\t")


@pytest.mark.parametrize("text", [OLD_OPENCV, ROS, ROS_MESSAGE, PLAIN, PLAIN_JSON, "\ufeff" + PLAIN])
def test_native_flavours(tmp_path: Path, text: str) -> None:
    (tmp_path / "cam.yaml").write_text(text, encoding="utf-8")
    expected = Camera(640, 480, [[650, 0, 319.5], [0, 651, 239.5], [0, 0, 1]], [-0.28, 0.01, 0, 0, 0.5])
    assert same(Camera.load(tmp_path / "cam.yaml"), expected)


@pytest.mark.parametrize(
    ("name", "coefficients", "model"),
    [
        ("rational_polynomial", [0.01] * 8, "brown_conrady"),
        ("equidistant", [0.1] * 4, "kannala_brandt"),
        ("fisheye", [0.1] * 4, "kannala_brandt"),
    ],
)
def test_ros_distortion_models(tmp_path: Path, name: str, coefficients: list[float], model: str) -> None:
    data = {**yaml.safe_load(PLAIN), "distortion_model": name, "distortion_coefficients": coefficients}
    camera = load(tmp_path, yaml.safe_dump(data))
    assert (camera.model, camera.distortion.tolist()) == (model, coefficients)


def test_fisheye_flag_of_the_opencv_sample(tmp_path: Path) -> None:
    text = (
        OLD_OPENCV.replace("fisheye_model: 0", "fisheye_model: 1").replace("rows: 5", "rows: 4").replace(", .5 ]", " ]")
    )
    assert load(tmp_path, text).model == "kannala_brandt"


KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.01, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [650.0, 651.0, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]
  distortion_model: equidistant
  intrinsics: [700.0, 701.0, 400.5, 300.5]
  resolution: [800, 600]
"""


def test_kalibr_camchain(tmp_path: Path) -> None:
    first = Camera(640, 480, [[650, 0, 319.5], [0, 651, 239.5], [0, 0, 1]], [-0.28, 0.01, 0.001, 0.002])
    second = Camera(800, 600, [[700, 0, 400.5], [0, 701, 300.5], [0, 0, 1]], [0.1, 0.2, 0.3, 0.4], "kannala_brandt")
    assert same(load(tmp_path, KALIBR, selector="#cam0"), first)
    assert same(load(tmp_path, KALIBR, selector="#cam1"), second)
    assert same(load(tmp_path, KALIBR.split("cam1:")[0]), first)


COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 9
1 SIMPLE_PINHOLE 640 480 650 320 240
2 PINHOLE 640 480 650 651 320 240
3 SIMPLE_RADIAL 640 480 650 320 240 -0.1
4 RADIAL 640 480 650 320 240 -0.1 0.02
5 OPENCV 640 480 650 651 320 240 -0.1 0.02 0.003 0.004
6 FULL_OPENCV 640 480 650 651 320 240 -0.1 0.02 0.003 0.004 0.05 0.06 0.07 0.08
7 SIMPLE_RADIAL_FISHEYE 640 480 650 320 240 -0.1
8 RADIAL_FISHEYE 640 480 650 320 240 -0.1 0.02
9 OPENCV_FISHEYE 640 480 650 651 320 240 -0.1 0.02 0.003 0.004
"""


@pytest.mark.parametrize(
    ("key", "fy", "distortion", "model"),
    [
        (1, 650, [], "brown_conrady"),
        (2, 651, [], "brown_conrady"),
        (3, 650, [-0.1, 0, 0, 0], "brown_conrady"),
        (4, 650, [-0.1, 0.02, 0, 0], "brown_conrady"),
        (5, 651, [-0.1, 0.02, 0.003, 0.004], "brown_conrady"),
        (6, 651, [-0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08], "brown_conrady"),
        (7, 650, [-0.1, 0, 0, 0], "kannala_brandt"),
        (8, 650, [-0.1, 0.02, 0, 0], "kannala_brandt"),
        (9, 651, [-0.1, 0.02, 0.003, 0.004], "kannala_brandt"),
    ],
)
def test_colmap_models(tmp_path: Path, key: int, fy: float, distortion: list[float], model: str) -> None:
    expected = Camera(640, 480, [[650, 0, 319.5], [0, fy, 239.5], [0, 0, 1]], distortion, model)  # type: ignore[arg-type]
    assert same(load(tmp_path, COLMAP, "cameras.txt", f"#{key}"), expected)


def test_colmap_half_pixel_is_written(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    Camera(640, 480, [[650, 0, 319.5], [0, 651, 239.25], [0, 0, 1]], []).save(path)
    assert path.read_text().splitlines()[-1] == "1 PINHOLE 640 480 650.0 651.0 320.0 239.75"


def test_a_hash_in_the_file_name_is_no_selector(tmp_path: Path) -> None:
    assert load(tmp_path, PLAIN, "cam#2.yaml").width == 640


def test_principal_point_may_lie_outside(tmp_path: Path) -> None:
    """Of a window of a larger sensor."""
    assert load(tmp_path, PLAIN.replace("319.5", "-500.0")).matrix[0, 2] == -500


def test_covariance_is_read(tmp_path: Path) -> None:
    camera = load(tmp_path, PLAIN + f"camera_matrix_covariance: {COVARIANCE.double().tolist()}\n")
    assert camera.covariance is not None
    assert torch.equal(camera.covariance, COVARIANCE.double())


def replaced(old: str, new: str, text: str = PLAIN) -> str:
    assert old in text
    return text.replace(old, new)


MATRIX = "camera_matrix: [[650, 0, 319.5], [0, 651, 239.5], [0, 0, 1]]"
DISTORTION = "distortion_coefficients: [[-0.28, 0.01, 0, 0, 0.5]]"
COV = "camera_matrix_covariance: "
TRAPS = {
    "empty": ("", "file: is empty; "),
    "only comments": ("# nothing\n", "file: holds only comments; "),
    "not yaml": ("a: [1, 2\nb: }", "line 2: is not YAML "),
    "tabs": ("a:\n\t- 1", "line 2: is not YAML "),
    "plain text": ("hello", "file: holds plain text, not a mapping; "),
    "list": ("- 1\n- 2\n", "file: holds a list, not a mapping; "),
    "xml": ('<?xml version="1.0"?><opencv_storage/>', "camera_matrix: is missing, and nothing names"),
    "two documents": (PLAIN + "---\n" + PLAIN, "file: holds 2 YAML documents; keep one"),
    "duplicate key": (PLAIN + "image_width: 641\n", r"image_width: given twice \(line 5\); keep one"),
    "duplicate json key": ('{"image_width": 1, "image_width": 2}', "image_width: given twice; keep one"),
    "no matrix": (replaced(MATRIX, ""), "camera_matrix: is missing; add it"),
    "no distortion": (replaced(DISTORTION, ""), "distortion_coefficients: is missing; write \\[\\] for "),
    "no width": (replaced("image_width: 640", ""), "image_width: is missing; add it"),
    "no height": (replaced("image_height: 480", ""), "image_height: is missing; add it"),
    "negative width": (replaced("640", "-640"), "image_width: is -640; give the frame size as a positive integer"),
    "zero height": (replaced("480", "0"), "image_height: is 0; give the frame size"),
    "broken width": (replaced("640", "640.5"), "image_width: is 640.5; give the frame size"),
    "text width": (replaced("640", "wide"), "image_width: is 'wide'; give the frame size"),
    "true width": (replaced("640", "true"), "image_width: is True; give the frame size"),
    "matrix 2x3": (replaced(", [0, 0, 1]", ""), r"camera_matrix: has shape \(2, 3\); give 3 rows of 3"),
    "matrix ragged": (replaced("[0, 0, 1]", "[0, 1]"), "camera_matrix: rows differ in length; "),
    "matrix number": (replaced(MATRIX, "camera_matrix: 5"), "camera_matrix: is 5; write a list of numbers"),
    "matrix text": (replaced("650", "abc"), "camera_matrix: 'abc' is not a number; "),
    "matrix nested": (replaced("650", "[650]"), "camera_matrix: .* is not a number; "),
    "matrix counts": (replaced("cols: 3", "cols: 2", ROS), "camera_matrix: 9 numbers for 3 x 2; "),
    "matrix rows": (replaced("  rows: 3\n", "", ROS), "camera_matrix.rows: is missing; "),
    "matrix nan": (replaced("650", ".nan"), "camera_matrix: holds NaN or infinity; "),
    "matrix OpenCV's nan": (replaced("6.5e+02", ".Nan", OLD_OPENCV), "camera_matrix: holds NaN or infinity; "),
    "matrix inf": (replaced("319.5", "-.inf"), "camera_matrix: holds NaN or infinity; "),
    "zero focal": (replaced("650", "0"), "camera_matrix: focal length fx is 0.0; give a positive number"),
    "negative focal": (replaced("651", "-651"), "camera_matrix: focal length fy is -651.0; give a positive number"),
    "skew": (replaced("[650, 0,", "[650, 0.5,"), r"camera_matrix: has a skew entry \(0.5\); "),
    "last row": (replaced("[0, 0, 1]", "[0, 0, 2]"), "camera_matrix: last row is "),
    "transposed": (
        replaced(MATRIX, "camera_matrix: [[650, 0, 0], [0, 651, 0], [319.5, 239.5, 1]]"),
        "camera_matrix: last row is .* write ",
    ),
    "three coefficients": (
        replaced("[[-0.28, 0.01, 0, 0, 0.5]]", "[1, 2, 3]"),
        "distortion_coefficients: 3 coefficients for brown_conrady; give none or k1 k2 p1 p2 ",
    ),
    "five fisheye": (
        PLAIN + "distortion_model: fisheye\n",
        "distortion_coefficients: 5 coefficients for kannala_brandt; ",
    ),
    "tilted": (
        replaced("[[-0.28, 0.01, 0, 0, 0.5]]", str([0.1] * 14)),
        "distortion_coefficients: thin-prism or tilted terms are not zero; ",
    ),
    "nan coefficient": (replaced("-0.28", ".NaN"), "distortion_coefficients: holds NaN or infinity; "),
    "unknown model": (PLAIN + "distortion_model: omni\n", "distortion_model: 'omni' is not supported; use one of "),
    "model list": (PLAIN + "distortion_model: [1]\n", "distortion_model: .* is not supported; use one of "),
    "covariance shape": (PLAIN + COV + "[[1, 0], [0, 1]]\n", "camera_matrix_covariance: has shape .* give 4 x 4"),
    "covariance asymmetric": (
        PLAIN + COV + "[[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n",
        "camera_matrix_covariance: is not symmetric; ",
    ),
    "covariance negative": (
        PLAIN + COV + "[[1, 2, 0, 0], [2, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n",
        "camera_matrix_covariance: has a negative eigenvalue; ",
    ),
    "several in a camchain": (KALIBR, "file: holds 2 cameras; append one of #cam0, #cam1 to the name"),
    "several in COLMAP": (COLMAP, "file: holds 9 cameras; append one of #1, #2, "),
    "kalibr intrinsics": (
        replaced("[650.0, 651.0, 319.5, 239.5]", "[650.0]", KALIBR).split("cam1:")[0],
        r"cam0.intrinsics: has shape \(1,\); give \[fx, fy, cx, cy\]",
    ),
    "kalibr focal": (replaced("650.0", "-1", KALIBR).split("cam1:")[0], "cam0.intrinsics: focal length fx is -1.0; "),
    "kalibr model": (replaced("pinhole", "omni", KALIBR).split("cam1:")[0], "cam0.camera_model: is 'omni'; "),
    "kalibr distortion": (
        replaced("radtan", "fov", KALIBR).split("cam1:")[0],
        "cam0.distortion_model: 'fov' is not supported; ",
    ),
    "kalibr none": (
        replaced("radtan", "none", KALIBR).split("cam1:")[0],
        "cam0.distortion_model: is 'none', and the coefficients are not zero; ",
    ),
    "kalibr omni": (
        replaced("  rostopic", "  xi: 1.2\n  rostopic", KALIBR).split("cam1:")[0],
        "cam0.xi: 1.2 is not supported; use one of ",
    ),
    "kalibr resolution": (replaced("[640, 480]", "640", KALIBR).split("cam1:")[0], "cam0.resolution: is 640; give "),
    "kalibr missing": (KALIBR.split("  resolution")[0], "cam0.resolution: is missing; add it"),
    "kalibr entry": ("cam0: 5\n", "cam0: is not a mapping; "),
    "colmap model": ("1 FOV 640 480 1 2 3 4 5\n", "camera 1: MODEL: 'FOV' is not supported; use "),
    "colmap count": ("1 PINHOLE 640 480 650 651 320\n", "camera 1: PARAMS: 3 parameters; PINHOLE has 4"),
    "colmap text": ("1 PINHOLE 640 480 650 x 320 240\n", "camera 1: PARAMS: not all are numbers; "),
    "colmap nan": ("1 PINHOLE 640 480 650 nan 320 240\n", "camera 1: PARAMS: holds NaN or infinity; "),
    "colmap signaling nan": ("1 PINHOLE 640 480 650 sNaN 320 240\n", "camera 1: PARAMS: not all are numbers; "),
    "colmap huge": ("1 PINHOLE 640 480 650 650 1e9999999 240\n", "camera 1: PARAMS: not all are numbers; "),
    "explicit tag": (replaced("640", "!!timestamp 640"), "line 1: !!timestamp is a kind"),
    "colmap width": ("1 PINHOLE 64.5 480 650 650 320 240\n", "camera 1: WIDTH: is '64.5'; "),
    "colmap id": (COLMAP + "x PINHOLE 4 4 1 1 1 1\n", "CAMERA_ID: is 'x'; write one line for each camera, "),
    "long key": (PLAIN_JSON[:-1] + ', "a\\n' + "b" * 2000 + '_model": "omni"}', "a.+b+.* is not supported; "),
    "colmap twice": ("1 PINHOLE 4 4 1 1 1 1\n1 PINHOLE 4 4 1 1 1 1\n", "CAMERA_ID: given twice; "),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_traps_name_file_field_and_fix(tmp_path: Path, trap: str) -> None:
    text, message = TRAPS[trap]
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'cam.yaml'}: {message}") as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "selector", "message"),
    [
        (KALIBR, "#cam7", "#cam7: no such camera; choose #cam0, #cam1"),
        (COLMAP, "#12", "#12: no such camera; choose #1, #2, "),
        (PLAIN, "#cam0", "#cam0: the file holds one camera only; drop #cam0"),
    ],
)
def test_wrong_selectors(tmp_path: Path, text: str, selector: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'cam.yaml'}: {message}"):
        load(tmp_path, text, selector=selector)


def test_missing_file_folder_and_binary(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: file: does not exist; "):
        Camera.load(tmp_path / "nowhere.yaml")
    with pytest.raises(ConfigError, match=f"^{tmp_path}: file: is a folder; "):
        Camera.load(tmp_path)
    for junk in (b"\x89PNG\r\n\x1a\n\x00\xff\xfe", b"abc\x00def", bytes(range(1, 128))):
        (tmp_path / "junk.yaml").write_bytes(junk)
        with pytest.raises(ConfigError, match=r"junk\.yaml: .*is not ") as caught:
            Camera.load(tmp_path / "junk.yaml")
        assert "\n" not in str(caught.value)


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
@settings(deadline=None, max_examples=200)
def test_any_content_gives_one_line(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        Camera.load(path)
    assert len(str(caught.value).splitlines()) == 1


def test_saving_is_atomic_and_says_what_is_wrong(tmp_path: Path) -> None:
    camera = Camera(640, 480, K, BROWN)
    path = tmp_path / "cam.yaml"
    path.write_text("old")
    camera.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["cam.yaml"]
    with pytest.raises(ConfigError, match=r"suffix: '\.xml' is not known; use \.yaml"):
        camera.save(tmp_path / "cam.xml")
    with pytest.raises(ConfigError, match="format: 'opencvv' is not known; did you mean opencv"):
        camera.save(path, format="opencvv")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="file: cannot be written "):
        camera.save(tmp_path / "nowhere" / "cam.yaml")


@pytest.mark.parametrize("path", sorted(Path(__file__).parents[2].glob("configs/cameras/*.yaml")), ids=lambda p: p.stem)
def test_our_cameras_load(path: Path) -> None:
    camera = Camera.load(path)
    center = camera.distort(torch.zeros(2, dtype=torch.float64))
    # the paper's setting: the optical axis in the middle of the frame
    assert center.tolist() == [(camera.width - 1) / 2, (camera.height - 1) / 2]


@pytest.mark.parametrize("format", ["opencv", "json", "ros", "kalibr"])
def test_covariance_of_all_intrinsics_and_the_adjustment_round_trip(tmp_path: Path, format: str) -> None:
    """The whole table goes first; other readers find the part of the matrix where they look for it."""
    root = torch.randn(8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    units = torch.tensor([1, 1, 1, 1, 1e-3, 1e-3, 1e-4, 1e-4], dtype=torch.float64)
    covariance = units[:, None] * (root @ root.T) * units
    covariance = 0.5 * (covariance + covariance.T)
    camera = Camera(2048, 1536, K, BROWN, covariance=covariance, adjustment="ba-0123456789ab")
    path = tmp_path / "cam.any"
    camera.save(path, format=format)  # type: ignore[arg-type]
    again = Camera.load(path)
    assert again.adjustment == "ba-0123456789ab"
    assert again.covariance is not None
    assert torch.equal(again.covariance[:8, :8], covariance)
    # ROS has five coefficients at least: the one that was added is known to be zero
    assert not bool(again.covariance[8:].any())
    if format == "opencv":
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        np.testing.assert_array_equal(storage.getNode("camera_matrix_covariance").mat(), covariance[:4, :4].numpy())


def test_covariance_of_another_number_of_intrinsics_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"has shape \(9, 9\); give 4 x 4 for fx fy cx cy, or 8 x 8 with the dist"):
        Camera(2048, 1536, K, BROWN, covariance=torch.eye(9, dtype=torch.float64))
    bad = torch.eye(8, dtype=torch.float64)
    bad[7, 7] = -1e-12
    with pytest.raises(ConfigError, match="intrinsics_covariance: has a negative eigenvalue"):
        Camera(2048, 1536, K, BROWN, covariance=bad)

"""Files of other programs: each is read as its own documentation has it, computed here from that and from OpenCV.

`POINTS` are projected by the convention of the format, in numpy or by cv2, and moved to our pixels (the centre of the
first one is 0, 0). The camera that is read projects them to the same places.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchpose.camera import Camera
from torchpose.errors import ConfigError

GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.35, 0.35, 5)), -1).reshape(-1, 2)
POINTS = np.concatenate([GRID, np.ones((25, 1))], 1)
F, C, D = (650.0, 660.0), (322.5, 238.0), (-0.28, 0.07, 1e-3, -2e-3, 0.01)
RATIONAL = (*D, 0.02, 0.05, -0.01)
FISH = (0.05, -0.02, 0.003, -0.001)


def opencv(distortion: tuple[float, ...] = (), *, f: tuple[float, float] = F, c: tuple[float, float] = C) -> np.ndarray:
    matrix = np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]])
    return cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0][:, 0]


def fisheye(k: tuple[float, ...] = FISH, *, c: tuple[float, float] = C) -> np.ndarray:
    matrix = np.array([[F[0], 0, c[0]], [0, F[1], c[1]], [0, 0, 1]])
    return cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), matrix, np.array(k))[0][:, 0]


def storage(suffix: str, names: tuple[str, str, str, str], distortion: np.ndarray) -> str:
    """What OpenCV writes."""
    file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("calibration_time", "Mon 1 Jan 2024")
    width, height, matrix, coefficients = names
    file.write(width, 640)
    file.write(height, 480)
    file.write(matrix, np.array([[F[0], 0, C[0]], [0, F[1], C[1]], [0, 0, 1]]))
    file.write(coefficients, distortion)
    file.write("per_view", np.array([1.5, math.nan]))
    return str(file.releaseAndGetString())


NEW = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
OLD = ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients")
ND = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-nd-matrix
   sizes: [ 3, 3 ]
   dt: d
   data: [ 650., 0., 322.5, 0., 660., 238., 0., 0., 1. ]
distortion_coefficients: !!opencv-nd-matrix
   sizes: [ 5 ]
   dt: d
   data: [ -0.28, 0.07, 1e-3, -2e-3, 0.01 ]
"""
INI = """# Camera intrinsics

[image]

width
640

height
480

[narrow/left]

camera matrix
650.0 0.0 322.5
0.0 660.0 238.0
0.0 0.0 1.0

distortion
-0.28 0.07 0.001 -0.002 0.01

rectification
1 0 0
0 1 0
0 0 1

projection
600 0 320 0
0 600 240 0
0 0 1 0
"""
BOP = json.dumps({"cx": C[0], "cy": C[1], "depth_scale": 0.1, "fx": F[0], "fy": F[1], "height": 480, "width": 640})
MRCAL = """# generated on 2024-01-01
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 650.0, 660.0, 322.5, 238.0, -0.28, 0.07, 1e-3, -2e-3, 0.01, 0.02, 0.05, -0.01,],

    'valid_intrinsics_region': [
        [ 30, 40 ],
        [ 600, 400 ],
    ],
    # extrinsics are rt_fromref
    'extrinsics': [ 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'P${B\\x00'
}
"""


def mrcal(name: str, coefficients: tuple[float, ...]) -> str:
    row = "'intrinsics': " + str([*F, *C, *coefficients]) + ","
    return re.sub(r"'intrinsics': .*", row, MRCAL).replace("LENSMODEL_OPENCV8", f"LENSMODEL_{name}")


def basalt(kind: str, coefficients: dict[str, float]) -> str:
    entry = {"camera_type": kind, "intrinsics": {"fx": F[0], "fy": F[1], "cx": C[0], "cy": C[1], **coefficients}}
    return json.dumps({"value0": {"T_imu_cam": [{"px": 0.0}], "intrinsics": [entry], "resolution": [[640, 480]]}})


RADTAN8 = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), RATIONAL, strict=True)) | {"rpmax": 2.7}
KB = dict(zip(("k1", "k2", "k3", "k4"), FISH, strict=True))


def orb(name: str, kind: str, coefficients: tuple[tuple[str, float], ...]) -> str:
    text = "%YAML:1.0\n\n# settings\n" + (f'Camera.type: "{kind}"\n' if kind else "")
    values = (("fx", F[0]), ("fy", F[1]), ("cx", C[0]), ("cy", C[1]), *coefficients)
    text += "".join(f"{name}.{key}: {value}\n" for key, value in values)
    return text + "Camera.width: 640\nCamera.height: 480\nCamera.fps: 20\nCamera.RGB: 1\nORBextractor.nFeatures: 1000\n"


RADTAN = tuple(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))


def metashape(body: str, projection: str = "frame") -> str:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>{projection}</projection>\n'
        f"  <width>640</width>\n  <height>480</height>\n{body}  <date>2024-01-01T00:00:00Z</date>\n</calibration>\n"
    )


METASHAPE = (
    "  <f>660</f>\n  <cx>3.5</cx>\n  <cy>-2</cy>\n  <b1>-10</b1>\n"
    "  <k1>-0.28</k1>\n  <k2>0.07</k2>\n  <k3>0.01</k3>\n  <p1>0.001</p1>\n  <p2>-0.002</p2>\n"
)


def by_metashape() -> np.ndarray:
    """The manual's appendix; its pixel 0.5, 0.5 is the centre of the first one."""
    x, y = GRID.T
    r2 = x * x + y * y
    radial = 1 - 0.28 * r2 + 0.07 * r2**2 + 0.01 * r2**3
    xd = x * radial + 0.001 * (r2 + 2 * x * x) + 2 * -0.002 * x * y
    yd = y * radial + -0.002 * (r2 + 2 * y * y) + 2 * 0.001 * x * y
    u = 640 * 0.5 + 3.5 + xd * 660 + xd * -10
    v = 480 * 0.5 - 2 + yd * 660
    return np.stack([u, v], 1) - 0.5


def metashape_fisheye() -> np.ndarray:
    x0, y0 = GRID.T
    r0 = np.hypot(x0, y0)
    theta = np.arctan(r0)
    with np.errstate(invalid="ignore"):
        x, y = (np.where(r0 > 0, p * theta / r0, 0.0) for p in (x0, y0))
    r2 = x * x + y * y
    radial = 1 + 0.05 * r2 - 0.02 * r2**2 + 0.003 * r2**3 - 0.001 * r2**4
    return np.stack([320 + 3.5 + x * radial * 650, 240 - 2 + y * radial * 650], 1) - 0.5


def nerf(**changes: object) -> str:
    data: dict[str, object] = {"w": 640, "h": 480, "fl_x": F[0], "fl_y": F[1], "cx": C[0], "cy": C[1], "aabb_scale": 16}
    data |= dict(zip(("k1", "k2", "p1", "p2"), D, strict=False)) | {"frames": [{"file_path": "a.png"}]} | changes
    return json.dumps({key: value for key, value in data.items() if value is not None})


def realsense(model: object, coefficients: tuple[float, ...]) -> str:
    data = {"width": 640, "height": 480, "ppx": C[0], "ppy": C[1], "fx": F[0], "fy": F[1], "model": model}
    return json.dumps(data | {"coeffs": list(coefficients)})


OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": [650.0, 0, 0, 0, 660.0, 0, 322.5, 238.0, 1]}
CORNER = (C[0] - 0.5, C[1] - 0.5)
FILES: dict[str, tuple[str, Callable[[], np.ndarray]]] = {
    "OpenCV YAML": (storage(".yml", NEW, np.array([D])), lambda: opencv(D)),
    "OpenCV 2": (storage(".yml", OLD, np.array([D])), lambda: opencv(D)),
    "OpenCV XML": (storage(".xml", NEW, np.array(RATIONAL)[:, None]), lambda: opencv(RATIONAL)),
    "OpenCV 2 XML": (storage(".xml", OLD, np.array([D])), lambda: opencv(D)),
    "OpenCV JSON": (storage(".json", NEW, np.array([D])), lambda: opencv(D)),
    "OpenCV 5 nd-matrix": (ND, lambda: opencv(D)),
    "ROS ini": (INI, lambda: opencv(D)),
    "BOP": (BOP, opencv),
    "mrcal pinhole": (mrcal("PINHOLE", ()), opencv),
    "mrcal 4": (mrcal("OPENCV4", D[:4]), lambda: opencv(D[:4])),
    "mrcal 5": (mrcal("OPENCV5", D), lambda: opencv(D)),
    "mrcal 8": (MRCAL, lambda: opencv(RATIONAL)),
    "Basalt pinhole": (basalt("pinhole", {}), opencv),
    "Basalt radtan8": (basalt("pinhole-radtan8", RADTAN8), lambda: opencv(RATIONAL)),
    "Basalt kb4": (basalt("kb4", KB), fisheye),
    "ORB-SLAM2": (orb("Camera", "", RADTAN), lambda: opencv(D)),
    "ORB-SLAM3": (orb("Camera1", "PinHole", RADTAN[:4]), lambda: opencv(D[:4])),
    "ORB-SLAM3 fisheye": (orb("Camera1", "KannalaBrandt8", tuple(KB.items())), fisheye),
    "ORB-SLAM3 rectified": (orb("Camera1", "Rectified", ()), opencv),
    "Metashape": (metashape(METASHAPE), by_metashape),
    "Metashape fisheye": (
        metashape(
            "<f>650</f><cx>3.5</cx><cy>-2</cy><k1>0.05</k1><k2>-0.02</k2><k3>0.003</k3><k4>-0.001</k4>", "fisheye"
        ),
        metashape_fisheye,
    ),
    "NeRF": (nerf(), lambda: opencv(D[:4], c=CORNER)),
    "NeRF nerfstudio": (nerf(camera_model="OPENCV", k3=0.01), lambda: opencv(D, c=CORNER)),
    "NeRF fisheye": (nerf(is_fisheye=True, p1=None, p2=None, **KB), lambda: fisheye(c=CORNER)),
    "NeRF nerfstudio fisheye": (nerf(camera_model="OPENCV_FISHEYE", p1=0, p2=0, **KB), lambda: fisheye(c=CORNER)),
    "NeRF angle": (
        json.dumps({"w": 640, "h": 480, "camera_angle_x": 2 * math.atan(320 / 650), "frames": []}),
        lambda: opencv(f=(650.0, 650.0), c=(319.5, 239.5)),
    ),
    "RealSense": (realsense("distortion.brown_conrady", D), lambda: opencv(D)),
    "RealSense, zero": (realsense("Inverse Brown Conrady", (0.0,) * 5), opencv),
    "RealSense fisheye": (realsense("distortion.kannala_brandt4", (*FISH, 0.0)), fisheye),
    "Open3D": (json.dumps(OPEN3D), opencv),
    "Open3D trajectory": (json.dumps({"class_name": "PinholeCameraParameters", "intrinsic": OPEN3D}), opencv),
}


def load(tmp_path: Path, text: str) -> Camera:
    (tmp_path / "cam.any").write_text(text)
    return Camera.load(tmp_path / "cam.any")


@pytest.mark.parametrize("name", FILES)
def test_files_of_other_programs_project_as_theirs(tmp_path: Path, name: str) -> None:
    text, expected = FILES[name]
    camera = load(tmp_path, text)
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(camera.project(torch.from_numpy(POINTS)).numpy(), expected(), rtol=0, atol=1e-9)


TWO = json.loads(basalt("kb4", KB))
TWO["value0"]["intrinsics"].append(json.loads(basalt("pinhole", {}))["value0"]["intrinsics"][0])
TWO["value0"]["resolution"].append([640, 480])
REFUSED = {
    "mrcal": (mrcal("CAHVOR", ()), "lensmodel: 'LENSMODEL_CAHVOR' is not supported; use LENSMODEL_PINHOLE, "),
    "mrcal count": (mrcal("OPENCV5", D[:4]), "intrinsics: 8 numbers; LENSMODEL_OPENCV5 has 9"),
    "mrcal thin prism": (mrcal("OPENCV12", (*RATIONAL, 0, 0, 0, 1e-3)), "distortion_coefficients: thin-prism "),
    "mrcal code": (MRCAL.replace("0.02", "exit(1)"), "file: is no .cameramodel; "),
    "Basalt": (
        basalt("ds", {"xi": -0.2, "alpha": 0.6}),
        r"value0\.intrinsics\.0\.camera_type: 'ds' is not supported; ",
    ),
    "Basalt missing": (basalt("kb4", {"k1": 0.1}), r"value0\.intrinsics\.0\.intrinsics\.k2: is missing; add it"),
    "Basalt two": (json.dumps(TWO), "file: holds 2 cameras; append one of #0, #1 to the name"),
    "ORB type": (orb("Camera1", "Mei", RADTAN), "Camera.type: 'Mei' is not supported; use PinHole, "),
    "ORB fisheye": (orb("Camera1", "KannalaBrandt8", RADTAN), r"Camera1\.p1: is no coefficient of KannalaBrandt8; "),
    "ORB stereo": (orb("Camera", "", ()) + "LEFT.height: 480\n", "LEFT.height: Camera is of rectified frames here; "),
    "ORB size": (orb("Camera", "", ()).replace("Camera.width", "width"), "Camera.width: is None; give the frame size"),
    "ini fisheye": (INI.replace(" 0.01\n", "\n"), "distortion: 4 coefficients; an .ini has 5 "),
    "ini text": (INI.replace("660.0", "x"), "camera matrix: '0.0 x 238.0' are no numbers; "),
    "ini twice": (INI + INI, "width: given twice; keep one camera"),
    "ini region": (INI.replace("[narrow", "roi\n10 10 300 200\n\n[narrow"), "roi: is no entry of an .ini; "),
    "ini missing": (INI.split("distortion")[0], "distortion: is missing; add it"),
    "Metashape spherical": (metashape(METASHAPE, "spherical"), "projection: 'spherical' is not supported; use frame, "),
    "Metashape skew": (metashape(METASHAPE + "<b2>1</b2>"), "b2: is not zero, and no term of brown_conrady; "),
    "Metashape k4": (metashape(METASHAPE + "<k4>1</k4>"), "k4: is not zero, and no term of brown_conrady; "),
    "Metashape unknown": (metashape(METASHAPE + "<k5>1</k5>"), "k5: is not known of a calibration of Metashape; "),
    "Metashape fisheye p1": (metashape(METASHAPE, "fisheye"), "p1: is not zero, and no term of kannala_brandt; "),
    "PhotoScan": (metashape("<fx>650</fx><cx>320</cx>"), "fx: is of an old PhotoScan; "),
    "from the corner": (metashape(METASHAPE.replace(">3.5<", ">323.5<")), "cx: is 323.5; Metashape counts it from "),
    "other XML": ("<document/>", "file: is XML of <'document'>; OpenCV's <opencv_storage> and Metashape's "),
    "entities": ('<!DOCTYPE a [<!ENTITY b "c">]><calibration/>', "file: declares a document type; "),
    "broken XML": ("<calibration><f></calibration>", "file: is not XML "),
    "OpenCV XML twice": ("<opencv_storage><width>1</width><width>2</width></opencv_storage>", "width: given twice; "),
    "NeRF model": (
        nerf(camera_model="EQUIRECTANGULAR"),
        "camera_model: 'EQUIRECTANGULAR' is not supported; use SIMPLE_",
    ),
    "NeRF k4": (nerf(k4=0.1), "k4: is no coefficient of this lens; it has k1 k2 p1 p2 k3"),
    "NeRF fisheye p1": (nerf(is_fisheye=True), "p1: is no coefficient of this lens; it has k1 k2 k3 k4"),
    "NeRF contradicts": (nerf(camera_model="OPENCV", is_fisheye=True), "is_fisheye: True contradicts the format, "),
    "NeRF frames": (nerf(frames=[{"fl_x": 600}]), "frames: have intrinsics of their own; "),
    "NeRF size": (nerf(w=None), "w: is None; give the frame size"),
    "RealSense inverse": (
        realsense("distortion.inverse_brown_conrady", D),
        "model: 'distortion.inverse_brown_conrady' with ",
    ),
    "RealSense number": (realsense(4, D), "model: 4 is not supported; use none, brown_conrady, "),
    "Open3D rows": (
        json.dumps(OPEN3D | {"intrinsic_matrix": [650.0, 0, 322.5, 0, 660.0, 238.0, 0, 0, 1]}),
        "intrinsic_matrix: does not end in 0, 0, 1 of its last row; write it column by column",
    ),
    "Open3D distortion": (json.dumps(OPEN3D | {"dist_coeffs": [0.1, 0, 0, 0]}), "dist_coeffs: "),
    "BOP fisheye": (json.dumps(json.loads(BOP) | {"lens": "fisheye"}), "lens: 'fisheye' contradicts the format"),
    "two channels": (ND.replace("dt: d", "dt: 2d"), "camera_matrix.dt: is '2d'; write a matrix of one channel"),
    "sizes": (ND.replace("[ 5 ]", "[ 6 ]"), "distortion_coefficients: 5 numbers for 6; "),
    "lens in two words": (ND + "info: {optics: {kind: Fish Eye 2.8mm}}\n", "distortion_model: is missing, and "),
    "leading zeros": (ND.replace("640", "0640"), "image_width: is '0640'; give the frame size as a positive integer"),
    "of another program": ("model_type: PINHOLE\nimage_width: 640\n", "camera_matrix: is missing, and nothing names "),
    "two matrices": (ND + "K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", "camera_matrix: stands as camera_matrix and as K, which"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_certain_is_refused(tmp_path: Path, name: str) -> None:
    text, message = REFUSED[name]
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'cam.any'}: {message}") as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_one_of_several_is_picked(tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_text(json.dumps(TWO))
    assert [Camera.load(f"{tmp_path}/rig.json#{n}").model for n in (0, 1)] == ["kannala_brandt", "brown_conrady"]
    (tmp_path / "orb.yaml").write_text(orb("Camera1", "PinHole", ()) + "Camera2.fx: 1\n")
    assert Camera.load(tmp_path / "orb.yaml#Camera1").matrix[0, 0] == 650
    with pytest.raises(ConfigError, match=r"orb\.yaml: Camera2\.fy: is missing; add it"):
        Camera.load(tmp_path / "orb.yaml#Camera2")


INFO = {
    "width": 640,
    "height": 480,
    "distortion_model": "plumb_bob",
    "D": list(D),
    "K": [F[0], 0, C[0], 0, F[1], C[1], 0, 0, 1],
    "P": [600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0],
}


@pytest.mark.parametrize(
    ("window", "size"),
    [
        (
            {"binning_x": 0, "binning_y": 0, "roi": dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)},
            (640, 480),
        ),
        ({"binning_x": 2, "binning_y": 3}, (320, 160)),
        ({"roi": {"x_offset": 101, "y_offset": 50, "width": 300, "height": 200, "do_rectify": True}}, (300, 200)),
        (
            {"binning_x": 2, "binning_y": 2, "roi": {"x_offset": 100, "y_offset": 50, "width": 301, "height": 200}},
            (150, 100),
        ),
    ],
)
def test_binning_and_region_of_camera_info(tmp_path: Path, window: dict[str, object], size: tuple[int, int]) -> None:
    """A ramp that is cut and binned as the camera does shows where the pixels went."""
    covariance = np.diag([4.0, 9.0, 1.0, 2.0])
    camera = load(tmp_path, json.dumps(INFO | window | {"camera_matrix_covariance": covariance.tolist()}))
    assert (camera.width, camera.height) == size
    roi = window.get("roi") or {}
    assert isinstance(roi, dict)
    x, y = roi.get("x_offset", 0), roi.get("y_offset", 0)
    bx, by = (max(1, int(str(window.get(name, 1)))) for name in ("binning_x", "binning_y"))
    v, u = (ramp[y:, x:] for ramp in np.mgrid[:480, :640].astype(float))
    u, v = (ramp[: size[1] * by, : size[0] * bx].reshape(size[1], by, size[0], bx).mean((1, 3)) for ramp in (u, v))
    # pixel centres of the new frame lie at u, v of the whole one: both cameras see them along the same rays
    whole = load(tmp_path, json.dumps(INFO))
    pixel = torch.tensor([[0.0, 0.0], [size[0] - 1, 0.0], [7.0, size[1] - 1]], dtype=torch.float64)
    j, i = pixel.long().T.numpy()
    there = torch.from_numpy(np.stack([u[i, j], v[i, j]], 1))
    torch.testing.assert_close(camera.undistort_points(pixel), whole.undistort_points(there), rtol=0, atol=1e-12)
    assert camera.covariance is not None
    scale = np.array([bx, by, bx, by], dtype=float)
    np.testing.assert_allclose(camera.covariance.numpy(), covariance / scale / scale[:, None], rtol=1e-12)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        (
            {"roi": {"x_offset": 600, "y_offset": 0, "width": 100, "height": 100}},
            "roi: 100 x 100 px at 600, 0 are not within ",
        ),
        ({"roi": {"x_offset": 10}}, "roi: 0 x 0 px at 10, 0 are not within 640 x 480 px; "),
        ({"roi": [1, 2]}, "roi: is a list of 2; write x_offset, "),
        ({"binning": 2}, "binning: is 2; write binning_x and binning_y"),
        ({"binning_x": -1}, "binning_x: is -1, binning_y 0; "),
        ({"binning_x": "two"}, "binning_x: is 'two'; write a number"),
        ({"binning_x": 1000}, "roi.width: is 0; "),
        ({"binning_x": 1.5}, "binning_x: is 1.5; write a whole number of px"),
        ({"roi": {"x_offset": 1.5, "y_offset": 0, "width": 100, "height": 100}}, "roi.x_offset: is 1.5; write a "),
        ({"roi": {"x_offset": 0, "y_offset": 0, "width": 100.5, "height": 100}}, "roi.width: is 100.5; write a "),
    ],
)
def test_impossible_windows_are_refused(tmp_path: Path, window: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=f"cam.any: {message}"):
        load(tmp_path, json.dumps(INFO | window))

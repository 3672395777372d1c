"""OpenCV YAML, JSON and XML, ROS camera_info (YAML, message, .ini), and plain YAML or JSON."""

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchpose.camera.formats.fields import matrix, number, numbers, shown, size
from torchpose.camera.formats.models import check_none, lens_model
from torchpose.camera.model import Camera
from torchpose.camera.tone import Tone
from torchpose.errors import ConfigError

FIELDS: dict[str, tuple[str, ...]] = {
    "image_width": ("imagewidth", "width"),
    "image_height": ("imageheight", "height"),
    "camera_matrix": ("cameramatrix", "k"),
    "distortion_coefficients": ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "d"),
}
"""Spellings of the fields, in small letters and without signs: `Camera_Matrix` and `cameraMatrix` are one."""
COVARIANCES = ("intrinsics_covariance", "camera_matrix_covariance")
"""Of fx fy cx cy and the distortion, or of the former alone; the first that a file has counts."""
_OWN = {*COVARIANCES, "tone", "adjustment", "roi", "binning_x", "binning_y"}


def read(data: Mapping[str, Any], text: str) -> Camera:
    """The camera of a mapping in the native form."""
    keys = {field: _keys(data, field) for field in FIELDS}
    if not keys["camera_matrix"] and not keys["distortion_coefficients"]:
        raise ConfigError(
            "camera_matrix: is missing, and nothing names a format that is read: OpenCV, ROS, Kalibr, COLMAP, Basalt,"
            " ORB-SLAM, mrcal, RealSense, Open3D, BOP, NeRF, Metashape; write image_width, image_height, camera_matrix"
            " and distortion_coefficients"
        )

    def get(field: str) -> Any:
        values = [data[key] for key in keys[field] if data[key] is not None]
        if not values:
            hint = "; write [] for a camera without distortion" if field == "distortion_coefficients" else "; add it"
            raise ConfigError(f"{field}: is missing{hint}")
        if any(value != values[0] for value in values[1:]):
            raise ConfigError(f"{field}: stands as {' and as '.join(keys[field])}, which differ; keep one")
        return values[0]

    intrinsics = _matrix(get("camera_matrix"))
    frame = size(get("image_width"), "image_width"), size(get("image_height"), "image_height")
    distortion = numbers(get("distortion_coefficients"), "distortion_coefficients").flatten()
    known = _OWN.union(*keys.values())
    model = lens_model(data, known, text=text)
    check_none(data, known, distortion)
    covariance, tone, adjustment = extras(data)
    camera = Camera(*frame, intrinsics, distortion, model, covariance, tone=tone, adjustment=adjustment)
    return _window(data, camera)


def extras(data: Mapping[str, Any]) -> tuple[Tensor | None, Tone | None, str | None]:
    """Covariance, tone and adjustment, where they are given."""
    field = next((name for name in COVARIANCES if data.get(name) is not None), None)
    covariance = None if field is None else numbers(data[field], field)
    tone = None if data.get("tone") is None else Tone.parse(data["tone"])
    name = data.get("adjustment")
    return covariance, tone, None if name is None else str(name)


def _keys(data: Mapping[str, Any], field: str) -> list[str]:
    plain = {key: re.sub(r"[^a-z0-9]", "", key.lower()) for key in data}
    return [key for name in FIELDS[field] for key in data if plain[key] == name]


def _matrix(value: Any) -> Tensor:
    table = numbers(value, "camera_matrix")
    if table.numel() == 9 and 1 in (table.ndim, *table.shape[:1]):
        return table.reshape(3, 3)  # ROS messages write K row by row
    if table.shape != (3, 3):
        raise ConfigError(f"camera_matrix: has shape {tuple(table.shape)}; give 3 rows of 3")
    return table


def _window(data: Mapping[str, Any], camera: Camera) -> Camera:
    """The camera of the frames that ROS's `roi` and `binning` leave of the calibrated ones (sensor_msgs/CameraInfo).

    The region is in pixels of the whole frame; binning then makes one pixel of a block of them, whose centre is the
    mean of theirs: u' = (u - x_offset - (b - 1) / 2) / b.
    """
    for key in ("binning", "x_offset", "y_offset", "offset_x", "offset_y"):
        if data.get(key) not in (None, 0, *([1] if key == "binning" else [])):
            raise ConfigError(f"{key}: is {shown(data[key])}; write binning_x and binning_y, and the offsets below roi")
    bins = [_whole(data.get(name), name) for name in ("binning_x", "binning_y")]
    if any(b < 0 for b in bins):
        raise ConfigError(
            f"binning_x: is {bins[0]}, binning_y {bins[1]}; write 1 or more, or 0 where nothing is binned"
        )
    bins = [b or 1 for b in bins]
    roi = data.get("roi")
    if roi is not None and not isinstance(roi, Mapping):
        raise ConfigError(f"roi: is {shown(roi)}; write x_offset, y_offset, width and height below it")
    region = [_whole((roi or {}).get(name), f"roi.{name}") for name in ("x_offset", "y_offset", "width", "height")]
    if not any(region):
        region = [0, 0, camera.width, camera.height]
    x, y, width, height = region
    if not (0 <= x < x + width <= camera.width and 0 <= y < y + height <= camera.height):
        raise ConfigError(
            f"roi: {width} x {height} px at {x}, {y} are not within {camera.width} x {camera.height} px; "
            "give the region in px of the whole frame"
        )
    if bins == [1, 1] and (width, height) == (camera.width, camera.height):
        return camera
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    bx, by = bins
    moved = matrix(fx / bx, fy / by, (cx - x - 0.5 * (bx - 1)) / bx, (cy - y - 0.5 * (by - 1)) / by)
    covariance = camera.covariance
    if covariance is not None:
        scale = torch.ones(len(covariance), dtype=covariance.dtype)
        scale[:4] = 1 / torch.tensor([bx, by, bx, by], dtype=covariance.dtype)
        covariance = scale[:, None] * covariance * scale
    return Camera(
        size(width // bx, "roi.width"),
        size(height // by, "roi.height"),
        moved,
        camera.distortion,
        camera.model,
        covariance,
        tone=camera.tone,
        adjustment=camera.adjustment,
    )


def _whole(value: Any, field: str) -> int:
    """A number of pixels, 0 where nothing is said."""
    found = number(value or 0, field)
    if not found.is_integer():
        raise ConfigError(f"{field}: is {found:g}; write a whole number of px")
    return int(found)


_INI_NAME = re.compile(r"[a-z_][a-z_ ]*", re.IGNORECASE)


def read_ini(lines: list[str]) -> Camera:
    """ROS's .ini: a line with a name, then lines of its numbers, below headings in brackets.

    It holds the five coefficients of `plumb_bob` or the eight of `rational_polynomial`. A file of four is what
    calibrations of a fisheye write as well.
    """
    blocks: dict[str, list[list[float]]] = {}
    heading, name = "", ""
    for line in (line.strip() for line in lines):
        if line.startswith("["):
            heading, name = line.strip("[]"), ""
        elif _INI_NAME.fullmatch(line) and line.lower() not in ("nan", "inf", "infinity"):
            name = line if heading != "externals" else f"externals {line}"
            if name in blocks:
                raise ConfigError(f"{name}: given twice; keep one camera")
            blocks[name] = []
        elif name:
            try:
                blocks[name].append([float(word) for word in line.split()])
            except ValueError:
                raise ConfigError(f"{name}: {shown(line)} are no numbers; write numbers only") from None
        else:
            raise ConfigError(f"[{heading}]: {shown(line)} stands below no name; write width, camera matrix and so on")
    wanted = {"image_width": "width", "image_height": "height", "camera_matrix": "camera matrix"}
    wanted["distortion_coefficients"] = "distortion"
    for key in wanted.values():
        if key not in blocks:
            raise ConfigError(f"{key}: is missing; add it")
    for key in blocks:
        if key not in (*wanted.values(), "rectification", "projection") and not key.startswith("externals "):
            raise ConfigError(
                f"{key}: is no entry of an .ini; write a camera_info with binning and roi for frames that have them"
            )
    data: dict[str, Any] = {field: blocks[key] for field, key in wanted.items()}
    for field in ("image_width", "image_height"):
        flat = [value for row in data[field] for value in row]
        data[field] = flat[0] if len(flat) == 1 else flat
    count = sum(map(len, data["distortion_coefficients"]))
    if count not in (5, 8):
        raise ConfigError(
            f"distortion: {count} coefficients; an .ini has 5 (plumb_bob) or 8 (rational_polynomial): write a YAML file"
            " with distortion_model for another lens"
        )
    return read(data, "")

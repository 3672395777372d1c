"""Camera files: OpenCV YAML and JSON, ROS camera_info, plain YAML or JSON, Kalibr camchain, COLMAP cameras.txt.

The format of a file is recognised by its content; keys that are not ours are ignored. `FIELDS` has the
spellings read.
COLMAP counts pixels from the corner of the first pixel: its principal point is ours + 0.5.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import torch

from torchpose.camera.model import Camera, Model
from torchpose.config import format_list, format_number, parse_mapping, read_text, suggest, write_text
from torchpose.errors import ConfigError

FIELDS: dict[str, tuple[str, ...]] = {
    "image_width": ("image_width", "width"),
    "image_height": ("image_height", "height"),
    "camera_matrix": ("camera_matrix", "cameraMatrix", "K", "k"),
    "distortion_coefficients": ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D", "d"),
}
MODELS: dict[str, Model] = {
    "brown_conrady": "brown_conrady",
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "radtan": "brown_conrady",
    "none": "brown_conrady",
    "kannala_brandt": "kannala_brandt",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}
# COLMAP's parameters as ours: number of focal lengths, then the slot of each further one after the principal point
COLMAP_MODELS: dict[str, tuple[int, Model, tuple[int, ...], int]] = {
    "SIMPLE_PINHOLE": (1, "brown_conrady", (), 0),
    "PINHOLE": (2, "brown_conrady", (), 0),
    "SIMPLE_RADIAL": (1, "brown_conrady", (0,), 4),
    "RADIAL": (1, "brown_conrady", (0, 1), 4),
    "OPENCV": (2, "brown_conrady", (0, 1, 2, 3), 4),
    "FULL_OPENCV": (2, "brown_conrady", (0, 1, 2, 3, 4, 5, 6, 7), 8),
    "SIMPLE_RADIAL_FISHEYE": (1, "kannala_brandt", (0,), 4),
    "RADIAL_FISHEYE": (1, "kannala_brandt", (0, 1), 4),
    "OPENCV_FISHEYE": (2, "kannala_brandt", (0, 1, 2, 3), 4),
}
_COLMAP_LINE = re.compile(r"\d+\s+[A-Z][A-Z_0-9]*(\s|$)")


def load(path: str | os.PathLike[str]) -> Camera:
    """The camera in a file; ``FILE#cam1`` (Kalibr) or ``FILE#2`` (COLMAP's CAMERA_ID) picks one of several.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
    """
    name, selector = os.fspath(path), None
    if "#" in name and not Path(name).is_file():
        name, selector = name.rsplit("#", 1)
    text = read_text(name)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    readers: dict[str, Callable[[str], Camera]]
    if lines and _COLMAP_LINE.match(lines[0].strip()):
        rows = [line.split() for line in lines]
        readers = {row[0]: _colmap_reader(row) for row in rows}
        if len(readers) < len(rows):
            raise ConfigError(f"{name}: CAMERA_ID: given twice; keep one line for each camera")
    else:
        if text.lstrip().startswith(("<?xml", "<opencv_storage")):
            raise ConfigError(f"{name}: file: is XML; save it as YAML (cv2.FileStorage with the suffix .yaml)")
        if all(line.lstrip().startswith("#") for line in text.splitlines() if line.strip()):
            raise ConfigError(f"{name}: file: holds only comments; write the fields into it")
        data = parse_mapping(text, name)
        chain = {key: value for key, value in data.items() if re.fullmatch(r"cam\d+", key)}
        if not chain:
            if selector is not None:
                raise ConfigError(f"{name}: #{selector}: the file holds one camera only; drop #{selector}")
            return _read(_native, data, name)
        readers = {key: _kalibr_reader(value) for key, value in chain.items()}
    choices = ", ".join(f"#{key}" for key in readers)
    if selector is None and len(readers) > 1:
        raise ConfigError(f"{name}: file: holds {len(readers)} cameras; append one of {choices} to the name")
    if selector is not None and selector not in readers:
        raise ConfigError(f"{name}: #{selector}: no such camera; choose {choices}")
    return _read(lambda key: readers[key](key), selector or next(iter(readers)), name)


def save(camera: Camera, path: str | os.PathLike[str], format: str | None = None) -> None:
    """Writes a camera file; numbers read back exactly.

    Args:
        format: opencv (also readable by cv2.FileStorage), json, ros (camera_info), kalibr (camchain of one camera) or
            colmap (cameras.txt with CAMERA_ID 1; it has no place for the covariance, which is left out).
            None: .yaml and .yml are opencv, .json is json, .txt is colmap.

    Raises:
        ConfigError: unknown suffix or format, a format that cannot hold the distortion, or a folder that is not there.
    """
    writers: dict[str, Callable[[Camera], str]] = {
        "opencv": _opencv_text,
        "json": _json_text,
        "ros": _ros_text,
        "kalibr": _kalibr_text,
        "colmap": _colmap_text,
    }
    suffixes = {".yaml": "opencv", ".yml": "opencv", ".json": "json", ".txt": "colmap"}
    name = os.fspath(path)
    if format is None:
        suffix = Path(name).suffix.lower()
        if suffix not in suffixes:
            raise ConfigError(f"{name}: suffix: {suffix!r} is not known; use {', '.join(suffixes)} or give a format")
        format = suffixes[suffix]
    if format not in writers:
        raise ConfigError(f"{name}: format: {format!r} is not known; {suggest(format, writers)}")
    try:
        text = writers[format](camera)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    write_text(name, text)


def _read(reader: Callable[[Any], Camera], source: Any, name: str) -> Camera:
    try:
        return reader(source)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def _native(data: Mapping[str, Any]) -> Camera:
    def get(field: str) -> Any:
        value = next((data[key] for key in FIELDS[field] if key in data), None)
        if value is None:
            hint = "; write [] for a camera without distortion" if field == "distortion_coefficients" else "; add it"
            raise ConfigError(f"{field}: is missing{hint}")
        return value

    matrix = _numbers(get("camera_matrix"), "camera_matrix")
    if matrix.numel() == 9 and 1 in (matrix.ndim, *matrix.shape[:1]):
        matrix = matrix.reshape(3, 3)  # ROS messages write K row by row
    elif matrix.shape != (3, 3):
        raise ConfigError(f"camera_matrix: has shape {tuple(matrix.shape)}; give 3 rows of 3")
    covariance = data.get("camera_matrix_covariance")
    default = "fisheye" if data.get("fisheye_model") in (1, True) else "brown_conrady"
    return Camera(
        _size(get("image_width"), "image_width"),
        _size(get("image_height"), "image_height"),
        matrix,
        _numbers(get("distortion_coefficients"), "distortion_coefficients").flatten(),
        _model(data.get("distortion_model", default)),
        None if covariance is None else _numbers(covariance, "camera_matrix_covariance"),
    )


def _kalibr_reader(entry: Any) -> Callable[[str], Camera]:
    def read(key: str) -> Camera:
        if not isinstance(entry, Mapping):
            raise ConfigError(f"{key}: is not a mapping; write `intrinsics:` and so on below it")
        for field in ("intrinsics", "resolution", "distortion_model", "distortion_coeffs"):
            if field not in entry:
                raise ConfigError(f"{key}.{field}: is missing; add it")
        if entry.get("camera_model", "pinhole") != "pinhole":
            raise ConfigError(f"{key}.camera_model: is {entry['camera_model']!r}; calibrate with pinhole")
        intrinsics = _numbers(entry["intrinsics"], f"{key}.intrinsics")
        if intrinsics.shape != (4,):
            raise ConfigError(f"{key}.intrinsics: has shape {tuple(intrinsics.shape)}; give [fx, fy, cx, cy]")
        resolution = entry["resolution"]
        if not isinstance(resolution, list) or len(resolution) != 2:
            raise ConfigError(f"{key}.resolution: is {resolution!r}; give [width, height]")
        covariance = entry.get("camera_matrix_covariance")
        names = {
            "image_width": "resolution",
            "image_height": "resolution",
            "camera_matrix": "intrinsics",
            "distortion_coefficients": "distortion_coeffs",
        }
        try:
            return Camera(
                _size(resolution[0], "image_width"),
                _size(resolution[1], "image_height"),
                _matrix(*intrinsics.tolist()),
                _numbers(entry["distortion_coeffs"], "distortion_coefficients").flatten(),
                _model(entry["distortion_model"]),
                None if covariance is None else _numbers(covariance, "camera_matrix_covariance"),
            )
        except ConfigError as error:
            field, _, problem = str(error).partition(": ")
            raise ConfigError(f"{key}.{names.get(field, field)}: {problem}") from None

    return read


def _colmap_reader(row: list[str]) -> Callable[[str], Camera]:
    def read(key: str) -> Camera:
        model_name = row[1] if len(row) > 1 else ""
        if model_name not in COLMAP_MODELS:
            raise ConfigError(f"camera {key}: MODEL: {model_name!r} is not supported; use {', '.join(COLMAP_MODELS)}")
        focals, model, slots, count = COLMAP_MODELS[model_name]
        wanted = focals + 2 + len(slots)
        if len(row) != 4 + wanted:
            raise ConfigError(f"camera {key}: PARAMS: {max(len(row) - 4, 0)} parameters; {model_name} has {wanted}")
        try:
            # in decimals, so that the half pixel costs no digit
            params = [Decimal(p) for p in row[4:]]
            fx, fy = float(params[0]), float(params[focals - 1])
            cx, cy = (float(p - Decimal("0.5")) for p in params[focals : focals + 2])
        except (ArithmeticError, ValueError):
            raise ConfigError(f"camera {key}: PARAMS: not all are numbers; write numbers only") from None
        distortion = [0.0] * count
        for slot, value in zip(slots, params[focals + 2 :], strict=True):
            distortion[slot] = float(value)
        names = {"image_width": "WIDTH", "image_height": "HEIGHT"}
        try:
            width, height = (_size(_integer(text), f) for text, f in zip(row[2:4], names, strict=True))
            return Camera(width, height, _matrix(fx, fy, cx, cy), torch.tensor(distortion, dtype=torch.float64), model)
        except ConfigError as error:
            field, _, problem = str(error).partition(": ")
            raise ConfigError(f"camera {key}: {names.get(field, 'PARAMS')}: {problem}") from None

    return read


def _integer(text: str) -> int | str:
    return int(text) if text.isascii() and text.isdigit() else text


def _size(value: Any, field: str) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
        raise ConfigError(f"{field}: is {value!r}; give the frame size as a positive integer, in px")
    return value


def _model(name: Any) -> Model:
    if not isinstance(name, str) or name not in MODELS:
        raise ConfigError(f"distortion_model: {name!r} is not supported; use one of {', '.join(MODELS)}")
    return MODELS[name]


def _matrix(fx: float, fy: float, cx: float, cy: float) -> torch.Tensor:
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _numbers(value: Any, field: str) -> torch.Tensor:
    """Float64 tensor of nested lists or of a mapping with rows, cols and data."""
    shape = None
    if isinstance(value, Mapping):
        if missing := [key for key in ("rows", "cols", "data") if key not in value]:
            raise ConfigError(f"{field}.{missing[0]}: is missing; a matrix has rows, cols and data")
        shape = (value["rows"], value["cols"])
        value = value["data"]
        if not all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in shape):
            raise ConfigError(f"{field}: rows and cols are {shape}; write integers")
    if not isinstance(value, list):
        raise ConfigError(f"{field}: is {str(value)[:40]!r}; write a list of numbers")
    for entry in (e for row in value for e in (row if isinstance(row, list) else [row])):
        if isinstance(entry, bool) or not isinstance(entry, int | float):
            raise ConfigError(f"{field}: {str(entry)[:40]!r} is not a number; write numbers only")
    try:
        tensor = torch.tensor(value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise ConfigError(f"{field}: rows differ in length; write equally long rows of numbers") from None
    if shape is not None:
        if tensor.numel() != shape[0] * shape[1]:
            raise ConfigError(
                f"{field}: {tensor.numel()} numbers for {shape[0]} x {shape[1]}; correct rows, cols or data"
            )
        tensor = tensor.reshape(shape)
    return tensor


def _row(values: torch.Tensor) -> str:
    return format_list(values.detach().flatten().tolist())


def _mapping_matrix(name: str, values: torch.Tensor, tag: str = "") -> str:
    rows, cols = values.shape if values.ndim == 2 else ((1, len(values)) if len(values) else (0, 0))
    kind = "\n   dt: d" if tag else ""
    return f"{name}:{tag}\n   rows: {rows}\n   cols: {cols}{kind}\n   data: {_row(values)}\n"


def _opencv_text(camera: Camera) -> str:
    tag = " !!opencv-matrix"
    text = (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        + _mapping_matrix("camera_matrix", camera.matrix, tag)
        + f"distortion_model: {camera.model}\n"
        + _mapping_matrix("distortion_coefficients", camera.distortion, tag)
    )
    if camera.covariance is not None:
        text += _mapping_matrix("camera_matrix_covariance", camera.covariance, tag)
    return text


def _json_text(camera: Camera) -> str:
    def table(values: torch.Tensor) -> str:
        return "[" + ", ".join(map(_row, values)) + "]"

    fields = [
        f'"image_width": {camera.width}',
        f'"image_height": {camera.height}',
        f'"camera_matrix": {table(camera.matrix)}',
        f'"distortion_model": "{camera.model}"',
        f'"distortion_coefficients": {_row(camera.distortion)}',
    ]
    if camera.covariance is not None:
        fields.append(f'"camera_matrix_covariance": {table(camera.covariance)}')
    return "{\n  " + ",\n  ".join(fields) + "\n}\n"


def _ros_text(camera: Camera) -> str:
    d = camera.distortion
    if camera.model == "kannala_brandt":
        model = "equidistant"
    else:  # plumb_bob has five coefficients, rational_polynomial eight
        d = torch.nn.functional.pad(d, (0, (8 if len(d) == 8 else 5) - len(d)))
        model = "rational_polynomial" if len(d) == 8 else "plumb_bob"
    projection = torch.nn.functional.pad(camera.matrix, (0, 1))
    text = (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: camera\n"
        + _mapping_matrix("camera_matrix", camera.matrix)
        + f"distortion_model: {model}\n"
        + _mapping_matrix("distortion_coefficients", d)
        + _mapping_matrix("rectification_matrix", torch.eye(3))
        + _mapping_matrix("projection_matrix", projection)
    )
    if camera.covariance is not None:
        text += _mapping_matrix("camera_matrix_covariance", camera.covariance)
    return text


def _focal_center(camera: Camera) -> tuple[float, float, float, float]:
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.detach().tolist()
    return fx, fy, cx, cy


def _kalibr_text(camera: Camera) -> str:
    d = torch.nn.functional.pad(camera.distortion.detach(), (0, 8 - len(camera.distortion)))
    if bool(d[4:].any()):
        raise ConfigError("distortion_coefficients: Kalibr holds k1 k2 p1 p2 only; save in the format opencv or ros")
    text = (
        "cam0:\n  camera_model: pinhole\n"
        f"  intrinsics: {format_list(_focal_center(camera))}\n"
        f"  distortion_model: {'equidistant' if camera.model == 'kannala_brandt' else 'radtan'}\n"
        f"  distortion_coeffs: {_row(d[:4])}\n"
        f"  resolution: [{camera.width}, {camera.height}]\n"
        "  rostopic: /cam0/image_raw\n"
    )
    if camera.covariance is not None:
        text += "  camera_matrix_covariance:\n" + "".join(f"    - {_row(row)}\n" for row in camera.covariance)
    return text


def _colmap_text(camera: Camera) -> str:
    fx, fy, cx, cy = _focal_center(camera)
    d = camera.distortion.detach().tolist()
    if camera.model == "kannala_brandt":
        model = "OPENCV_FISHEYE"
    elif not d:
        model = "PINHOLE"
    else:
        model = "FULL_OPENCV" if any(d[4:]) else "OPENCV"
    d = (d + [0.0] * 8)[: len(COLMAP_MODELS[model][2])]
    center = [str(Decimal(repr(c)) + Decimal("0.5")) for c in (cx, cy)]
    params = [format_number(fx), format_number(fy), *center, *map(format_number, d)]
    return (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {camera.width} {camera.height} {' '.join(params)}\n"
    )

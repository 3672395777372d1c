"""Camera files: OpenCV YAML and JSON, ROS camera_info, plain YAML or JSON, Kalibr camchain, COLMAP cameras.txt.

The format of a file is recognised by its content; keys that are not ours are ignored. `FIELDS` has the
spellings read.
COLMAP counts pixels from the corner of the first pixel: its principal point is ours + 0.5.
"""

import os
import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import pad

from torchpose.camera.model import Camera, Model
from torchpose.camera.tone import Tone
from torchpose.config import format_list, format_number, parse_mapping, read_text, suggest, within, write_text
from torchpose.errors import ConfigError

FIELDS: dict[str, tuple[str, ...]] = {
    "image_width": ("image_width", "width"),
    "image_height": ("image_height", "height"),
    "camera_matrix": ("camera_matrix", "cameraMatrix", "K", "k"),
    "distortion_coefficients": ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D", "d"),
}
COVARIANCES = ("intrinsics_covariance", "camera_matrix_covariance")
"""Of fx fy cx cy and the distortion, or of the former alone; the first that a file has counts."""
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
    with within(f"{name}: "):
        lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        if text.lstrip().startswith(("<?xml", "<opencv_storage")):
            raise ConfigError("file: is XML; save it as YAML (cv2.FileStorage with the suffix .yaml)")
        if not lines:
            raise ConfigError("file: holds only comments; write the fields into it")
        if _COLMAP_LINE.match(lines[0].strip()):
            rows = [line.split() for line in lines]
            readers = {row[0]: partial(_colmap, row) for row in rows}
            if len(readers) < len(rows):
                raise ConfigError("CAMERA_ID: given twice; keep one line for each camera")
        else:
            data = parse_mapping(text)
            readers = {key: partial(_kalibr, key, data[key]) for key in data if re.fullmatch(r"cam\d+", key)}
            if not readers:
                if selector is not None:
                    raise ConfigError(f"#{selector}: the file holds one camera only; drop #{selector}")
                return _native(data)
        choices = ", ".join(f"#{key}" for key in readers)
        if selector is None and len(readers) > 1:
            raise ConfigError(f"file: holds {len(readers)} cameras; append one of {choices} to the name")
        if selector is not None and selector not in readers:
            raise ConfigError(f"#{selector}: no such camera; choose {choices}")
        return readers[selector or next(iter(readers))]()


def save(camera: Camera, path: str | os.PathLike[str], format: str | None = None) -> None:
    """Writes a camera file; numbers read back exactly.

    Args:
        camera: what to write.
        path: where to.
        format: opencv (also readable by cv2.FileStorage), json, ros (camera_info), kalibr (camchain of one camera) or
            colmap (cameras.txt with CAMERA_ID 1; it has no place for covariance and tone, which are left out).
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
    with within(f"{name}: "):
        if format is None:
            suffix = Path(name).suffix.lower()
            if suffix not in suffixes:
                raise ConfigError(f"suffix: {suffix!r} is not known; use {', '.join(suffixes)} or give a format")
            format = suffixes[suffix]
        if format not in writers:
            raise ConfigError(f"format: {format!r} is not known; {suggest(format, writers)}")
        text = writers[format](camera)
    write_text(name, text)


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
    default = "fisheye" if data.get("fisheye_model") in (1, True) else "brown_conrady"
    return Camera(
        _size(get("image_width"), "image_width"),
        _size(get("image_height"), "image_height"),
        matrix,
        _numbers(get("distortion_coefficients"), "distortion_coefficients").flatten(),
        _model(data.get("distortion_model", default)),
        _covariance(data),
        tone=_tone(data),
        adjustment=_adjustment(data),
    )


def _kalibr(key: str, entry: Any) -> Camera:
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{key}: is not a mapping; write `intrinsics:` and so on below it")
    names = {
        "image_width": "resolution",
        "image_height": "resolution",
        "camera_matrix": "intrinsics",
        "distortion_coefficients": "distortion_coeffs",
    }
    with within(f"{key}.", names):
        for field in ("intrinsics", "resolution", "distortion_model", "distortion_coeffs"):
            if field not in entry:
                raise ConfigError(f"{field}: is missing; add it")
        if entry.get("camera_model", "pinhole") != "pinhole":
            raise ConfigError(f"camera_model: is {entry['camera_model']!r}; calibrate with pinhole")
        intrinsics = _numbers(entry["intrinsics"], "intrinsics")
        if intrinsics.shape != (4,):
            raise ConfigError(f"intrinsics: has shape {tuple(intrinsics.shape)}; give [fx, fy, cx, cy]")
        resolution = entry["resolution"]
        if not isinstance(resolution, list) or len(resolution) != 2:
            raise ConfigError(f"resolution: is {resolution!r}; give [width, height]")
        return Camera(
            _size(resolution[0], "image_width"),
            _size(resolution[1], "image_height"),
            _matrix(*intrinsics.tolist()),
            _numbers(entry["distortion_coeffs"], "distortion_coefficients").flatten(),
            _model(entry["distortion_model"]),
            _covariance(entry),
            tone=_tone(entry),
            adjustment=_adjustment(entry),
        )


def _colmap(row: list[str]) -> Camera:
    with within(f"camera {row[0]}: ", {"image_width": "WIDTH", "image_height": "HEIGHT", "MODEL": "MODEL"}, "PARAMS"):
        name = row[1] if len(row) > 1 else ""
        if name not in COLMAP_MODELS:
            raise ConfigError(f"MODEL: {name!r} is not supported; use {', '.join(COLMAP_MODELS)}")
        focals, model, slots, count = COLMAP_MODELS[name]
        wanted = focals + 2 + len(slots)
        if len(row) != 4 + wanted:
            raise ConfigError(f"PARAMS: {max(len(row) - 4, 0)} parameters; {name} has {wanted}")
        try:
            # in decimals, so that the half pixel costs no digit
            params = [Decimal(text) for text in row[4:]]
            fx, fy = float(params[0]), float(params[focals - 1])
            cx, cy = (float(center - Decimal("0.5")) for center in params[focals : focals + 2])
        except (ArithmeticError, ValueError):
            raise ConfigError("PARAMS: not all are numbers; write numbers only") from None
        distortion = torch.zeros(count, dtype=torch.float64)
        for slot, value in zip(slots, params[focals + 2 :], strict=True):
            distortion[slot] = float(value)
        width, height = _size(_integer(row[2]), "image_width"), _size(_integer(row[3]), "image_height")
        return Camera(width, height, _matrix(fx, fy, cx, cy), distortion, model)


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


def _covariance(data: Mapping[str, Any]) -> torch.Tensor | None:
    field = next((name for name in COVARIANCES if data.get(name) is not None), None)
    return None if field is None else _numbers(data[field], field)


def _adjustment(data: Mapping[str, Any]) -> str | None:
    name = data.get("adjustment")
    return None if name is None else str(name)


def _tone(data: Mapping[str, Any]) -> Tone | None:
    return None if data.get("tone") is None else Tone.parse(data["tone"])


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


def _yaml(entries: Mapping[str, Any], tag: str = "") -> str:
    """Lines of YAML; tensors as mappings of rows, cols and data, those that are None left out."""
    kind = "\n   dt: d" if tag else ""
    text = ""
    for name, value in entries.items():
        if isinstance(value, torch.Tensor):
            rows, cols = value.shape if value.ndim == 2 else ((1, len(value)) if len(value) else (0, 0))
            text += f"{name}:{tag}\n   rows: {rows}\n   cols: {cols}{kind}\n   data: {_row(value)}\n"
        elif value is not None:
            # a colon within a word would start a mapping
            text += f'{name}: "{value}"\n' if ":" in str(value) else f"{name}: {value}\n"
    return text


def _entries(camera: Camera) -> dict[str, Any]:
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": camera.matrix,
        "distortion_model": camera.model,
        "distortion_coefficients": camera.distortion,
        **_covariances(camera),
        "tone": None if camera.tone is None else str(camera.tone),
        "adjustment": camera.adjustment,
    }


def _covariances(camera: Camera) -> dict[str, torch.Tensor]:
    """Keys and tables of a camera's covariance: that of the matrix for all readers, and the whole one where known."""
    whole, of_matrix = COVARIANCES
    if camera.covariance is None:
        return {}
    tables = {of_matrix: camera.covariance[:4, :4]}
    return tables if len(camera.covariance) == 4 else tables | {whole: camera.covariance}


def _opencv_text(camera: Camera) -> str:
    return "%YAML:1.0\n---\n" + _yaml(_entries(camera), " !!opencv-matrix")


def _json_text(camera: Camera) -> str:
    def written(value: Any) -> str:
        if not isinstance(value, torch.Tensor):
            return f'"{value}"' if isinstance(value, str) else f"{value}"
        return _row(value) if value.ndim == 1 else "[" + ", ".join(map(_row, value)) + "]"

    fields = [f'  "{name}": {written(value)}' for name, value in _entries(camera).items() if value is not None]
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _ros_text(camera: Camera) -> str:
    entries, model = _entries(camera), "equidistant"
    coefficients = camera.distortion
    covariances = {name: entries.pop(name) for name in COVARIANCES if name in entries}
    last = {name: entries.pop(name) for name in ("tone", "adjustment")}
    if camera.model == "brown_conrady":  # plumb_bob has five coefficients, rational_polynomial eight
        model = "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
        coefficients = pad(coefficients, (0, (8 if len(coefficients) == 8 else 5) - len(coefficients)))
    entries |= {
        "distortion_model": model,
        "distortion_coefficients": coefficients,
        "camera_name": "camera",
        "rectification_matrix": torch.eye(3),
        "projection_matrix": pad(camera.matrix, (0, 1)),
    }
    added = len(coefficients) - len(camera.distortion)  # coefficients of 0, as good as known
    covariances = {
        name: pad(table, (0, added, 0, added)) if len(table) > 4 else table for name, table in covariances.items()
    }
    return _yaml(entries | covariances | last)


def _focal_center(camera: Camera) -> tuple[float, float, float, float]:
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.detach().tolist()
    return fx, fy, cx, cy


def _kalibr_text(camera: Camera) -> str:
    d = pad(camera.distortion.detach(), (0, 8 - len(camera.distortion)))
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
    for name, table in _covariances(camera).items():
        text += f"  {name}:\n" + "".join(f"    - {_row(row)}\n" for row in table)
    if camera.adjustment is not None:
        text += f"  adjustment: {camera.adjustment}\n"
    if camera.tone is not None:
        text += f'  tone: "{camera.tone}"\n'
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

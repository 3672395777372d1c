"""Writing camera files; numbers read back exactly."""

import os
from collections.abc import Callable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import pad

from torchpose.camera.formats.native import COVARIANCES
from torchpose.camera.formats.reconstruction import COLMAP_MODELS
from torchpose.camera.model import Camera
from torchpose.config import format_list, format_number, suggest, within, write_text
from torchpose.errors import ConfigError


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


def row(values: torch.Tensor) -> str:
    """Numbers as a list in a file."""
    return format_list(values.detach().flatten().tolist())


def _yaml(entries: Mapping[str, Any], tag: str = "") -> str:
    """Lines of YAML; tensors as mappings of rows, cols and data, those that are None left out."""
    kind = "\n   dt: d" if tag else ""
    text = ""
    for name, value in entries.items():
        if isinstance(value, torch.Tensor):
            rows, cols = value.shape if value.ndim == 2 else ((1, len(value)) if len(value) else (0, 0))
            text += f"{name}:{tag}\n   rows: {rows}\n   cols: {cols}{kind}\n   data: {row(value)}\n"
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
        **covariances(camera),
        "tone": None if camera.tone is None else str(camera.tone),
        "adjustment": camera.adjustment,
    }


def covariances(camera: Camera) -> dict[str, torch.Tensor]:
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
        return row(value) if value.ndim == 1 else "[" + ", ".join(map(row, value)) + "]"

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


def focal_center(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.detach().tolist()
    return fx, fy, cx, cy


def _kalibr_text(camera: Camera) -> str:
    d = pad(camera.distortion.detach(), (0, 8 - len(camera.distortion)))
    if bool(d[4:].any()):
        raise ConfigError("distortion_coefficients: Kalibr holds k1 k2 p1 p2 only; save in the format opencv or ros")
    text = (
        "cam0:\n  camera_model: pinhole\n"
        f"  intrinsics: {format_list(focal_center(camera))}\n"
        f"  distortion_model: {'equidistant' if camera.model == 'kannala_brandt' else 'radtan'}\n"
        f"  distortion_coeffs: {row(d[:4])}\n"
        f"  resolution: [{camera.width}, {camera.height}]\n"
        "  rostopic: /cam0/image_raw\n"
    )
    for name, table in covariances(camera).items():
        text += f"  {name}:\n" + "".join(f"    - {row(line)}\n" for line in table)
    if camera.adjustment is not None:
        text += f"  adjustment: {camera.adjustment}\n"
    if camera.tone is not None:
        text += f'  tone: "{camera.tone}"\n'
    return text


def _colmap_text(camera: Camera) -> str:
    fx, fy, cx, cy = focal_center(camera)
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

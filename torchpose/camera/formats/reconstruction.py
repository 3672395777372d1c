"""Files of reconstruction from photographs: COLMAP cameras.txt, NeRF transforms.json, Metashape calibrations.

All three count pixels from the corner of the first pixel: their principal point is ours + 0.5.
"""

import math
from collections.abc import Callable, Mapping
from decimal import Decimal
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element

import torch

from torchpose.camera.formats.fields import from_corner, listed, matrix, number, shown, size
from torchpose.camera.formats.models import lens_model
from torchpose.camera.model import Camera, Model
from torchpose.config import within
from torchpose.errors import ConfigError

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
# nerfstudio's names; instant-ngp writes none, and `is_fisheye`
NERF_MODELS: dict[str, Model] = {
    "SIMPLE_PINHOLE": "brown_conrady",
    "PINHOLE": "brown_conrady",
    "SIMPLE_RADIAL": "brown_conrady",
    "RADIAL": "brown_conrady",
    "OPENCV": "brown_conrady",
    "OPENCV_FISHEYE": "kannala_brandt",
}
_METASHAPE_NUMBERS = ("width", "height", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
METASHAPE_MODELS: dict[str, Model] = {"frame": "brown_conrady", "fisheye": "kannala_brandt"}
# px between the principal point and the middle of the frame, as a share of its side. A quarter is no lens: the file
# counts from the corner, as PhotoScan's did once (convention)
_FARTHEST_FROM_MIDDLE = 0.25


def colmap(rows: list[list[str]]) -> dict[str, Callable[[], Camera]]:
    """The cameras of the lines of a cameras.txt, by their CAMERA_ID."""
    readers: dict[str, Callable[[], Camera]] = {row[0]: partial(_colmap, row) for row in rows}
    if odd := next((key for key in readers if not isinstance(_integer(key), int)), None):
        raise ConfigError(f"CAMERA_ID: is {shown(odd)}; write one line for each camera, beginning with its number")
    if len(readers) < len(rows):
        raise ConfigError("CAMERA_ID: given twice; keep one line for each camera")
    return readers


def _colmap(row: list[str]) -> Camera:
    names = {name: name for name in ("MODEL", "PARAMS")} | {"image_width": "WIDTH", "image_height": "HEIGHT"}
    with within(f"camera {row[0]}: ", names, "PARAMS"):
        name = row[1] if len(row) > 1 else ""
        if name not in COLMAP_MODELS:
            raise ConfigError(f"MODEL: {shown(name)} is not supported; use {', '.join(COLMAP_MODELS)}")
        focals, model, slots, count = COLMAP_MODELS[name]
        wanted = focals + 2 + len(slots)
        if len(row) != 4 + wanted:
            raise ConfigError(f"PARAMS: {max(len(row) - 4, 0)} parameters; {name} has {wanted}")
        try:
            # in decimals, so that the half pixel costs no digit
            params = [Decimal(text) for text in row[4:]]
            fx, fy = float(params[0]), float(params[focals - 1])
            cx, cy = (float(center - Decimal("0.5")) for center in params[focals : focals + 2])
            distortion = torch.zeros(count, dtype=torch.float64)
            for slot, value in zip(slots, params[focals + 2 :], strict=True):
                distortion[slot] = float(value)
        except (ArithmeticError, ValueError):
            raise ConfigError("PARAMS: not all are numbers; write numbers only") from None
        width, height = size(_integer(row[2]), "image_width"), size(_integer(row[3]), "image_height")
        return Camera(width, height, matrix(fx, fy, cx, cy), distortion, model)


def _integer(text: str) -> int | str:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else text


def is_nerf(data: Mapping[str, Any]) -> bool:
    """Whether a mapping is a transforms.json."""
    return "fl_x" in data or "camera_angle_x" in data


def nerf(data: Mapping[str, Any]) -> Camera:
    """The camera of a transforms.json (instant-ngp, nerfstudio), where all of its frames have one."""
    frames = data.get("frames", [])
    own = ("fl_x", "camera_angle_x", "cx", "k1", "w")
    if isinstance(frames, list) and any(isinstance(f, Mapping) and any(key in f for key in own) for f in frames):
        raise ConfigError("frames: have intrinsics of their own; write the camera into a file of its own")
    model = _nerf_model(data)
    width, height = size(data.get("w"), "w"), size(data.get("h"), "h")
    fx = _nerf_focal(data, "x", width)
    fy = _nerf_focal(data, "y", height) if "fl_y" in data or "camera_angle_y" in data else fx
    center = [number(data[key], key) if key in data else 0.5 * side for key, side in (("cx", width), ("cy", height))]
    names = ("k1", "k2", "k3", "k4") if model == "kannala_brandt" else ("k1", "k2", "p1", "p2", "k3")
    given = {key: number(data[key], key) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2") if key in data}
    if odd := next((key for key, value in given.items() if value and key not in names), None):
        raise ConfigError(f"{odd}: is no coefficient of this lens; it has {' '.join(names)}")
    distortion = [given.get(key, 0.0) for key in names]
    cx, cy = map(from_corner, center)
    return Camera(width, height, matrix(fx, fy, cx, cy), distortion, model)


def _nerf_model(data: Mapping[str, Any]) -> Model:
    name = data.get("camera_model")
    if name is not None and (not isinstance(name, str) or name not in NERF_MODELS):
        raise ConfigError(f"camera_model: {shown(name)} is not supported; use {', '.join(NERF_MODELS)}")
    implied = None if name is None else NERF_MODELS[name]
    return lens_model(data, {"camera_model", "frames"}, implied=implied)


def _nerf_focal(data: Mapping[str, Any], axis: str, side: int) -> float:
    if f"fl_{axis}" in data:
        return number(data[f"fl_{axis}"], f"fl_{axis}")
    name = f"camera_angle_{axis}"
    angle = number(data.get(name), name)
    if not 0 < angle < math.pi:
        raise ConfigError(f"{name}: is {angle:g}; give the field of view in rad, below pi")
    return 0.5 * side / math.tan(0.5 * angle)


def metashape(root: Element) -> Camera:
    """The camera of a calibration that Metashape has exported (its manual, appendix on camera models).

    The principal point is given from the middle of the frame, p1 and p2 stand in the other order than OpenCV's, and a
    fisheye is the equidistant one with k1 to k4 as Kannala and Brandt have them.
    """
    values: dict[str, str] = {}
    for child in root:
        if child.tag in values:
            raise ConfigError(f"{child.tag}: given twice; keep one")
        values[str(child.tag)] = (child.text or "").strip()
    kind = values.get("projection", root.get("type", ""))
    if kind not in METASHAPE_MODELS:
        raise ConfigError(f"projection: {shown(kind)} is not supported; use {', '.join(METASHAPE_MODELS)}")
    if "fx" in values:
        raise ConfigError("fx: is of an old PhotoScan; export the calibration from Metashape again, with f")
    model = METASHAPE_MODELS[kind]
    if odd := next((key for key in values if key not in (*_METASHAPE_NUMBERS, "projection", "date")), None):
        raise ConfigError(f"{odd}: is not known of a calibration of Metashape; export it anew, or calibrate without it")
    parsed: dict[str, float] = {}
    for key in (name for name in _METASHAPE_NUMBERS if name in values):
        try:
            parsed[key] = float(values[key])
        except ValueError:
            raise ConfigError(f"{key}: is {shown(values[key])}; write a number") from None
    width, height, focal = listed(parsed, ("width", "height", "f"))
    frame = size(width, "width"), size(height, "height")
    get = {key: number(value, key) for key, value in parsed.items()}.get
    for key, side in (("cx", frame[0]), ("cy", frame[1])):
        if abs(get(key, 0.0)) > _FARTHEST_FROM_MIDDLE * side:
            raise ConfigError(
                f"{key}: is {get(key, 0.0):g}; Metashape counts it from the middle of the frame: export anew"
            )
    unread = ("b2", "p3", "p4", "k4") if model == "brown_conrady" else ("b2", "p1", "p2", "p3", "p4")
    if odd := next((key for key in unread if get(key, 0.0)), None):
        raise ConfigError(f"{odd}: is not zero, and no term of {model}; calibrate without it")
    names = ("k1", "k2", "p2", "p1", "k3") if model == "brown_conrady" else ("k1", "k2", "k3", "k4")
    distortion = [get(key, 0.0) for key in names]
    cx, cy = (0.5 * side + get(key, 0.0) - 0.5 for key, side in (("cx", frame[0]), ("cy", frame[1])))
    return Camera(*frame, matrix(focal + get("b1", 0.0), focal, cx, cy), distortion, model)

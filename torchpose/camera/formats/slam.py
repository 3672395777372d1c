"""Files of visual odometry and of its calibrations: Kalibr camchain, Basalt, ORB-SLAM, mrcal .cameramodel."""

import ast
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchpose.camera.formats.fields import listed, mapping, matrix, numbers, shown, size
from torchpose.camera.formats.models import MODELS, check_none, lens_model, named, refusal
from torchpose.camera.formats.native import extras
from torchpose.camera.model import Camera, Model
from torchpose.config import within
from torchpose.errors import ConfigError

BASALT_MODELS: dict[str, tuple[Model, tuple[str, ...]]] = {
    "pinhole": ("brown_conrady", ()),
    "pinhole-radtan8": ("brown_conrady", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
}
# parameters behind fx fy cx cy, in OpenCV's order
MRCAL_MODELS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
ORB_MODELS: dict[str, Model] = {
    "PinHole": "brown_conrady",
    "KannalaBrandt8": "kannala_brandt",
    "Rectified": "brown_conrady",
}
_ORB_CAMERA = re.compile(r"(Camera[12]?)\.fx")
_KALIBR_READ = {"distortion_coeffs", "tone", "adjustment"}
Readers = dict[str, Callable[[], Camera]]


def kalibr(data: Mapping[str, Any]) -> Readers:
    """The cameras of a camchain, by their names."""
    return {key: partial(_kalibr, key, data[key]) for key in data if re.fullmatch(r"cam\d+", key)}


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
            raise ConfigError(f"camera_model: is {shown(entry['camera_model'])}; calibrate with pinhole")
        if named(entry["distortion_model"]) not in MODELS.values():
            raise refusal("distortion_model", entry["distortion_model"])
        intrinsics = numbers(entry["intrinsics"], "intrinsics")
        if intrinsics.shape != (4,):
            raise ConfigError(f"intrinsics: has shape {tuple(intrinsics.shape)}; give [fx, fy, cx, cy]")
        distortion = numbers(entry["distortion_coeffs"], "distortion_coefficients").flatten()
        model = lens_model(entry, _KALIBR_READ)
        check_none(entry, _KALIBR_READ, distortion)
        covariance, tone, adjustment = extras(entry)
        return Camera(
            *_resolution(entry["resolution"]),
            matrix(*intrinsics.tolist()),
            distortion,
            model,
            covariance,
            tone=tone,
            adjustment=adjustment,
        )


def _resolution(value: Any, field: str = "resolution") -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2:
        raise ConfigError(f"{field}: is {shown(value)}; give [width, height]")
    return size(value[0], "image_width"), size(value[1], "image_height")


def basalt(data: Mapping[str, Any]) -> Readers:
    """The cameras of a Basalt calibration, by their place in it."""
    body = mapping(data.get("value0", data), "value0")
    for field in ("intrinsics", "resolution"):
        if not isinstance(body.get(field), list) or not body[field]:
            raise ConfigError(f"value0.{field}: is {shown(body.get(field))}; give a list with an entry for each camera")
    if len(body["intrinsics"]) != len(body["resolution"]):
        raise ConfigError("value0.resolution: has not one entry for each of value0.intrinsics; give as many")
    pairs = zip(body["intrinsics"], body["resolution"], strict=True)
    return {str(n): partial(_basalt, f"value0.intrinsics.{n}", *pair) for n, pair in enumerate(pairs)}


def _basalt(field: str, entry: Any, resolution: Any) -> Camera:
    entry = mapping(entry, field)
    kind = entry.get("camera_type")
    if not isinstance(kind, str) or kind not in BASALT_MODELS:
        raise ConfigError(f"{field}.camera_type: {shown(kind)} is not supported; use {', '.join(BASALT_MODELS)}")
    model, names = BASALT_MODELS[kind]
    values = mapping(entry.get("intrinsics"), f"{field}.intrinsics")
    numbers_ = listed(values, ("fx", "fy", "cx", "cy", *names), f"{field}.intrinsics.")
    width, height = _resolution(resolution, "value0.resolution")
    return _camera(width, height, numbers_, model)


def _camera(width: int, height: int, values: list[float], model: Model) -> Camera:
    """A camera of fx fy cx cy and the coefficients."""
    distortion = torch.tensor(values[4:], dtype=torch.float64)
    return Camera(width, height, matrix(*values[:4]), distortion, model)


def orb_slam(data: Mapping[str, Any]) -> Readers:
    """The cameras of a settings file of ORB-SLAM 2 or 3, by the names of their keys."""
    found = (_ORB_CAMERA.fullmatch(key) for key in data)
    return {match[1]: partial(_orb_slam, match[1], data) for match in found if match}


def is_orb_slam(data: Mapping[str, Any]) -> bool:
    """Whether keys stand as ORB-SLAM writes them."""
    return any(_ORB_CAMERA.fullmatch(key) for key in data)


def _orb_slam(name: str, data: Mapping[str, Any]) -> Camera:
    if doubled := next((key for key in data if re.match(r"(LEFT|RIGHT)\.", key)), None):
        raise ConfigError(f"{doubled}: {name} is of rectified frames here; write a file of the frames that you have")
    kind = data.get("Camera.type", "PinHole")
    if not isinstance(kind, str) or kind not in ORB_MODELS:
        raise ConfigError(f"Camera.type: {shown(kind)} is not supported; use {', '.join(ORB_MODELS)}")
    model = ORB_MODELS[kind]
    frame = [size(data.get(f"Camera.{side}"), f"Camera.{side}") for side in ("width", "height")]
    own = {key.removeprefix(f"{name}."): value for key, value in data.items() if key.startswith(f"{name}.")}
    names = ("k1", "k2", "k3", "k4") if model == "kannala_brandt" else ("k1", "k2", "p1", "p2", "k3")
    if odd := next((key for key in own if re.fullmatch(r"[kps]\d", key) and key not in names), None):
        raise ConfigError(f"{name}.{odd}: is no coefficient of {kind}; it has {' '.join(names)}")
    if model == "brown_conrady":  # those that are not there are zero
        own = dict.fromkeys(names, 0.0) | own
    values = listed(own, ("fx", "fy", "cx", "cy", *names), f"{name}.")
    if kind == "Rectified" and any(values[4:]):
        raise ConfigError("Camera.type: is 'Rectified', and the coefficients are not zero; write the type of the lens")
    return _camera(frame[0], frame[1], values, model)


def is_mrcal(text: str) -> bool:
    """Whether a text is a .cameramodel: the literal of a Python dictionary with a lens model."""
    return text.lstrip().startswith(("{", "#")) and re.search(r"""['"]lensmodel['"]\s*:""", text) is not None


def mrcal(text: str) -> Camera:
    """The camera of a .cameramodel of mrcal."""
    try:
        data = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        raise ConfigError("file: is no .cameramodel; write the dictionary of mrcal") from None
    data = mapping(data, "file")
    kind = data.get("lensmodel")
    if not isinstance(kind, str) or kind not in MRCAL_MODELS:
        raise ConfigError(f"lensmodel: {shown(kind)} is not supported; use {', '.join(MRCAL_MODELS)}")
    intrinsics = _flat(data, "intrinsics")
    wanted = 4 + MRCAL_MODELS[kind]
    if len(intrinsics) != wanted:
        raise ConfigError(f"intrinsics: {len(intrinsics)} numbers; {kind} has {wanted}")
    frame = data.get("imagersize")
    width, height = _resolution(list(frame) if isinstance(frame, tuple) else frame, "imagersize")
    return _camera(width, height, intrinsics.tolist(), "brown_conrady")


def _flat(data: Mapping[str, Any], field: str) -> Tensor:
    value = data.get(field)
    return numbers(list(value) if isinstance(value, tuple) else value, field).flatten()

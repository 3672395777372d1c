"""JSON of depth cameras and data sets: RealSense intrinsics, Open3D's PinholeCameraIntrinsic, BOP camera.json."""

from collections.abc import Mapping
from typing import Any

import torch

from torchpose.camera.formats.fields import listed, mapping, matrix, numbers, shown, size
from torchpose.camera.formats.models import lens_model
from torchpose.camera.model import Camera, Model
from torchpose.errors import ConfigError

# librealsense's rs2_distortion. The modified and the inverse Brown-Conrady are other functions than OpenCV's, f-theta
# is another lens: they are read where all coefficients are zero, as those of D400 are
REALSENSE_MODELS: dict[str, Model | None] = {
    "none": None,
    "brown_conrady": "brown_conrady",
    "modified_brown_conrady": None,
    "inverse_brown_conrady": None,
    "ftheta": None,
    "kannala_brandt4": "kannala_brandt",
}


def is_realsense(data: Mapping[str, Any]) -> bool:
    """Whether a mapping has the names of librealsense's rs2_intrinsics."""
    return "ppx" in data and "ppy" in data


def realsense(data: Mapping[str, Any]) -> Camera:
    """The camera of an rs2_intrinsics."""
    for field in ("model", "coeffs"):
        if field not in data:
            raise ConfigError(f"{field}: is missing; add it")
    name = str(data["model"]) if isinstance(data["model"], str) else ""
    # `distortion.brown_conrady`, `RS2_DISTORTION_BROWN_CONRADY` and `Brown Conrady` are one
    key = name.lower().replace(" ", "_").removeprefix("rs2_").removeprefix("distortion.").removeprefix("distortion_")
    if key not in REALSENSE_MODELS:
        raise ConfigError(f"model: {shown(data['model'])} is not supported; use {', '.join(REALSENSE_MODELS)}")
    distortion = numbers(data["coeffs"], "coeffs").flatten()
    if len(distortion) > 5:
        raise ConfigError(f"coeffs: {len(distortion)} numbers; librealsense has 5")
    model = REALSENSE_MODELS[key]
    if model is None:
        if bool((distortion != 0).any()):
            raise ConfigError(
                f"model: {shown(name)} with coefficients other than 0 is not supported; use brown_conrady"
            )
        distortion, model = distortion[:0], "brown_conrady"
    elif model == "kannala_brandt" and len(distortion) == 5:
        distortion = distortion[:4]  # the fifth has no meaning
    lens_model(data, {"model", "coeffs"}, implied=model)
    fx, fy, cx, cy = listed(data, ("fx", "fy", "ppx", "ppy"))
    return Camera(
        size(data.get("width"), "width"), size(data.get("height"), "height"), matrix(fx, fy, cx, cy), distortion, model
    )


def is_open3d(data: Mapping[str, Any]) -> bool:
    """Whether a mapping is a PinholeCameraIntrinsic or -Parameters of Open3D."""
    inner = data.get("intrinsic")
    return "intrinsic_matrix" in data or (isinstance(inner, Mapping) and "intrinsic_matrix" in inner)


def open3d(data: Mapping[str, Any]) -> Camera:
    """The camera of Open3D's JSON: nine numbers column by column, a lens without distortion."""
    entry = data if "intrinsic_matrix" in data else mapping(data["intrinsic"], "intrinsic")
    lens_model(data, {"intrinsic_matrix"}, implied="brown_conrady")
    _refuse_distortion(data, entry)
    table = numbers(entry["intrinsic_matrix"], "intrinsic_matrix")
    if table.shape != (9,):
        raise ConfigError(
            f"intrinsic_matrix: has shape {tuple(table.shape)}; Open3D writes 9 numbers, column by column"
        )
    table = table.reshape(3, 3).T
    if table[2].tolist() != [0, 0, 1]:
        raise ConfigError("intrinsic_matrix: does not end in 0, 0, 1 of its last row; write it column by column")
    return Camera(size(entry.get("width"), "width"), size(entry.get("height"), "height"), table, torch.zeros(0))


def is_bop(data: Mapping[str, Any]) -> bool:
    """Whether a mapping is a camera.json of the BOP data sets."""
    return "depth_scale" in data and all(key in data for key in ("fx", "fy", "cx", "cy"))


def bop(data: Mapping[str, Any]) -> Camera:
    """The camera of a camera.json of BOP, whose frames are without distortion."""
    lens_model(data, (), implied="brown_conrady")
    _refuse_distortion(data)
    values = listed(data, ("fx", "fy", "cx", "cy"))
    return Camera(size(data.get("width"), "width"), size(data.get("height"), "height"), matrix(*values), torch.zeros(0))


def _refuse_distortion(*entries: Mapping[str, Any]) -> None:
    """A format of undistorted frames that has coefficients all the same is not what it seems."""
    names = {"k1", "k2", "k3", "p1", "p2", "coeffs", "dist_coeffs", "distortion", "d", "D", "dist"}
    for entry in entries:
        if odd := next((key for key in entry if key in names and entry[key] not in (None, 0, 0.0, [])), None):
            raise ConfigError(
                f"{odd}: stands in a format without distortion; write camera_matrix and distortion_coefficients"
            )

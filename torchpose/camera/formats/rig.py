"""Files of several cameras: Kalibr camchain, OpenCV stereo calibration, ROS camera_info with a table of transforms.

Transforms are in metres in Kalibr's and ROS's files and in mm in ours.
"""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpose.camera.formats import native, slam, warn_without_ray
from torchpose.camera.formats.fields import mapping, numbers, shown
from torchpose.camera.formats.write import covariances, focal_center, row
from torchpose.camera.model import Camera
from torchpose.camera.plausible import check_intrinsics
from torchpose.camera.rig import POSE, CameraRig, nearest_rotation, rotation_fault
from torchpose.config import format_list, parse_mapping, quoted, read_text, within, write_text
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

_MM = {"mm": 1.0, "m": 1000.0}
_COVARIANCE = "extrinsics_covariance"
_TABLES = ("tf.yaml", "tf_static.yaml", "tf.yml", "tf_static.yml")  # names of the table of transforms
_YAML = (".yaml", ".yml")


def load(path: str | os.PathLike[str]) -> CameraRig:
    """The rig in a Kalibr camchain, a stereo calibration of OpenCV, or a folder of ROS camera_info with a TF table.

    Warns:
        CameraWarning: no ray of a lens model reaches part of its frame.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
    """
    place = Path(path)
    rig = _ros_folder(place) if place.is_dir() else _one_file(place)
    for name, camera in zip(rig.names, rig.cameras, strict=True):
        field = f"{os.fspath(path)}: {name}."
        with within(field):
            check_intrinsics(camera.matrix, camera.width, camera.height, camera.model)
        warn_without_ray(camera, f"{field}distortion_coefficients")
    return rig


def _one_file(path: Path) -> CameraRig:
    text = read_text(path)
    with within(f"{path}: "):
        data = parse_mapping(text)
        if cameras := slam.kalibr(data):
            return _kalibr(data, cameras)
        if any(key in data for key in ("R", "T", "M1", "cameraMatrix1")):
            return _stereo(data, text)
        raise ConfigError(
            "cam0: is missing; give a Kalibr camchain (cam0, cam1, ... with T_cn_cnm1), OpenCV's stereo calibration "
            "(M1, D1, M2, D2, R, T), or a folder of ROS camera_info files with tf_static.yaml"
        )


def _kalibr(data: Mapping[str, Any], readers: Mapping[str, Callable[[], Camera]]) -> CameraRig:
    keys = sorted(readers, key=lambda key: int(key.removeprefix("cam")))
    if keys != [f"cam{n}" for n in range(len(keys))]:
        raise ConfigError(f"{keys[-1]}: stands beside {', '.join(keys[:-1])}; number the cameras cam0, cam1, ...")
    cameras = [readers[key]() for key in keys]
    names = [str(mapping(data[key], key).get("name", key)) for key in keys]
    R, t = [torch.eye(3, dtype=torch.float64)], [torch.zeros(3, dtype=torch.float64)]
    for key in keys[1:]:
        if "T_cn_cnm1" not in data[key]:
            raise ConfigError(f"{key}.T_cn_cnm1: is missing; give the 4 x 4 transform from the camera before, in m")
        turn, shift = _transform(data[key]["T_cn_cnm1"], f"{key}.T_cn_cnm1")
        turn, shift = rotations.compose(turn, 1000 * shift, R[-1], t[-1])
        R.append(turn)
        t.append(shift)
    return CameraRig(cameras, torch.stack(R), torch.stack(t), _covariance(data, keys), names)


def _covariance(data: Mapping[str, Any], keys: list[str]) -> Tensor | None:
    """That of all places, of which each camera has its rows up to its own: 6 of 6, 12, 18, ... numbers."""
    stated = [key for key in keys[1:] if _COVARIANCE in data[key]]
    if not stated:
        return None
    if missing := [key for key in keys[1:] if key not in stated]:
        raise ConfigError(f"{missing[0]}.{_COVARIANCE}: is missing, and {stated[0]} has one; give it for all, or none")
    size = POSE * (len(keys) - 1)
    whole = torch.zeros(size, size, dtype=torch.float64)
    for number, key in enumerate(keys[1:]):
        field, columns = f"{key}.{_COVARIANCE}", POSE * (number + 1)
        rows = numbers(data[key][_COVARIANCE], field)
        if rows.shape != (POSE, columns):
            raise ConfigError(
                f"{field}: has shape {tuple(rows.shape)}; give 6 x {columns}: of translation (mm), then rotation "
                "(rad), with the cameras cam1 up to this one"
            )
        part = slice(columns - POSE, columns)
        whole[part, :columns] = rows
        whole[:columns, part] = rows.mT
    return whole


def _transform(value: Any, field: str) -> tuple[Tensor, Tensor]:
    """Rotation and translation of a rigid transform of 4 x 4 (or 3 x 4) numbers."""
    table = numbers(value, field)
    if table.shape not in ((4, 4), (3, 4)):
        raise ConfigError(f"{field}: has shape {tuple(table.shape)}; give 4 rows of 4")
    if len(table) == 4 and table[3].tolist() != [0, 0, 0, 1]:
        raise ConfigError(f"{field}: has the last row {table[3].tolist()}; write [0, 0, 0, 1]")
    return _rotation(table[:3, :3], field), table[:3, 3]


def _rotation(table: Tensor, field: str) -> Tensor:
    if fault := rotation_fault(table):
        raise ConfigError(f"{field}: {fault}")
    return nearest_rotation(table)


def save(rig: CameraRig, path: str | os.PathLike[str]) -> None:
    """Writes a Kalibr camchain: ``T_cn_cnm1`` in metres, and what Kalibr does not know in keys of the cameras.

    A lens that is more than Kalibr's four coefficients has ROS's name of its model, which Kalibr refuses to read.
    ``extrinsics_covariance`` is in mm and rad, of the places as seen from the first camera.

    Raises:
        ConfigError: the folder is not there or cannot be written.
    """
    factor = rig.covariance
    text = "# transforms in m; extrinsics_covariance in mm and rad, of X_n = R X_0 + t\n"
    for number, camera in enumerate(rig.cameras):
        text += _kalibr_entry(camera, number)
        if rig.names[number] != f"cam{number}":
            text += f"  name: {quoted(rig.names[number])}\n"
        if number:
            before = rotations.inverse(rig.R[number - 1], rig.t[number - 1])
            turn, shift = rotations.compose(rig.R[number], rig.t[number], *before)
            table = torch.cat([turn, shift[:, None] / 1000], 1).tolist()
            text += "  T_cn_cnm1:\n" + "".join(f"    - {format_list(r)}\n" for r in [*table, [0.0, 0.0, 0.0, 1.0]])
            if factor is not None:
                rows = factor[POSE * (number - 1) : POSE * number, : POSE * number]
                text += f"  {_COVARIANCE}:\n" + "".join(f"    - {row(r)}\n" for r in rows)
    write_text(path, text)


def _kalibr_entry(camera: Camera, number: int) -> str:
    d = camera.distortion.detach()
    model = {0: "none", 4: "radtan", 5: "plumb_bob", 8: "rational_polynomial"}[len(d)]
    small = camera.covariance is None or len(camera.covariance) == 4
    if camera.model == "kannala_brandt":
        model = "equidistant"
    elif small and len(d) > 4 and not bool(d[4:].any()):
        model, d = "radtan", d[:4]
    text = (
        f"cam{number}:\n  camera_model: pinhole\n  intrinsics: {format_list(focal_center(camera))}\n"
        f"  distortion_model: {model}\n  distortion_coeffs: {row(d)}\n  resolution: [{camera.width}, {camera.height}]\n"
        f"  rostopic: /cam{number}/image_raw\n"
    )
    for name, table in covariances(camera).items():
        text += f"  {name}:\n" + "".join(f"    - {row(line)}\n" for line in table)
    if camera.adjustment is not None:
        text += f"  adjustment: {camera.adjustment}\n"
    return text if camera.tone is None else text + f'  tone: "{camera.tone}"\n'


def _stereo(data: Mapping[str, Any], text: str) -> CameraRig:
    """`stereoCalibrate`'s result: X_2 = R X_1 + T. Its unit is that of the board, which no such file says."""
    spellings = {
        "M{}": ("M{}", "K{}", "cameraMatrix{}", "camera_matrix_{}"),
        "D{}": ("D{}", "distCoeffs{}", "dist_coeffs_{}"),
    }

    def field(pattern: str, number: int) -> Any:
        names = [name.format(number) for name in spellings[pattern]]
        found = next((name for name in names if name in data), None)
        if found is None:
            raise ConfigError(f"{names[0]}: is missing; write the intrinsics (M1, D1, M2, D2) beside R and T")
        return data[found]

    for name in ("R", "T"):
        if name not in data:
            raise ConfigError(f"{name}: is missing; write R and T of stereoCalibrate")
    units = data.get("units")
    if not isinstance(units, str) or units not in _MM:
        raise ConfigError(f"units: {'missing' if units is None else shown(units)}; write the unit of T, mm or m")
    turn, shift = numbers(data["R"], "R"), numbers(data["T"], "T").flatten()
    if turn.shape != (3, 3) or len(shift) != 3:
        raise ConfigError(f"R: with T has shapes {tuple(turn.shape)} and {len(shift)}; give 3 x 3 and 3")
    turn = _rotation(turn, "R")
    cameras = []
    names = [name.format(number) for several in spellings.values() for name in several for number in (1, 2)]
    rest = {key: value for key, value in data.items() if key not in (*names, "R", "T", "units")}
    for number in (1, 2):
        own = {
            **rest,  # one of them may name the lens
            **{name: _size(data, name, number) for name in ("image_width", "image_height")},
            "camera_matrix": field("M{}", number),
            "distortion_coefficients": field("D{}", number),
        }
        with within(f"camera {number}: "):
            cameras.append(native.read(own, text))
    t = torch.stack([torch.zeros_like(shift), _MM[units] * shift])
    return CameraRig(cameras, torch.stack([torch.eye(3, dtype=turn.dtype), turn]), t)


def _size(data: Mapping[str, Any], name: str, number: int) -> Any:
    """Width or height of the frames, of each camera or of both."""
    pair = next((data[key] for key in ("image_size", "imageSize") if key in data), None)
    if isinstance(pair, list) and len(pair) == 2:
        return pair[name == "image_height"]
    value = data.get(f"{name}_{number}", data.get(name))
    if value is None:
        raise ConfigError(f"{name}: is missing; add it")
    return value


def _ros_folder(folder: Path) -> CameraRig:
    """camera_info files and a table of transforms, as `ros2 topic echo` writes both."""
    table = next((folder / name for name in _TABLES if (folder / name).is_file()), None)
    if table is None:
        raise ConfigError(f"{folder}: tf_static.yaml: is missing; write the transforms between the camera frames there")
    files = sorted(p for p in folder.iterdir() if p.suffix in _YAML and p.name not in _TABLES)
    if not files:
        raise ConfigError(f"{folder}: file: holds no camera_info; give one .yaml file a camera")
    with within(f"{table}: "):
        edges = _edges(read_text(table))
    cameras: list[Camera] = []
    places: list[str] = []
    for file in files:
        text = read_text(file)
        with within(f"{file}: "):
            data = parse_mapping(text)
            cameras.append(native.read(data, text))
            header = data.get("header")
            frame = header.get("frame_id") if isinstance(header, Mapping) else data.get("camera_name")
            known = {name for edge in edges for name in edge[:2]}
            frame = next((name for name in (f"{frame}_optical_frame", str(frame)) if name in known), None)
            if frame is None:
                raise ConfigError(
                    f"header.frame_id: is in no transform of {table.name}, nor is camera_name; known are "
                    f"{', '.join(sorted(known))}"
                )
            if frame in places:
                other = files[places.index(frame)].name
                raise ConfigError(f"header.frame_id: is {shown(frame)}, as in {other}; give every camera its own frame")
            places.append(frame)
    with within(f"{table}: "):
        from_first = [_between(edges, places[0], frame) for frame in places]
    R, t = (torch.stack(parts) for parts in zip(*from_first, strict=True))
    R[0], t[0] = torch.eye(3, dtype=R.dtype), 0
    return CameraRig(cameras, R, t, names=[file.stem for file in files])


Edge = tuple[str, str, Tensor, Tensor]
"""Two frames and the transform of a point from the second (the child) to the first: X_parent = R X_child + t, mm."""


def _edges(text: str) -> list[Edge]:
    """The transforms of all messages in a text, as `ros2 topic echo` divides them; one for each child."""
    edges: dict[str, Edge] = {}
    for part in re.split(r"^---[ \t]*$", text, flags=re.MULTILINE):
        if not part.strip():
            continue
        entries = parse_mapping(part).get("transforms")
        if not isinstance(entries, list) or not entries:
            raise ConfigError("transforms: is missing; give the list that `ros2 topic echo /tf_static` prints")
        for number, entry in enumerate(entries):
            edge = _edge(entry, f"transforms[{number}]")
            before = edges.setdefault(edge[1], edge)
            if before[0] != edge[0] or not (torch.equal(before[2], edge[2]) and torch.equal(before[3], edge[3])):
                raise ConfigError(f"transforms: {edge[1]} stands in two that differ; keep one, a frame has one parent")
    for child in edges:
        above, parent = {child}, edges[child][0]
        while parent in edges and parent not in above:
            above.add(parent)
            parent = edges[parent][0]
        if parent in above:
            raise ConfigError(f"transforms: those above {child} lead back to {parent}; a tree has no loop")
    if not edges:
        raise ConfigError("transforms: is missing; give the list that `ros2 topic echo /tf_static` prints")
    return list(edges.values())


def _edge(entry: Any, field: str) -> Edge:
    entry = mapping(entry, field)
    parent = mapping(entry.get("header"), f"{field}.header").get("frame_id")
    child, moved = entry.get("child_frame_id"), mapping(entry.get("transform"), f"{field}.transform")
    if not isinstance(parent, str) or not isinstance(child, str):
        raise ConfigError(f"{field}.child_frame_id: is {shown(child)} in {shown(parent)}; name both frames")
    shift, turn = (
        numbers([mapping(moved.get(name), f"{field}.{name}").get(axis) for axis in axes], f"{field}.{name}")
        for name, axes in (("translation", "xyz"), ("rotation", "xyzw"))
    )
    length = float(turn.norm())
    if abs(length - 1) > 1e-3:
        raise ConfigError(f"{field}.rotation: is a quaternion of length {length:.3g}; give x, y, z, w of length 1")
    x, y, z, w = (turn / length).tolist()
    vector = torch.tensor([x, y, z], dtype=torch.float64)
    across = rotations.skew(vector)
    rotation = torch.eye(3, dtype=torch.float64) + 2 * w * across + 2 * across @ across
    return parent, child, rotation, 1000 * shift


def _between(edges: list[Edge], first: str, last: str) -> tuple[Tensor, Tensor]:
    """The transform of a point from one frame to another, through any frames between them."""
    known = {first: (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))}
    while last not in known:
        before = len(known)
        for parent, child, turn, shift in edges:
            if parent in known and child not in known:
                known[child] = rotations.compose(*rotations.inverse(turn, shift), *known[parent])
            elif child in known and parent not in known:
                known[parent] = rotations.compose(turn, shift, *known[child])
        if len(known) == before:
            raise ConfigError(f"transforms: none leads from {first} to {last}; add those between them")
    return known[last]

"""Capture manifests: which images a rig took, in which order, and where the robot stood.

A manifest is a file of JSON lines (``.jsonl``), appended to while capturing:

- ``{"record": "session", "units": {"length": "mm"}, ...}`` first. ``units.length`` is ``mm`` or ``m`` (UR controllers
  report metres) and is required as soon as a frame has a robot pose.
- ``{"record": "frame", "id": 7, "image": "images/0007.png", "robot_pose": [x, y, z, rx, ry, rz], ...}`` one a frame.
  ``image`` is relative to the manifest's folder, with forward slashes; null where the camera delivered none.
  ``camera`` (optional) is the name of the camera, where there are several.
  ``robot_pose`` (optional) is the tool in the robot base: position in the session's unit, rotation vector in rad.
- ``{"record": "end", ...}`` last. Its absence means that the capture was cut short.

Other keys and other records are ignored. A last line without its newline is one that was being written when the rig
stopped; it is dropped unless it is whole. Image and robot pose are joined by their record, never by position.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchpose.errors import ConfigError

_MILLIMETRES = {"mm": 1.0, "m": 1000.0}


@dataclass(frozen=True)
class ManifestFrame:
    """One image of a manifest: path relative to its folder, and the tool in the robot base (mm, rad) if recorded."""

    image: str
    robot_pose: tuple[float, ...] | None


def read_manifest(path: Path, camera: str | None = None) -> list[ManifestFrame]:
    """Frames of a capture manifest in the order of capture.

    Args:
        camera: only frames of the camera of this name; required where there are several, which have little in common.

    Raises:
        ConfigError: the file cannot be read, a line is not a JSON object, a field is missing or wrong, an id or an
            image occurs twice, or it has frames of several cameras or none of the named one.
    """
    frames: list[ManifestFrame] = []
    cameras: list[str] = []
    ids: set[Any] = set()
    images: set[str] = set()
    millimetres: float | None = None
    for number, record in read_records(path):
        where = f"{path}: line {number}"
        if record.get("record") == "session":
            millimetres = _unit(record, where)
        if record.get("record") != "frame" or ("image" in record and record["image"] is None):
            continue
        identifier, image = record.get("id"), record.get("image")
        if not isinstance(identifier, int | str):
            raise ConfigError(f"{where}: id: missing or not a number or a text; give every frame its own")
        if not isinstance(image, str) or not image:
            raise ConfigError(f"{where}: image: missing or not a text; give the image's path relative to the manifest")
        if identifier in ids:
            raise ConfigError(f"{where}: id: {identifier!r} occurs twice; give every frame its own")
        if image in images:
            raise ConfigError(f"{where}: image: {image!r} occurs twice; one record for every image")
        ids.add(identifier)
        images.add(image)
        cameras.append(str(record.get("camera", "")))
        frames.append(ManifestFrame(image, _robot_pose(record.get("robot_pose"), millimetres, where)))
    known = sorted(set(cameras))
    if camera is None and len(known) > 1:
        raise ConfigError(f"{path}: INPUT: has frames of {len(known)} cameras; pick one: {path.name}#{known[0]}")
    if camera is not None and camera not in known:
        raise ConfigError(f"{path}: INPUT: has no frame of camera {camera!r}; known are {', '.join(known)}")
    return [frame for frame, name in zip(frames, cameras, strict=True) if camera in (None, name)]


def read_records(path: Path) -> list[tuple[int, dict[str, Any]]]:
    """Line numbers and objects of a file of JSON lines, without a torn last line.

    Raises:
        ConfigError: the file cannot be read, or a line is not a JSON object.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise ConfigError(f"{path}: INPUT: {error.strerror}; give a readable capture manifest") from None
    records = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            record = json.loads(line)
        except ValueError:
            if number == len(lines):  # no newline behind it: it was being written
                break
            raise ConfigError(f"{path}: line {number}: not JSON; a manifest has one JSON object a line") from None
        if not isinstance(record, dict):
            raise ConfigError(f"{path}: line {number}: not an object; a manifest has one JSON object a line")
        records.append((number, record))
    return records


def _unit(session: dict[str, Any], where: str) -> float | None:
    """Millimetres per length unit of a session record, None where it names none."""
    units = session.get("units")
    if units is None:
        return None
    length = units.get("length") if isinstance(units, dict) else None
    if not isinstance(length, str) or length not in _MILLIMETRES:
        raise ConfigError(f'{where}: units: {units!r} is not known; write {{"length": "mm"}} or {{"length": "m"}}')
    return _MILLIMETRES[length]


def _robot_pose(value: Any, millimetres: float | None, where: str) -> tuple[float, ...] | None:
    """The pose in mm and rad, or None where the record has none."""
    if value is None:
        return None
    numbers = value if isinstance(value, list) else []
    finite = all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in numbers)
    if len(numbers) != 6 or not finite:
        raise ConfigError(f"{where}: robot_pose: {value!r}; give six finite numbers x, y, z, rx, ry, rz")
    if millimetres is None:
        raise ConfigError(
            f'{where}: robot_pose: in unknown units; write "units": {{"length": "mm"}} (or "m") in the session record'
        )
    return (*(float(v) * millimetres for v in numbers[:3]), *(float(v) for v in numbers[3:]))

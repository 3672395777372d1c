"""Capture manifests: which images a rig took, in which order, and where the robot stood.

A manifest is a file of JSON lines (``.jsonl``), appended to while capturing:

- ``{"record": "session", "units": {"length": "mm"}, ...}`` first. ``units.length`` is ``mm`` or ``m`` (UR controllers
  report metres) and is required as soon as a frame has a robot pose.
- ``{"record": "frame", "id": 7, "image": "images/0007.png", "robot_pose": [x, y, z, rx, ry, rz], ...}`` one a frame.
  ``image`` is relative to the manifest's folder, with forward slashes; null where the camera delivered none.
  ``camera`` (optional) is the name of the camera, where there are several.
  ``trigger_time_s`` (optional) is when it was taken, by the clock of the machine that triggers.
  ``robot_pose`` (optional) is the tool in the robot base: position in the session's unit, rotation vector in rad.
- ``{"record": "end", ...}`` last. Its absence means that the capture was cut short.

Other keys and other records are ignored. A last line without its newline is one that was being written when the rig
stopped; it is dropped unless it is whole. Image and robot pose are joined by their record, never by position.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError

from torchpose.config import check_regular, parse_json, shown
from torchpose.config.kinds import Length, Number, Radians, Text, Word, check_turn
from torchpose.errors import ConfigError

_LONGEST_LINE = 1 << 20  # bytes (convention): a record has one or two thousand


class _Record(BaseModel):
    model_config = ConfigDict(strict=True)


RecordT = TypeVar("RecordT", bound=_Record)


class _Units(_Record):
    length: Literal["mm", "m"]


class _Session(_Record):
    units: _Units | None = None


class ManifestFrame(_Record):
    """One image of a manifest: path relative to its folder, and the tool in the robot base (mm, rad) if recorded."""

    id: int | Text
    image: Word
    camera: Annotated[Text, BeforeValidator(lambda name: str(name) if isinstance(name, int) else name)] = ""
    trigger_time_s: Number | None = None
    robot_pose: (
        Annotated[
            tuple[Length, Length, Length, Radians, Radians, Radians],
            BeforeValidator(lambda numbers: tuple(numbers) if isinstance(numbers, list) else numbers),
            AfterValidator(lambda numbers: (*numbers[:3], *check_turn(numbers[3:]))),
        ]
        | None
    ) = None


_WRONG = {
    "units": '{} is not known; write {{"length": "mm"}} or {{"length": "m"}}',
    "id": "missing or not a number or a text of one line; give every frame its own",
    "image": "missing or not a text of one line; give the image's path relative to the manifest",
    "camera": "{} is not a text of one line; give the camera's name",
    "trigger_time_s": "{} is no time; give seconds, or leave it out",
    "robot_pose": "{}; give six finite numbers: x, y, z, and a rotation vector rx, ry, rz in rad, no angles in degrees",
}


def read_manifest_cameras(path: Path) -> list[str]:
    """Names of the cameras that have frames with an image.

    Raises:
        ConfigError: the file cannot be read, or a line is not a JSON object.
    """
    found: set[str] = set()
    for number, record in read_records(path):
        if record.get("record") == "frame" and record.get("image", "") is not None:
            found.add(_checked(ManifestFrame, record, f"{path}: line {number}").camera)
    return sorted(found)


def read_manifest(path: Path, camera: str | None = None) -> list[ManifestFrame]:
    """Frames of a capture manifest in the order of capture, robot poses in mm and rad.

    Args:
        path: the manifest.
        camera: only frames of the camera of this name; required where there are several, which have little in common.

    Raises:
        ConfigError: the file cannot be read, a line is not a JSON object, a field is missing or wrong, an id or an
            image occurs twice, or it has frames of several cameras or none of the named one.
    """
    frames: list[ManifestFrame] = []
    ids: set[int | str] = set()
    images: set[str] = set()
    units: _Units | None = None
    for number, record in read_records(path):
        where = f"{path}: line {number}"
        if record.get("record") == "session":
            units = _checked(_Session, record, where).units
        if record.get("record") != "frame" or ("image" in record and record["image"] is None):
            continue
        frame = _checked(ManifestFrame, record, where)
        if frame.id in ids:
            raise ConfigError(f"{where}: id: {shown(frame.id)} occurs twice; give every frame its own")
        if frame.image in images:
            raise ConfigError(f"{where}: image: {shown(frame.image)} occurs twice; one record for every image")
        ids.add(frame.id)
        images.add(frame.image)
        if frame.robot_pose is not None:
            if units is None:
                fix = 'write "units": {"length": "mm"} (or "m") in the session record'
                raise ConfigError(f"{where}: robot_pose: in unknown units; {fix}")
            scale = {"mm": 1.0, "m": 1000.0}[units.length]
            pose = (*(scale * value for value in frame.robot_pose[:3]), *frame.robot_pose[3:])
            frame = frame.model_copy(update={"robot_pose": pose})
        frames.append(frame)
    known = sorted({frame.camera for frame in frames})
    if camera is None and len(known) > 1:
        raise ConfigError(f"{path}: INPUT: has frames of {len(known)} cameras; pick one: {path.name}#{known[0]}")
    if camera is not None and camera not in known:
        raise ConfigError(f"{path}: INPUT: has no frame of camera {camera!r}; known are {', '.join(known)}")
    return [frame for frame in frames if camera in (None, frame.camera)]


def read_records(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Line numbers and objects of a file of JSON lines, without a torn last line.

    Raises:
        ConfigError: the file cannot be read, or a line is not a JSON object.
    """
    try:
        check_regular(path)
        with path.open("rb") as lines:
            number = 0
            while line := lines.readline(_LONGEST_LINE + 1):
                number += 1
                record = _record(line, f"{path}: line {number}")
                if record is not None:
                    yield number, record
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{path}: INPUT: {reason}; give a readable capture manifest") from None


def _record(line: bytes, where: str) -> dict[str, Any] | None:
    """The object of a line; None for one that is blank, or that has no end: it was being written."""
    if not line.strip():
        return None
    if len(line) > _LONGEST_LINE:
        raise ConfigError(f"{where}: has more than {_LONGEST_LINE} bytes; a manifest has one JSON object a line")
    try:
        record = parse_json(line)
    except ValueError as error:
        if not line.endswith(b"\n"):
            return None
        syntax = isinstance(error, json.JSONDecodeError | UnicodeDecodeError)
        problem = "not JSON; a manifest has one JSON object a line" if syntax else str(error).removeprefix("file: ")
        raise ConfigError(f"{where}: {problem}") from None
    if not isinstance(record, dict):
        raise ConfigError(f"{where}: not an object; a manifest has one JSON object a line")
    return record


def _checked(model: type[RecordT], record: dict[str, Any], where: str) -> RecordT:
    """A record as an instance of its model."""
    try:
        return model.model_validate(record)
    except ValidationError as caught:
        field = str(caught.errors()[0]["loc"][0])
        raise ConfigError(f"{where}: {field}: {_WRONG[field].format(shown(record.get(field)))}") from None

"""Camera files of many programs, each with its own conventions (docs/cameras.md).

The format of a file is recognised by its content. A file whose lens model is not certain is refused, with the list of
what is read (`camera.formats.models`).
"""

import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from torchpose.camera.formats import native, reconstruction, sensors, slam, xml
from torchpose.camera.formats.models import MODELS
from torchpose.camera.formats.native import COVARIANCES, FIELDS
from torchpose.camera.formats.reconstruction import COLMAP_MODELS
from torchpose.camera.formats.write import save
from torchpose.camera.model import Camera
from torchpose.camera.plausible import check_intrinsics, share_without_ray
from torchpose.config import parse_mapping, read_text, within
from torchpose.errors import ConfigError

__all__ = ["COLMAP_MODELS", "COVARIANCES", "FIELDS", "MODELS", "CameraWarning", "load", "save"]
_COLMAP_LINE = re.compile(r"\d+\s+[A-Z][A-Z_0-9]*(\s|$)")
_SHOWN = 300  # characters of a message at either end; none of ours is longer than both
_INI_SECTION = re.compile(r"\[[^\[\],]+\]\s*")


class CameraWarning(UserWarning):
    """A camera file can be read, and part of its frames cannot be used."""


def load(path: str | os.PathLike[str]) -> Camera:
    """The camera in a file; ``FILE#cam1`` (Kalibr), ``FILE#2`` (COLMAP's CAMERA_ID) and so on picks one of several.

    Warns:
        CameraWarning: no ray of the lens model reaches part of the frame.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
    """
    name, selector = os.fspath(path), None
    if "#" in name and not os.path.isfile(name):
        name, selector = name.rsplit("#", 1)
    text = read_text(name)
    with within(f"{name}: "), _one_line():
        read = _pick(_readers(text), selector)
        camera = read()
        check_intrinsics(camera.matrix, camera.width, camera.height, camera.model)
    warn_without_ray(camera, f"{name}: distortion_coefficients")
    return camera


def warn_without_ray(camera: Camera, field: str) -> None:
    """Warns where no ray of the lens model reaches part of the frame; ``field`` begins the message."""
    if percent := 100 * share_without_ray(camera):
        part = f"{percent:.0f}" if percent >= 10 else f"{percent:.2g}"
        warnings.warn(
            f"{field}: no ray reaches {part} % of the frame, beyond the fold or a pole of the lens model; markers there"
            " are not measured: calibrate with views out to the corners, or with fewer coefficients",
            CameraWarning,
            stacklevel=3,
        )


@contextmanager
def _one_line() -> Iterator[None]:
    """Keys of a file stand in messages: of those that are long, or have line breaks, a short line is made."""
    try:
        yield
    except ConfigError as error:
        text = " ".join(str(error).split())
        if len(text) > 2 * _SHOWN:
            text = f"{text[:_SHOWN]} ... {text[-_SHOWN:]}"
        raise ConfigError(text) from None


def _pick(readers: Mapping[str, Callable[[], Camera]], selector: str | None) -> Callable[[], Camera]:
    if list(readers) == [""]:
        if selector is not None:
            raise ConfigError(f"#{selector}: the file holds one camera only; drop #{selector}")
        return readers[""]
    choices = ", ".join(f"#{key}" for key in readers)
    if selector is None and len(readers) > 1:
        raise ConfigError(f"file: holds {len(readers)} cameras; append one of {choices} to the name")
    if selector is not None and selector not in readers:
        raise ConfigError(f"#{selector}: no such camera; choose {choices}")
    return readers[selector or next(iter(readers))]


def _readers(text: str) -> dict[str, Callable[[], Camera]]:
    """The readers of the cameras in a text by their selectors; one alone that has none stands under ""."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise ConfigError("file: holds only comments; write the fields into it")
    if _COLMAP_LINE.match(lines[0].strip()):
        return reconstruction.colmap([line.split() for line in lines])
    if _INI_SECTION.fullmatch(lines[0].strip()) and any(line.strip() == "camera matrix" for line in lines):
        return {"": lambda: native.read_ini(lines)}
    if xml.is_xml(text):
        return {"": lambda: _xml(text)}
    if slam.is_mrcal(text):
        return {"": lambda: slam.mrcal(text)}
    return _mappings(parse_mapping(text), text)


def _xml(text: str) -> Camera:
    root = xml.parse(text)
    if root.tag == "opencv_storage":
        return native.read(xml.storage(root), text)
    if root.tag == "calibration":
        return reconstruction.metashape(root)
    raise xml.unknown(root)


def _mappings(data: dict[str, Any], text: str) -> dict[str, Callable[[], Camera]]:
    if readers := slam.kalibr(data):
        return readers
    if slam.is_orb_slam(data):
        return slam.orb_slam(data)
    if "value0" in data:
        return slam.basalt(data)
    for recognised, read in (
        (reconstruction.is_nerf, reconstruction.nerf),
        (sensors.is_realsense, sensors.realsense),
        (sensors.is_open3d, sensors.open3d),
        (sensors.is_bop, sensors.bop),
    ):
        if recognised(data):
            return {"": partial(read, data)}
    return {"": lambda: native.read(data, text)}

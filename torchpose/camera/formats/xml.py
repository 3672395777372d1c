"""XML as OpenCV's FileStorage writes it, and which XML a file is."""

from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from torchpose.camera.formats.fields import shown
from torchpose.errors import ConfigError

_DEEPEST = 20  # levels of a file (convention)


def is_xml(text: str) -> bool:
    """Whether a text begins as XML does."""
    return text.lstrip().startswith("<")


def parse(text: str) -> Element:
    """The root of an XML file; one that declares a type or entities, which could grow without end, is refused."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError("file: declares a document type; write the plain XML of OpenCV or Metashape")
    try:
        return ElementTree.fromstring(text.strip())
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ConfigError(f"file: is not XML ({error}); correct the syntax") from None


def storage(root: Element) -> dict[str, Any]:
    """The mapping in OpenCV's XML: matrices as mappings of rows, cols, dt and data."""
    return _entries(root, 0)


def _entries(element: Element, depth: int) -> dict[str, Any]:
    if depth > _DEEPEST:
        raise ConfigError("file: is nested too deeply; write the fields at the top")
    data: dict[str, Any] = {}
    for child in element:
        if child.tag in data and child.tag != "_":
            raise ConfigError(f"{child.tag}: given twice; keep one")
        kind = child.get("type_id", "")
        if kind in ("opencv-matrix", "opencv-nd-matrix"):
            data[str(child.tag)] = {str(part.tag): _part(part) for part in child}
        else:
            data[str(child.tag)] = _entries(child, depth + 1) if len(child) else _scalar((child.text or "").strip())
    return data


def _part(part: Element) -> Any:
    words = (part.text or "").split()
    if part.tag in ("data", "sizes"):
        return [_scalar(word) for word in words]
    return _scalar(words[0]) if len(words) == 1 else (part.text or "").strip()


def _scalar(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except (ValueError, OverflowError):
            continue
    return text.strip('"')


def unknown(root: Element) -> ConfigError:
    """That the XML is of another program."""
    return ConfigError(
        f"file: is XML of <{shown(str(root.tag))}>; OpenCV's <opencv_storage> and Metashape's <calibration> are read"
    )

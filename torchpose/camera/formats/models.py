"""Which lens model a file speaks of, whatever the key that says so.

A model that is taken for another one moves poses by millimetres, so nothing is passed over that could name one: what is
not understood is refused, with the list of what is read.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

from torch import Tensor

from torchpose.camera.formats.fields import shown
from torchpose.camera.model import Model
from torchpose.errors import ConfigError

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
"""Names that messages list."""
_SPELLINGS: dict[str, Model] = {
    **dict.fromkeys(
        ("brown", "brownconradi", "radialtangential", "radtan4", "radtan5", "radtan8", "pinholeradtan", "rational"),
        "brown_conrady",
    ),
    **dict.fromkeys(("pinholeradtan8", "pinholeradialtangential", "pinholebrownconrady"), "brown_conrady"),
    **dict.fromkeys(("kb", "kb4", "kb8", "kannalabrandt4", "kannalabrandt8", "equi"), "kannala_brandt"),
    **dict.fromkeys(("opencvfisheye", "fisheyeopencv", "pinholeequi", "pinholeequidistant"), "kannala_brandt"),
    **dict.fromkeys(("pinholefisheye", "fisheyekannalabrandt"), "kannala_brandt"),
    **{name.replace("_", ""): model for name, model in MODELS.items()},
}
# a projection that goes with either distortion
_NEUTRAL = {"pinhole", "perspective", "opencv", "simplepinhole", "central", "monocular"}
# parts of keys that name a model or give its parameters: `camera_model`, `lensType`, `is_fisheye`, `projection`, ...
_NAMING = re.compile(
    r"model|type|(?<!re)projection|lens|dist(?!anc|rib)|rectified|fish|omni|equidist|kannala|brandt|mirror|catadiop|unified|spher|rectilinear"
)
# single words of keys that are parameters of models that are not read (unified, double sphere, division, ...)
_PARAMETERS = {"xi", "alpha", "beta", "eucm", "ds", "mei", "poly", "invpoly", "affine", "rpmax", "prism", "tau", "skew"}
# ... and of keys that speak of something else
_ELSEWHERE = re.compile(
    r"matrix|covar|std|sigma|error|rms|path|file|folder|board|pattern|target|chess|marker|pixel|data|sensor|serial|device"
    r"|product|vendor|manufact|hardware|topic|encoding|message|msg|shutter|trigger|unit|(?<!_)type_id"
)
# lenses of another kind, in words that no other part of a file uses
_OTHER_LENS = re.compile(
    r"fish[-_ ]?eye|omni|equi-?_?dist|equi-?_?solid|equi-?_?rect|kannala|\bkb[48]?\b|\bequi\b|\bucm\b|\bmei\b|o-?cam"
    r"|scaramuzza|cata-?diop|\bxi\b|double[-_ ]?sphere|\beucm\b|unified|f-?_?theta|stereographic|orthographic|spherical"
    r"|cylind|panoram|division|\bfov\b(?=.{0,3}model)|thin-?_?prism",
    re.IGNORECASE,
)
_DEEPEST = 6  # levels of mappings that are looked through; models stand higher (convention)
_MOST = 10_000  # entries of a file that are looked at: others are long lists, or aliases of aliases (convention)


class Statement(NamedTuple):
    """What an entry of a file says of its lens model: one that is read, None where it fits all, or "unknown"."""

    field: str
    value: Any
    model: Model | str | None


def refusal(field: str, value: Any) -> ConfigError:
    """That a model is not read, and which ones are."""
    doubt = "" if field.endswith("distortion_model") else ", or drop the line if it names no lens model"
    return ConfigError(f"{field}: {shown(value)} is not supported; use one of {', '.join(MODELS)}{doubt}")


def named(value: Any) -> Model | str | None:
    """The model that a value names."""
    if not isinstance(value, str):
        return "unknown"
    name = re.sub(r"[^a-z0-9]", "", value.lower())
    return None if name in _NEUTRAL else _SPELLINGS.get(name, "unknown")


def lens_model(
    data: Mapping[str, Any], read: Collection[str], *, text: str = "", implied: Model | None = None
) -> Model:
    """The model of a file by all of its entries; Brown-Conrady where it says nothing.

    Args:
        data: the file.
        read: keys that its reader understands itself, at the top.
        text: the whole file, where words anywhere in it that speak of another lens count as well.
        implied: the model that the format has of itself.

    Raises:
        ConfigError: an entry names a model that is not read, or could, or two contradict each other.
    """
    found = list(_statements(data, read))
    sure = [s for s in found if s.model not in (None, "unknown")]
    for one in found:
        if one.model == "unknown" and not (sure and _harmless(one)):
            raise refusal(one.field, one.value)
    if other := next((s for s in sure[1:] if s.model != sure[0].model), None):
        raise ConfigError(
            f"{other.field}: {shown(other.value)} contradicts {sure[0].field}, {shown(sure[0].value)}; keep one of them"
        )
    model = sure[0].model if sure else implied
    if implied is not None and model != implied:
        raise ConfigError(
            f"{sure[0].field}: {shown(sure[0].value)} contradicts the format, which has {implied}; correct it"
        )
    if model is None and (word := _OTHER_LENS.search(text)):
        raise ConfigError(
            f"distortion_model: is missing, and the file speaks of {word[0]!r}; write distortion_model: and one of "
            f"{', '.join(MODELS)}"
        )
    return "kannala_brandt" if model == "kannala_brandt" else "brown_conrady"


def check_none(data: Mapping[str, Any], read: Collection[str], distortion: Tensor) -> None:
    """Refuses coefficients of a file that says that it has no distortion."""
    none = next((s.field for s in _statements(data, read) if shown(s.value).lower() == "'none'"), "")
    if none and bool((distortion != 0).any()):
        raise ConfigError(f"{none}: is 'none', and the coefficients are not zero; write their model")


def _harmless(one: Statement) -> bool:
    """Whether an entry that is not understood may stand beside one that is: the name of a product, a flag."""
    words = f"{one.field} {shown(one.value)}" if isinstance(one.value, str | int) else ""
    leaf = one.field.rsplit(".", 1)[-1]
    return bool(words) and not (
        _OTHER_LENS.search(words) or "distort" in leaf.lower() or _PARAMETERS & set(_words(leaf))
    )


def _statements(data: Mapping[str, Any], read: Collection[str]) -> Iterator[Statement]:
    """Entries that speak of a lens model, through all levels."""
    waiting: list[tuple[str, Any, int]] = [(str(k), v, 1) for k, v in data.items() if str(k) not in read]
    seen: set[int] = set()
    count = 0
    while waiting and count < _MOST:
        field, value, depth = waiting.pop(0)
        count += 1
        if isinstance(value, Mapping | list):
            if id(value) in seen or depth > _DEEPEST:
                continue
            seen.add(id(value))
        leaf = field.rsplit(".", 1)[-1]
        naming = bool(_naming(leaf)) and not _ELSEWHERE.search(field.lower())
        if isinstance(value, Mapping) and "data" not in value:
            waiting.extend((f"{field}.{k}", v, depth + 1) for k, v in value.items())
        elif isinstance(value, list) and any(isinstance(entry, Mapping) for entry in value):
            waiting.extend(
                (f"{field}.{n}", v, depth + 1) for n, v in enumerate(value[:_MOST]) if isinstance(v, Mapping)
            )
        elif naming and value is not None:
            yield Statement(field, value, _said(leaf, value))


def _naming(key: str) -> bool:
    joined = re.sub(r"[^a-z0-9]", "", key.lower())
    return bool(_NAMING.search(joined)) or bool(_PARAMETERS & set(_words(key)))


def _words(key: str) -> list[str]:
    return re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", key).lower())


def _said(key: str, value: Any) -> Model | str | None:
    """What the value under a key says, which may be a flag such as `is_fisheye`."""
    flag = (
        value
        if isinstance(value, bool)
        else {"true": True, "yes": True, "false": False, "no": False}.get(
            value.lower() if isinstance(value, str) else ""
        )
    )
    if isinstance(value, int) and value in (0, 1):
        flag = bool(value)
    if flag is not None and re.search(r"fish|equidist|kannala", key.lower()):
        return "kannala_brandt" if flag else "brown_conrady"
    if isinstance(value, bool | int | float) and value == 0 and not re.search(r"model|type|projection", key.lower()):
        return None  # a parameter or a flag of another lens that says no
    return named(value)

"""Reading and writing of small configuration files (YAML, and JSON as its subset), with one-line errors.

Every error is a `ConfigError` of the form ``FILE: FIELD: what is wrong; the fix``.
"""

import difflib
import json
import os
import re
import typing
from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from torchpose.errors import ConfigError

ModelT = TypeVar("ModelT", bound=BaseModel)


class _DuplicateKey(ValueError):
    pass


class _Loader(yaml.SafeLoader):
    """Safe YAML that rejects duplicate keys, drops unknown tags (``!!opencv-matrix``), reads ``1e-3`` as a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise _DuplicateKey(f"{key.value}: given twice (line {key.start_mark.line + 1}); keep one")
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_untagged(self, _suffix: str, node: yaml.Node) -> Any:
        if isinstance(node, yaml.MappingNode):
            return self.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return self.construct_sequence(node, deep=True)
        tag = self.resolve(yaml.ScalarNode, node.value, (True, False))  # type: ignore[no-untyped-call]  # of yaml
        return self.construct_object(yaml.ScalarNode(tag, node.value))


_Loader.add_multi_constructor("", _Loader.construct_untagged)
# YAML 1.1, which PyYAML follows, takes 1e-3 for text, and OpenCV writes .Nan
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$|[-+]?\.(inf|nan)$", re.IGNORECASE),
    list("-+.0123456789"),
)


@contextmanager
def within(prefix: str, names: Mapping[str, str] | None = None, other: str | None = None) -> Iterator[None]:
    """Says in front of a `ConfigError` where its field stands.

    Args:
        prefix: such as ``FILE: `` or ``cam0.``.
        names: what the file calls a field.
        other: what it calls those that are not in ``names``; None leaves them as they are.
    """
    try:
        yield
    except ConfigError as error:
        field, _, problem = str(error).partition(": ")
        raise ConfigError(f"{prefix}{(names or {}).get(field, other or field)}: {problem}") from None


def _one_line(text: str) -> str:
    return " ".join(text.split())


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file.

    Raises:
        ConfigError: it is missing, a folder, unreadable, empty or not text.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
        problem = "is not text; give a YAML or JSON file" if "\0" in text else ""
        if not text.strip():
            problem = "is empty; write the fields into it"
    except FileNotFoundError:
        problem = "does not exist; check the path"
    except IsADirectoryError:
        problem = "is a folder; name a file in it"
    except UnicodeDecodeError:
        problem = "is not text; give a YAML or JSON file"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        problem = f"cannot be read ({reason}); check the path and its permissions"
    if problem:
        raise ConfigError(f"{path}: file: {problem}")
    return text


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, value in pairs:
        if key in data:
            raise _DuplicateKey(f"{key}: given twice; keep one")
        data[key] = value
    return data


def parse_mapping(text: str) -> dict[str, Any]:
    """The mapping in YAML or JSON text; OpenCV's ``%YAML:1.0`` header and matrix tags are accepted.

    Raises:
        ConfigError: not YAML, several documents, a duplicate key, or not a mapping.
    """
    try:
        try:
            data = json.loads(text, object_pairs_hook=_unique_keys)
        except json.JSONDecodeError:
            # OpenCV writes "%YAML:1.0" where the standard wants "%YAML 1.0"; the line is emptied, so numbering holds
            documents = [d for d in yaml.load_all(re.sub(r"\A%YAML:.*", "", text), Loader=_Loader) if d is not None]
            if len(documents) > 1:
                raise ConfigError(f"file: holds {len(documents)} YAML documents; keep one") from None
            data = documents[0] if documents else None
    except _DuplicateKey as error:
        raise ConfigError(_one_line(str(error))) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}" if mark else "file"
        raise ConfigError(f"{where}: is not YAML ({_one_line(str(error.problem))}); correct the syntax") from None
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError) as error:  # from PyYAML's tags
        first = _one_line(str(error))[:120]
        raise ConfigError(f"file: is not YAML ({first}); give a YAML or JSON file") from None
    if not isinstance(data, dict):
        kind = {list: "a list", str: "plain text", type(None): "nothing"}.get(type(data), "a single value")
        raise ConfigError(f"file: holds {kind}, not a mapping; write it as `key: value` lines")
    return {str(key): value for key, value in data.items()}


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML or JSON file.

    Raises:
        ConfigError: as `read_text` and `parse_mapping`.
    """
    text = read_text(path)
    with within(f"{path}: "):
        return parse_mapping(text)


def beside(path: Path, name: str) -> str:
    """What the configuration file ``path`` calls ``name``: relative to it, or else a name of its own (built-in)."""
    file = path.parent / name
    return str(file) if file.with_name(file.name.split("#")[0]).exists() or "/" in name else name


def suggest(key: str, allowed: Iterable[str]) -> str:
    """The fix for an unknown name: the nearest of the allowed ones, or all of them."""
    allowed = list(allowed)
    near = difflib.get_close_matches(key, allowed, n=1)
    return f"did you mean {near[0]}?" if near else f"known are {', '.join(allowed)}"


def _nested_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_nested_model, typing.get_args(annotation)) if m is not None), None)


def _known_keys(model: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    current: type[BaseModel] | None = model
    for part in location:
        if isinstance(part, str) and current is not None and part in current.model_fields:
            current = _nested_model(current.model_fields[part].annotation)
    return list(current.model_fields) if current else []


_FIX = {
    "missing": "is missing; add it",
    "float_type": "is not a number; write a number without quotes",
    "finite_number": "is not finite; write a finite number",
    "int_type": "is not an integer; write an integer without quotes",
    "int_from_float": "is not an integer; write an integer without quotes",
    "string_type": "is not text; put it in quotes",
    "list_type": "is not a list; write [a, b, c]",
    "model_type": "is not a mapping; write it as `key: value` lines",
    "model_attributes_type": "is not a mapping; write it as `key: value` lines",
}


def validate(model: type[ModelT], data: Any, path: str | os.PathLike[str]) -> ModelT:
    """``data`` as an instance of the pydantic ``model``.

    Args:
        model: its validators may raise `ValueError` with the text ``what is wrong; the fix``.
        data: what was read.
        path: file named in messages.

    Raises:
        ConfigError: the first error, and how many more there are.
    """
    try:
        return model.model_validate(data, strict=True)
    except ValidationError as caught:
        errors = caught.errors(include_url=False)
    # a mistyped key is reported before the field that it leaves missing
    error = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    location = error["loc"]
    field = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in location).lstrip(".") or "file"
    if error["type"] == "extra_forbidden":
        problem = f"unknown key; {suggest(str(location[-1]), _known_keys(model, location[:-1]))}"
    elif error["type"] == "value_error":
        problem = str(error["ctx"]["error"])
    elif error["type"] in ("too_short", "too_long"):
        wanted = error["ctx"].get("min_length", error["ctx"].get("max_length"))
        problem = f"has {error['ctx']['actual_length']} entries; give {wanted}"
    elif error["type"] == "literal_error":
        problem = f"is {error['input']!r}; write {error['ctx']['expected']}"
    else:
        problem = _FIX.get(error["type"]) or f"{error['msg']}; correct it"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    raise ConfigError(_one_line(f"{path}: {field}: {problem}{more}"))


def format_number(value: float) -> str:
    """Shortest text that reads back as the same float64, with a dot, so that every YAML reader sees a number."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def format_list(values: Iterable[float]) -> str:
    """``[a, b, ...]`` of `format_number`."""
    return "[" + ", ".join(map(format_number, values)) + "]"


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a whole file or nothing: into a temporary file beside it, which then takes its name.

    Raises:
        ConfigError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ConfigError(f"{path}: file: cannot be written ({error.strerror}); check the folder") from None


def quoted(text: str) -> str:
    """A string as YAML reads it back, whatever is in it."""
    double = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() or c == " " else f"\\U{ord(c):08x}" for c in double)

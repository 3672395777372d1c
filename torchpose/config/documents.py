"""YAML and JSON text as plain values, within bounds of time, memory and depth whatever the text says.

The parser's events are built into values here, without recursion. Aliases and merge keys are YAML's only way to say
much in few words: what they stand for is counted as if it were written out, and a document that would be too large is
refused at the event that makes it so.
"""

import json
import re
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

from torchpose.errors import ConfigError

MOST_VALUES = 200_000  # of a document (convention): the covariance of 130 measured markers
MOST_DEPTH = 32  # lists and mappings in each other (convention): our files have five
MOST_DIGITS = 100  # characters of a number (convention): a float64 has 24 at the most
_MOST_INTEGER = 2**63 - 1
_PARSER: Any = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader
_TAG = "tag:yaml.org,2002:"
_UNREAD = ("timestamp", "binary", "merge", "value")  # YAML's own kinds of words that have no meaning here
_NUMBERS = yaml.constructor.SafeConstructor()


# numbers to YAML 1.1 that are text, or another number, to YAML 1.2 and to whoever wrote them: 010 (8), 12:30 (750)
_AMBIGUOUS = re.compile(r"[-+]?(0[0-9_]+$|.*:)")


class _Resolver(yaml.SafeLoader):
    """What plain words mean: YAML 1.1, but ``1e-3`` and ``-.5`` are numbers, as in YAML 1.2, and ``.Nan`` of OpenCV."""


_Resolver.add_implicit_resolver(
    f"{_TAG}float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$|[-+]?\.(\d+|inf|nan)$", re.IGNORECASE),
    list("-+.0123456789"),
)


class _WrongError(ValueError):
    """A value that is refused; the message is ``FIELD: what is wrong; the fix``, or without the field in JSON."""


def parse_json(text: str | bytes) -> Any:
    """The value of JSON text.

    Raises:
        ValueError: it is not JSON, nested too deeply, names a key twice or holds a number of too many digits.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    try:
        value = json.loads(text, object_pairs_hook=_unique_keys, parse_int=_integer, parse_float=_float)
    except RecursionError:
        value = None
        depth = MOST_DEPTH + 1
    else:
        depth = _depth(value)
    if depth > MOST_DEPTH:
        raise _WrongError(f"file: lists and mappings lie in each other more than {MOST_DEPTH} deep; write it flatter")
    return value


def parse_mapping(text: str) -> dict[str, Any]:
    """The mapping in YAML or JSON text; OpenCV's ``%YAML:1.0`` header and matrix tags are accepted.

    Raises:
        ConfigError: not YAML, several documents, a duplicate key, not a mapping, or larger than the bounds above.
    """
    try:
        try:
            data = parse_json(text)
        except json.JSONDecodeError:
            # OpenCV writes "%YAML:1.0" where the standard wants "%YAML 1.0"; the line is emptied, so numbering holds
            documents = [d for d in _documents(re.sub(r"\A%YAML:.*", "", text)) if d is not None]
            if len(documents) > 1:
                raise ConfigError(f"file: holds {len(documents)} YAML documents; keep one") from None
            data = documents[0] if documents else None
    except _WrongError as error:
        raise ConfigError(str(error)) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}" if mark else "file"
        raise ConfigError(f"{where}: is not YAML ({_one_line(error.problem)}); correct the syntax") from None
    except (yaml.YAMLError, ValueError) as error:  # characters that YAML does not know
        first = _one_line(error)[:120]
        raise ConfigError(f"file: is not YAML ({first}); give a YAML or JSON file") from None
    if not isinstance(data, dict):
        kind = {list: "a list", str: "plain text", type(None): "nothing"}.get(type(data), "a single value")
        raise ConfigError(f"file: holds {kind}, not a mapping; write it as `key: value` lines")
    return data


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise _WrongError(f"{twice}: given twice; keep one")
    return data


def _integer(text: str) -> int:
    if len(text) > MOST_DIGITS or abs(int(text)) > _MOST_INTEGER:
        raise _WrongError(f"file: {text[:20]}... is a number of {len(text)} digits; no file of ours needs it")
    return int(text)


def _float(text: str) -> float:
    if len(text) > MOST_DIGITS:
        raise _WrongError(f"file: {text[:20]}... is a number of {len(text)} digits; no file of ours needs it")
    return float(text)


def _depth(value: Any) -> int:
    """How deep lists and mappings lie in each other, as far as `MOST_DEPTH` and one more."""
    level, depth = [value], 0
    while depth <= MOST_DEPTH:
        level = [one for one in level if isinstance(one, list | dict)]
        if not level:
            break
        level = [e for one in level for e in (one if isinstance(one, list) else one.values())]
        depth += 1
    return depth


@dataclass
class _Open:
    """A list or mapping that the events have begun and not ended."""

    value: list[Any] | dict[str, Any]
    anchor: str | None
    size: int  # of the document when it began
    key: str | None = None  # of a mapping, whose value comes next
    merged: list[dict[str, Any]] = field(default_factory=list)  # the first counts most


class _Builder:
    """The value of one document from its events."""

    def __init__(self) -> None:
        self.root: Any = None
        self._open: list[_Open] = []
        self._anchors: dict[str, tuple[Any, int]] = {}  # what aliases stand for, and its size; None while it is open
        self._size = 0

    def take(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.ScalarEvent):
            self._grow(1, event)
            plain_key = event.implicit[0] and event.value == "<<"
            if self._wants_key():
                self._set_key("<<" if plain_key else event.value, event, merge=plain_key)
            else:
                value = _scalar(event)
                self._remember(event.anchor, value, 1)
                self._add(value, event)
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                raise _wrong(event, f"*{event.anchor} stands for what is not ended before it; write it out")
            value, size = self._anchors[event.anchor]
            self._grow(size, event)
            if self._wants_key():
                self._set_key(str(value), event, merge=False, plain=not isinstance(value, list | dict))
            else:
                self._add(value, event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._begin(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._end(event)

    def _begin(self, event: yaml.CollectionStartEvent) -> None:
        if self._wants_key():
            raise _wrong(event, "a list or mapping stands where a key should; write a word")
        if len(self._open) >= MOST_DEPTH:
            raise _wrong(event, f"lists and mappings lie in each other more than {MOST_DEPTH} deep; write it flatter")
        self._grow(1, event)
        value: list[Any] | dict[str, Any] = [] if isinstance(event, yaml.SequenceStartEvent) else {}
        self._anchors.pop(event.anchor or "", None)
        self._open.append(_Open(value, event.anchor, self._size - 1))

    def _end(self, event: yaml.Event) -> None:
        done = self._open.pop()
        if isinstance(done.value, dict):
            for merged in done.merged:
                done.value |= {key: value for key, value in merged.items() if key not in done.value}
        self._remember(done.anchor, done.value, self._size - done.size)
        self._add(done.value, event)

    def _grow(self, by: int, event: yaml.Event) -> None:
        self._size += by
        if self._size > MOST_VALUES:
            raise _wrong(event, f"more than {MOST_VALUES} values, with all aliases written out; write a smaller file")

    def _remember(self, anchor: str | None, value: Any, size: int) -> None:
        if anchor is not None:
            self._anchors[anchor] = (value, size)

    def _wants_key(self) -> bool:
        return bool(self._open) and isinstance(self._open[-1].value, dict) and self._open[-1].key is None

    def _set_key(self, key: str, event: yaml.Event, *, merge: bool, plain: bool = True) -> None:
        holder = self._open[-1]
        if not plain:
            raise _wrong(event, "a list or mapping stands where a key should; write a word")
        if key in holder.value and not merge:
            raise _WrongError(f"{key}: given twice ({_line(event)}); keep one")
        holder.key = "" if merge else f"_{key}"  # told apart from the key "<<" in quotes

    def _add(self, value: Any, event: yaml.Event) -> None:
        if not self._open:
            self.root = value
            return
        holder = self._open[-1]
        if isinstance(holder.value, list):
            holder.value.append(value)
            return
        assert holder.key is not None  # a mapping's events come in pairs
        if holder.key:
            holder.value[holder.key[1:]] = value
        else:
            merged = value if isinstance(value, list) else [value]
            if not all(isinstance(one, dict) for one in merged):
                raise _wrong(event, "<< merges mappings; give one, or a list of them")
            holder.merged += merged
        holder.key = None


def _documents(text: str) -> Iterator[Any]:
    """The values of all documents in YAML text."""
    builder = _Builder()
    for event in yaml.parse(text, Loader=_PARSER):
        if isinstance(event, yaml.DocumentStartEvent):
            builder = _Builder()
        elif isinstance(event, yaml.DocumentEndEvent):
            yield builder.root
        else:
            builder.take(event)


def _scalar(event: yaml.ScalarEvent) -> Any:
    """What a word means. Tags that are not YAML's own are dropped; a date stays text."""
    text = event.value
    tag = (event.tag or "").removeprefix(_TAG)
    if event.tag and tag in _UNREAD:
        raise _wrong(event, f"!!{tag} is a kind of value that no file of ours needs; leave the tag out")
    if tag == "str" or (tag not in _MEANINGS and event.style):
        return text
    if tag not in _MEANINGS:
        rules = _Resolver.yaml_implicit_resolvers
        places = [*rules.get(text[:1], []), *rules.get(None, [])]
        tag = next((rule.removeprefix(_TAG) for rule, pattern in places if pattern.match(text)), "str")
        if tag in ("int", "float") and _AMBIGUOUS.match(text):
            return text
    if tag not in _MEANINGS:
        return text
    if tag in ("int", "float") and len(text) > MOST_DIGITS:
        raise _wrong(event, f"{text[:20]}... is a number of {len(text)} digits; no file of ours needs it")
    try:
        value = _MEANINGS[tag](yaml.ScalarNode(f"{_TAG}{tag}", text))
    except (ValueError, KeyError, IndexError, OverflowError):
        raise _wrong(event, f"{text[:40]!r} is no {tag}; correct it") from None
    if isinstance(value, int) and abs(value) > _MOST_INTEGER:
        raise _wrong(event, f"{text[:20]}... is a number of {len(text)} digits; no file of ours needs it")
    return value


_MEANINGS: dict[str, Callable[[yaml.ScalarNode], Hashable]] = {
    "null": lambda node: None,
    "bool": _NUMBERS.construct_yaml_bool,
    "int": _NUMBERS.construct_yaml_int,
    "float": _NUMBERS.construct_yaml_float,
}


def _wrong(event: yaml.Event, problem: str) -> _WrongError:
    return _WrongError(f"{_line(event)}: {problem}")


def _line(event: yaml.Event) -> str:
    return f"line {event.start_mark.line + 1}" if event.start_mark else "file"

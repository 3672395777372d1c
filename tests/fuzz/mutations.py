"""Files as slips of the pen, bad disks and bad will leave them: a few changes to one that is right."""

import random
import re
from collections.abc import Callable

from hypothesis import strategies as st

Change = tuple[str, int, int, bytes]

# what breaks readers: numbers beyond all types, other kinds, YAML's shorthand, halves of pairs, markup, escapes
TOKENS = [
    *(b"", b"0", b"-1", b"1e999", b"-1e-400", b"1e20", b"1e12", b"1000000", b"65536", b"9" * 400, b"0x", b"1:2:3"),
    *(
        b".5",
        b".nan",
        b"NaN",
        b"-.inf",
        b"Infinity",
        b"null",
        b"~",
        b"true",
        b"[]",
        b"{}",
        b"[[]]",
        b"[1, 2]",
        b"{a: 1}",
    ),
    *(b"''", b'"', b"'", b"[", b"]", b"{", b"}", b":", b": ", b",", b"#", b"- ", b"\n", b"\t", b"&a ", b"*a", b"<<: "),
    *(b"!!set ", b"!!binary ", b"!!python/object:os.system ", b"? ", b"|\n", b"---\n", b"%YAML:1.0\n", b"<?xml"),
    *(b"[" * 2000, b"{a: " * 500, b"\0", b"\xff", b"\xef\xbb\xbf", b"\\ud800", b"\\u0000", b"\xed\xa0\x80"),
    *(b"\x1b[2J", b"[/x]", b"../", b"/dev/zero", b"A" * 5000, b"&a [*a]", b"&a {<<: *a}", b"2024-01-01", b"frame"),
    *(b"ok", b"unreadable", b"1_000"),
]
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")


def _spot(text: bytes, at: int) -> int:
    return at % (len(text) + 1)


def _replaced(pattern: re.Pattern[bytes]) -> Callable[[bytes, int, int, bytes], bytes]:
    def change(text: bytes, at: int, _size: int, token: bytes) -> bytes:
        found = list(pattern.finditer(text))
        if not found:
            return text + token
        start, end = found[at % len(found)].span()
        return text[:start] + token + text[end:]

    return change


def _lines(text: bytes, at: int, size: int, _token: bytes) -> bytes:
    """A line is moved, copied or lost."""
    lines = text.splitlines(keepends=True) or [b""]
    line = lines[at % len(lines)]
    if size % 3 != 1:
        del lines[at % len(lines)]
    if size % 3:
        lines.insert(size % (len(lines) + 1), line)
    return b"".join(lines)


def _flip(text: bytes, at: int, size: int, _token: bytes) -> bytes:
    i = at % max(len(text), 1)
    return text[:i] + bytes([text[i] ^ (1 << size % 8)]) + text[i + 1 :] if text else text


CHANGES: dict[str, Callable[[bytes, int, int, bytes], bytes]] = {
    "flip": _flip,
    "cut": lambda text, at, size, _: text[: _spot(text, at)] + text[_spot(text, at) + size % 64 :],
    "end": lambda text, at, _size, _token: text[: _spot(text, at)],
    "insert": lambda text, at, _, token: text[: _spot(text, at)] + token + text[_spot(text, at) :],
    "repeat": lambda text, at, size, _: (
        text[: _spot(text, at)] + text[_spot(text, at) : _spot(text, at) + size % 64] * 20 + text[_spot(text, at) :]
    ),
    "number": _replaced(_NUMBER),
    "word": _replaced(_WORD),
    "line": _lines,
}
_PLACES, _MOST = 2**16, 4
_PLACE = st.integers(0, _PLACES)
changes = st.lists(
    st.tuples(st.sampled_from(sorted(CHANGES)), _PLACE, _PLACE, st.sampled_from(TOKENS)), min_size=1, max_size=_MOST
)


def drawn(chance: random.Random) -> list[Change]:
    """The same without hypothesis, which takes longer to draw a case than most readers to read it."""
    names = sorted(CHANGES)
    return [
        (chance.choice(names), chance.randint(0, _PLACES), chance.randint(0, _PLACES), chance.choice(TOKENS))
        for _ in range(chance.randint(1, _MOST))
    ]


def changed(text: bytes, several: list[Change]) -> bytes:
    """The text after some changes, one after the other."""
    for name, at, size, token in several:
        text = CHANGES[name](text, at, size, token)
    return text

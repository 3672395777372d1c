"""RTDE, the controller's wire protocol on port 30004, as its server sees it (Universal Robots, RTDE guide).

A packet is a big-endian uint16 size, a type byte and a payload. A recipe is a list of variables that travel together.
"""

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

HEADER = struct.Struct(">HB")
PROTOCOL, VERSION, OUTPUTS, INPUTS, START, PAUSE, DATA = (ord(c) for c in "VvOISPU")

_KINDS = json.loads(Path(__file__).with_name("variables.json").read_text(encoding="utf-8"))
_FORMATS = {kind: given["format"] for kind, given in _KINDS.items()}
TYPES = {name: kind for kind, given in _KINDS.items() for name in given["names"]}
for _register in (f"{side}_{{}}_register_{i}" for side in ("input", "output") for i in range(48)):
    TYPES |= {_register.format("int"): "INT32", _register.format("double"): "DOUBLE"}


@dataclass(frozen=True)
class Recipe:
    """Variables that travel in one data packet. A name the controller does not know has the type NOT_FOUND."""

    id: int
    names: tuple[str, ...]

    @property
    def types(self) -> list[str]:
        return [TYPES.get(name, "NOT_FOUND") for name in self.names]

    def pack(self, values: Iterable[float | Iterable[float]]) -> bytes:
        """The whole data packet; `values` in the order of the names, vectors as sequences or one number for all."""
        body = bytearray([self.id])
        for kind, value in zip(self.types, values, strict=True):
            code = _FORMATS[kind]
            fields = value if isinstance(value, Iterable) else [value] * int(code[:-1] or 1)
            body += struct.pack(">" + code, *fields)
        return packet(DATA, bytes(body))

    def unpack(self, body: bytes) -> dict[str, float]:
        """Scalars by name of a data packet's payload after its recipe id."""
        values = struct.unpack(">" + "".join(_FORMATS[kind] for kind in self.types), body)
        return dict(zip(self.names, values, strict=True))


def packet(kind: int, payload: bytes) -> bytes:
    """A packet with its header."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def names(payload: bytes) -> tuple[str, ...]:
    """The names in the comma-separated payload of a request for a recipe."""
    return tuple(name for name in payload.decode("ascii").split(",") if name)

"""RTDE, the controller's wire protocol on port 30004, as its server sees it (Universal Robots, RTDE guide).

A packet is a big-endian uint16 size, a type byte and a payload. A recipe is a list of variables that travel together.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

HEADER = struct.Struct(">HB")
PROTOCOL, VERSION, OUTPUTS, INPUTS, START, PAUSE, DATA = (ord(c) for c in "VvOISPU")

_FORMATS = {
    "DOUBLE": "d",
    "VECTOR6D": "6d",
    "VECTOR3D": "3d",
    "VECTOR6INT32": "6i",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
}
_TYPES = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
    "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 "
    "standard_analog_output1 payload",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_qdd "
    "actual_current actual_current_as_torque joint_control_output actual_TCP_pose actual_TCP_speed "
    "actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage "
    "ft_raw_wrench payload_inertia",
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode",
    "UINT32": "runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31 "
    "output_bit_registers32_to_63 speed_slider_mask",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
}
TYPES = {name: kind for kind, names in _TYPES.items() for name in names.split()}
for _i in range(48):
    for _side in ("input", "output"):
        TYPES[f"{_side}_int_register_{_i}"] = "INT32"
        TYPES[f"{_side}_double_register_{_i}"] = "DOUBLE"


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

"""How stored grey values follow light, and the way back."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torchpose.errors import ConfigError

_WRITE = "write linear, srgb or gamma: G, such as gamma: 2.2"
_GAMMA = re.compile(r"gamma\s*[:=]?\s*(\d+\.?\d*|\.\d+)")
_RANGE = (0.2, 5.0)  # of a gamma: beyond, somebody meant something else
_TOE = 0.04045  # of white, stored: below it sRGB is a line (IEC 61966-2-1)


@dataclass(frozen=True)
class Tone:
    """Of linear frames the grey values are proportional to light; sRGB and powers are taken back to that.

    Attributes:
        kind: linear; srgb (IEC 61966-2-1); or gamma, light = stored ^ gamma, both as shares of white.
        gamma: of the last.
    """

    kind: Literal["linear", "srgb", "gamma"] = "linear"
    gamma: float = 1.0

    @classmethod
    def parse(cls, value: Any, field: str = "tone") -> Tone:
        """``linear``, ``srgb``, ``gamma: 2.2`` (also ``gamma:2.2``) or a mapping ``{gamma: 2.2}``.

        Raises:
            ConfigError: it is none of these.
        """
        if isinstance(value, Mapping) and list(value) == ["gamma"]:
            value = f"gamma: {value['gamma']}"
        text = str(value).strip().lower()
        if text in ("linear", "srgb"):
            return cls("linear" if text == "linear" else "srgb")
        if not (found := _GAMMA.fullmatch(text)) or not _RANGE[0] <= float(found[1]) <= _RANGE[1]:
            raise ConfigError(f"{field}: is {value!r}; {_WRITE}")
        return cls("gamma", float(found[1]))

    def __str__(self) -> str:
        return f"gamma: {self.gamma:g}" if self.kind == "gamma" else self.kind

    def light(self, stored: Tensor) -> Tensor:
        """Share of white's light of shares of its stored value."""
        if self.kind == "linear":
            return stored
        if self.kind == "gamma":
            return stored.clamp_min(0).pow(self.gamma)
        return torch.where(stored <= _TOE, stored / 12.92, ((stored + 0.055) / 1.055).clamp_min(0).pow(2.4))

    def slope(self, light: Tensor) -> Tensor:
        """d light / d stored, at shares of white's light."""
        if self.kind == "linear":
            return torch.ones_like(light)
        light = light.clamp_min(1e-6)
        if self.kind == "gamma":
            return self.gamma * light.pow(1 - 1 / self.gamma)
        return torch.where(light <= _TOE / 12.92, 1 / 12.92, 2.4 / 1.055 * light.pow(1 - 1 / 2.4))

    def table(self, levels: int) -> Tensor:
        """Light of every stored level 0 to levels - 1, uint16 with white at 65535."""
        light = self.light(torch.arange(levels, dtype=torch.float64) / (levels - 1))
        return (65535 * light).round().to(torch.int32).to(torch.uint16)

    def linear(self, frames: Tensor, white: float = 255.0) -> Tensor:
        """Frames of any dtype as linear ones: integers as uint16 by the table, floats as float32 with white at 255."""
        if self.kind == "linear":
            return frames
        if not frames.is_floating_point():
            table = self.table(int(math.exp2(8 * frames.element_size()))).to(frames.device)
            # torch neither indexes by uint16 nor selects of it
            flat = frames.flatten().int() & 0xFFFF
            return table.view(torch.int16).index_select(0, flat).view(torch.uint16).view(frames.shape)
        return 255.0 * self.light((frames.float() / white).nan_to_num(nan=0.0))


LINEAR = Tone()

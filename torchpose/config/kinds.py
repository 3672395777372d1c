"""Kinds of fields with their ranges: what a number or a word of any file may be, in one place.

A number beyond its range is a slip of the pen or of a program (a wrong unit, a lost decimal point): it is named where
it is read, before arithmetic makes NaN, or hours, of it. All limits are conventions, far outside of what is measured.
"""

import math
import unicodedata
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

MOST_LENGTH = 1e7  # mm: ten kilometres
MOST_FIELD_PX = 1e6  # px
MOST_SIDE_PX = 65535  # px of a frame: the largest that any image format of ours holds
_MOST_NUMBER = 1e100  # whose square is a float64 still
_MOST_TEXT = 1000  # characters
_MOST_TURN = 2 * math.pi + 1e-3  # rad: once around, and the rounding of a file


def _word(text: str) -> str:
    for character in text:
        if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp"):
            raise ValueError(f"has the character {character!a}; write the text without it")
    if len(text) > _MOST_TEXT:
        raise ValueError(f"has {len(text)} characters; give at most {_MOST_TEXT}")
    return text


def check_turn(numbers: Sequence[float]) -> Sequence[float]:
    """Refuses a rotation vector longer than a whole turn, which robots do not report: degrees stand there.

    Raises:
        ValueError: it is longer.
    """
    if (length := math.hypot(*numbers)) > _MOST_TURN:
        raise ValueError(f"turns by {length:g} rad, more than once around; write a rotation vector in rad, not degrees")
    return numbers


def _limits(low: float, high: float) -> object:
    return Field(ge=low, le=high, allow_inf_nan=False)


Text = Annotated[str, AfterValidator(_word)]
"""Text without control characters, line ends and halves of surrogate pairs; such as a name in a table or a path."""
Word = Annotated[Text, Field(min_length=1)]
"""The same, not empty."""
Number = Annotated[float, _limits(-_MOST_NUMBER, _MOST_NUMBER)]
Size = Annotated[float, _limits(0.0, _MOST_NUMBER)]
"""Not negative."""
Length = Annotated[float, _limits(-MOST_LENGTH, MOST_LENGTH)]
"""mm."""
Distance = Annotated[float, _limits(0.0, MOST_LENGTH)]
"""mm, not negative."""
Degrees = Annotated[float, _limits(-3600.0, 3600.0)]
Radians = Annotated[float, _limits(-100.0, 100.0)]
RotationVector = Annotated[list[Number], Field(min_length=3, max_length=3), AfterValidator(check_turn)]
"""rad; its length is the angle."""
Grey = Annotated[float, _limits(0.0, 255.0)]
"""Grey level of 0..255."""
Pixels = Annotated[float, _limits(0.0, MOST_FIELD_PX)]
Share = Annotated[float, _limits(0.0, 1.0)]
Side = Annotated[int, Field(ge=1, le=MOST_SIDE_PX)]
"""Width or height of a frame, px."""
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]

"""Why a file gives no picture, and the bounds that its header is held against before memory is taken for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

MOST_PIXELS = 1 << 28  # of a picture, camera or not (convention): four times the largest machine-vision sensors
_ROOM = 16  # bytes a pixel that no decoder exceeds: 12 bits one by one, or colour of 16 bits twice, and the grey values


class UnreadableImageError(Exception):
    """A picture cannot be decoded; `reason` is one word for the results.

    ``missing``, ``not_a_file``, ``unreadable_file``, ``empty``, ``not_an_image``, ``truncated``, ``corrupt``,
    ``unsupported``, ``unsupported_depth``, ``too_large`` or ``out_of_memory``.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class WrongSizeError(Exception):
    """A picture is not of the size that was asked for; told from its header, before its pixels are decoded."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(f"{width}x{height}")
        self.width, self.height = width, height


@dataclass(frozen=True)
class Header:
    """What a file says of itself: size of its picture in px, and the most pixels that its bytes can hold."""

    width: int
    height: int
    most: float


def check_size(header: Header, size: tuple[int, int] | None) -> None:
    """Holds what a header claims against the size that is asked for, else against `MOST_PIXELS`; then against its file
    and against memory.

    Args:
        header: of the file.
        size: width and height that the picture has to have, if known.

    Raises:
        UnreadableImageError: no picture, too large for any or for its file, or there is no memory for it.
        WrongSizeError: another size.
    """
    width, height = header.width, header.height
    if width <= 0 or height <= 0:
        raise UnreadableImageError("corrupt")
    if size is not None and (width, height) != size:
        raise WrongSizeError(width, height)
    if width * height > MOST_PIXELS:
        raise UnreadableImageError("too_large")
    if width * height > header.most:
        raise UnreadableImageError("truncated")
    # native decoders say of a failed allocation that the file is bad, or end the process: it is tried here, where
    # untouched memory costs nothing
    with memory_told():
        np.empty(_ROOM * width * height, np.uint8)


@contextmanager
def memory_told() -> Iterator[None]:
    """A failed allocation is a reason of its own: nothing is known of the file."""
    try:
        yield
    except MemoryError:
        raise UnreadableImageError("out_of_memory") from None

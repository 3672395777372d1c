"""The two libraries that decode: what they refuse, and how they say so."""

from typing import Any

import cv2
import numpy as np

from torchpose.io.images.header import UnreadableImageError, memory_told

# A camera file describes the sensor's rows and columns: the orientation that a phone notes in EXIF must not turn them.
FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def by_opencv(data: bytes) -> np.ndarray:
    """Grey values (H, W). UnreadableImageError: OpenCV refuses the file."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), FLAGS)
    except cv2.error:  # more pixels than OpenCV accepts, or a header that contradicts itself
        image = None
    if image is None:
        raise UnreadableImageError("corrupt")
    if image.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError("unsupported_depth")
    return np.asarray(image)


def by_kornia(function: str, *arguments: Any) -> np.ndarray | None:
    """Grey values (H, W) by a function of `kornia_rs.io`; None where it refuses the file."""
    from kornia_rs import io

    try:
        with memory_told():
            image: np.ndarray = getattr(io, function)(*arguments)
    except UnreadableImageError:
        raise
    except BaseException as error:
        # a panic of the Rust code is no Exception, nor can its type be imported
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            return None
        raise
    return image[..., 0]

"""Grey values of colour frames, and where they are clipped."""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpose.errors import FrameError
from torchpose.geometry.arguments import tensor_of
from torchpose.geometry.constants import constant, either

FRAME_TYPES = (torch.uint8, torch.uint16, torch.float16, torch.bfloat16, torch.float32, torch.float64)
Frames = Tensor | NDArray[Any]
_FULL_SCALES = (255.0, 1023.0, 4095.0, 16383.0, 65520.0, 65535.0)  # of 8 to 16 bits; 12 bits in the upper ones of 16


def as_frames(frames: Any) -> Tensor:
    """Grey frames (B, H, W) of a tensor or NumPy array (H, W), (B, H, W), (B, 1, H, W) or RGB (B, 3, H, W).

    Raises:
        FrameError: another shape or dtype.
    """
    frames = tensor_of(frames)
    if not isinstance(frames, Tensor):
        raise FrameError(f"frames: is of type {type(frames).__name__}; pass a tensor or NumPy array (B, H, W)")
    if frames.layout != torch.strided or frames.is_meta:
        kind = "on the device meta" if frames.is_meta else str(frames.layout).removeprefix("torch.")
        raise FrameError(
            f"frames: is {kind}; pass a tensor that holds every pixel (to_dense, numbers of a real device)"
        )
    if frames.ndim in (3, 4) and frames.shape[-1] in (3, 4):
        raise FrameError(
            f"frames: shape {tuple(frames.shape)} has its colours last, as OpenCV has; pass grey frames, or RGB "
            "(B, 3, H, W): cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)"
        )
    if frames.ndim == 2:
        frames = frames[None]
    if frames.ndim == 4 and frames.shape[1] == 1:
        frames = frames[:, 0]
    if frames.ndim == 4 and frames.shape[1] == 3 and frames.dtype in FRAME_TYPES:
        frames = grey(frames)
    if frames.ndim != 3:
        raise FrameError(
            f"frames: shape {tuple(frames.shape)}; pass grey frames (H, W), (B, H, W) or (B, 1, H, W), or RGB "
            "(B, 3, H, W)"
        )
    if frames.is_complex():
        raise FrameError(f"frames: dtype {frames.dtype}; pass real numbers")
    return frames


def levels(frames: Tensor, white: float | None) -> Tensor:
    """Frames with floating-point ones in levels of 0 to 255; ``white`` None: 1.0 where no value exceeds it, or 255.0.

    Raises:
        FrameError: ``white`` is not positive.
    """
    if not frames.is_floating_point():
        return frames
    if white is None:
        white = 1.0 if frames.numel() and float(frames.nan_to_num(0.0).amax()) <= 1 else 255.0
    if not white > 0:
        raise FrameError(f"float_range: {white} is not positive; use 1.0 or 255.0")
    return frames if white == 255.0 else frames.float() * (255.0 / white)


def grey(frames: Tensor) -> Tensor:
    """Luma (B, H, W) of RGB frames (B, 3, H, W), uint8, uint16 or floating point, in the dtype of the frames.

    ITU-R BT.601, as OpenCV reduces colour files: for uint8 bit for bit, for uint16 rounded.
    """
    from kornia.color import rgb_to_grayscale

    if frames.dtype != torch.uint16:
        return rgb_to_grayscale(frames)[:, 0]
    return rgb_to_grayscale(frames.float())[:, 0].round().to(torch.int32).to(torch.uint16)


def full_scale(brightest: Tensor) -> Tensor:
    """Grey values at which frames are clipped, by their brightest ones: the full scale of a sensor, or inf."""
    full = torch.isin(brightest, constant(_FULL_SCALES, brightest))
    return either(full, brightest, torch.inf)

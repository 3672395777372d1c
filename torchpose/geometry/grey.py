"""Grey values of colour frames, and where they are clipped."""

import torch
from torch import Tensor

_FULL_SCALES = (255.0, 1023.0, 4095.0, 16383.0, 65520.0, 65535.0)  # of 8 to 16 bits; 12 bits in the upper ones of 16


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
    full = torch.isin(brightest, torch.tensor(_FULL_SCALES, dtype=brightest.dtype, device=brightest.device))
    return torch.where(full, brightest, torch.inf)

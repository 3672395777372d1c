"""Grey values of colour frames."""

import torch
from torch import Tensor


def grey(frames: Tensor) -> Tensor:
    """Luma (B, H, W) of RGB frames (B, 3, H, W), uint8, uint16 or floating point, in the dtype of the frames.

    ITU-R BT.601, as OpenCV reduces colour files: for uint8 bit for bit, for uint16 rounded.
    """
    from kornia.color import rgb_to_grayscale

    if frames.dtype != torch.uint16:
        return rgb_to_grayscale(frames)[:, 0]
    return rgb_to_grayscale(frames.float())[:, 0].round().to(torch.int32).to(torch.uint16)

"""Faults of print, light and sensor as kornia's augmentation modules, each frame with random numbers of its own."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchpose.config import suggest
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.sim.sensor import GREY_MAX, frame_keys


@checked
def with_faults(
    frames: Tensor, faults: Callable[[Tensor], Tensor], seed: int = 0, *, index: Tensor | None = None
) -> Tensor:
    """Frames with faults, which depend on the seed and the frame's number alone, as the noise of `add_noise` does.

    Args:
        frames: (B, H, W), grey levels 0..255.
        faults: any module on frames (1, 1, H, W) of 0..1 that takes its chance from torch, such as those of
            `faults_of` or kornia's augmentations, one by one or in an `nn.Sequential`.
        seed: any integer.
        index: (B,) int64, the frames' numbers; 0 to B - 1 by default.
    """
    out = torch.empty_like(frames, dtype=torch.float32)
    with torch.random.fork_rng([frames.device] if frames.is_cuda else []):
        for number, key in enumerate(frame_keys(len(frames), seed, index).tolist()):
            torch.manual_seed(key)
            out[number] = faults(frames[number, None, None].float() / GREY_MAX)[0, 0] * GREY_MAX
    return out


@checked
def faults_of(wanted: Mapping[str, Mapping[str, Any]]) -> nn.Sequential:
    """Modules of `kornia.augmentation` by name, with their arguments, in order; in every frame unless ``p`` says so.

    Raises:
        ConfigError: there is no such module, it needs colour, or it does not take these arguments.
    """
    from kornia import augmentation

    known = [name for name in dir(augmentation) if name.startswith("Random") and not name.endswith("3D")]
    modules = []
    for name, arguments in wanted.items():
        if name not in known:
            raise ConfigError(f"faults.{name}: kornia.augmentation has no such module; {suggest(name, known)}")
        # files know lists alone, kornia wants tuples
        given = {key: tuple(value) if isinstance(value, list) else value for key, value in arguments.items()}
        try:
            module = getattr(augmentation, name)(**{"p": 1.0, **given})
            with torch.random.fork_rng([]):
                same = module(torch.zeros(1, 1, 32, 32)).shape == (1, 1, 32, 32)
        except Exception as error:  # kornia's checks have many types
            raise ConfigError(f"faults.{name}: {' '.join(str(error).split())}; see its documentation") from None
        if not same:
            raise ConfigError(f"faults.{name}: changes the shape of a frame; leave it out")
        modules.append(module)
    return nn.Sequential(*modules)

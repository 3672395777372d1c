"""Texture of the paper: a reflectance that is not even, fixed to the print."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry.rows import Rows, shared
from torchpose.sim.fields import smooth_field
from torchpose.sim.sensor import coarse_rays, enlarged

_TILE = 512  # nodes of the texture, which then repeats itself
_NODES = 4  # of them in the correlation length: bicubic interpolation keeps the variance to 1 %


@dataclass(frozen=True, eq=False)
class Texture(Rows):
    """A gain of the plate and of what is printed on it, with a Gaussian distribution.

    It is applied to the blurred picture, so ``share`` and ``length`` are those that the frame shows, and a texture
    finer than a pixel is white in it. It repeats itself after 128 lengths.

    Attributes:
        key: of every frame's texture; prints of the same key have the same one.
        share: standard deviation of the reflectance, of its mean.
        length: mm, the distance at which the autocorrelation exp(-(d / length)^2) has fallen to 1/e.
    """

    key: Int[Tensor, " B"]
    share: float = shared()
    length: float = shared()

    def __post_init__(self) -> None:
        if not (self.share >= 0 and self.length > 0):
            raise ConfigError("texture: needs a share of 0 or more and a length in mm above 0")

    def gain(
        self,
        camera: Camera,
        R: Float[Tensor, "B 3 3"],
        t: Float[Tensor, "B 3"],
        plate: tuple[float, float] | None,
    ) -> Float[Tensor, "B H W"]:
        """Gain of every pixel, 1 where the plate of a size in mm is not."""
        keys, which = self.key.unique(return_inverse=True)
        x = enlarged(_on_plane(camera, R, t).flatten(0, 1), camera).view(len(t), 2, camera.height, camera.width)
        place = torch.remainder(x * (_NODES / self.length), _TILE).movedim(1, -1)
        # circular to the left and right; nodes lie at the corners that align
        span = _TILE + 4
        grid = (place + 2) * (2 / (span - 1)) - 1
        tile = torch.nn.functional.pad(_tiles(tuple(keys.tolist()))[which, None].to(x), (2, 2, 2, 2), mode="circular")
        field = torch.nn.functional.grid_sample(tile, grid, mode="bicubic", align_corners=True)[:, 0]
        gain = 1 + self.share * field
        if plate is None:
            return gain
        half = x.new_tensor(plate)[:, None, None] / 2
        return torch.where((x.abs() <= half).all(1), gain, 1.0)


@lru_cache(maxsize=4)
def _tiles(keys: tuple[int, ...]) -> Float[Tensor, "K n n"]:
    return smooth_field(torch.tensor(keys), (_TILE, _TILE), float(_NODES))


def _on_plane(camera: Camera, R: Tensor, t: Tensor) -> Tensor:
    """(B, 2, h, w) float32 mm, where the rays of a coarse grid of pixels meet the plane z = 0 of the target."""
    ray = coarse_rays(camera, t)
    normal = R[:, None, None, :, 2]
    depth = (t[:, None, None] * normal).sum(-1) / (ray * normal).sum(-1)
    x = (depth[..., None] * ray - t[:, None, None]) @ R[:, None, :, :2]
    return x.movedim(-1, 1).float()

"""What a refinement looks at, and what it returns."""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.rows import Rows, shared
from torchpose.target import Target

LEAST_KEPT = 0.5  # of the pixels around the edges that must follow the model for a refinement to count


@dataclass(frozen=True, eq=False)
class Sight(Rows):
    """N rows of M markers seen in frames, and where.

    Attributes:
        frame: frame of each row.
        mask: markers seen; what the others hold does not matter.
        rings: fitted ellipses in raw pixels, outer and inner.
        polarity: +1 dark ring on light, -1 light on dark.
        centers: of the markers, target frame, mm.
        normals: the same.
        radii: outer and inner, mm.
        frames: grey values, any real dtype.
        camera: with distortion.
    """

    frame: Int[Tensor, " N"]
    mask: Bool[Tensor, "N M"]
    rings: Float[Tensor, "N M 2 5"]
    polarity: Float[Tensor, "N M"]
    centers: Float[Tensor, "N M 3"]
    normals: Float[Tensor, "N M 3"]
    radii: Float[Tensor, "N M 2"]
    frames: Shaped[Tensor, "B H W"] = shared()
    camera: Camera = shared()

    @classmethod
    def of(cls, frames: Tensor, camera: Camera, target: Target, frame: Tensor, rings: Tensor) -> Self:
        """Rows of one target, all markers seen: frame (N,) of each, fitted ellipses (N, M, 2, 5) in raw pixels."""
        rows = (len(frame), len(target))
        centers, normals, radii = (x.expand(rows[0], *x.shape) for x in (target.centers, target.normals, target.radii))
        polarity = rings.new_full(rows, 1.0 if target.background == "light" else -1.0)
        mask = torch.ones(rows, dtype=torch.bool, device=rings.device)
        return cls(frame, mask, rings, polarity, centers, normals, radii, frames, camera)


@dataclass(frozen=True, eq=False)
class Refined(Rows):
    """Refined poses of N rows.

    Attributes:
        R: target to camera.
        t: mm.
        covariance: as in `results.Poses`.
        blur: px, standard deviation of the point-spread function with the pixel.
        noise: standard deviation of the residuals kept: grey levels (photometric), px (edges).
        kept: share of the pixels, or edge points, kept.
        good: where False the refinement failed and the other fields mean nothing.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    blur: Float[Tensor, " N"]
    noise: Float[Tensor, " N"]
    kept: Float[Tensor, " N"]
    good: Bool[Tensor, " N"]

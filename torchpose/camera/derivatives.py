"""How pixels move with the intrinsics of their camera."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera.model import Camera


def by_intrinsics(camera: Camera, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 n"]:
    """d(u, v) / d(fx, fy, cx, cy, distortion) at normalised coordinates."""
    focal, center = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    bent = (camera.distort(xy) - center) / focal
    eye = torch.eye(2, dtype=xy.dtype, device=xy.device).expand(*xy.shape, 2)
    return torch.cat([torch.diag_embed(bent), eye, focal[:, None] * _by_distortion(camera, xy)], -1)


def _by_distortion(camera: Camera, xy: Tensor) -> Tensor:
    """Derivatives (..., 2, n) of the distorted normalised coordinates by the coefficients, in their order."""
    d, r2 = camera.distortion, xy.square().sum(-1, keepdim=True)
    if camera.model == "kannala_brandt":
        r = r2.sqrt().clamp_min(1e-12)
        odd = torch.atan(r) ** torch.arange(3, 11, 2, device=r.device) / r
        return xy[..., None] * odd[..., None, :]
    powers = r2 ** torch.arange(1, 4, device=r2.device)
    denominator = 1 + powers @ d[5:8] if len(d) == 8 else torch.ones_like(r2[..., 0])
    radial = xy[..., None] * (powers / denominator[..., None])[..., None, :]
    cross, (along, down) = 2 * xy.prod(-1), (2 * xy.square() + r2).unbind(-1)
    tangential = torch.stack([cross, along, down, cross], -1).unflatten(-1, (2, 2))
    columns = [radial[..., :2], tangential, radial[..., 2:]]
    if len(d) == 8:
        columns.append(-radial * ((1 + powers @ d[[0, 1, 4]]) / denominator)[..., None, None])
    return torch.cat(columns, -1)[..., : len(d)]

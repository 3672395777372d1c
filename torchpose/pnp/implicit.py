"""Gradients of a minimum by the implicit function theorem, whatever way led to it.

At the minimum of cost(x, p) over the pose x, dx/dp = -H^-1 d(grad_x cost)/dp with the exact Hessian H. One Newton step
with H held fixed has this gradient and, at the minimum, the value zero.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations


def attach_gradient(
    r: Tensor,
    t: Tensor,
    object_points: Tensor,
    image_points: Tensor,
    camera: Camera | Tensor,
    information: Tensor,
    huber: float,
) -> tuple[Tensor, Tensor]:
    """R (B, 3, 3) and t (B, 3) with gradients towards points, pixels and camera.

    Args:
        r, t: minima of the reprojection cost.
        object_points: (N, 3) or (B, N, 3). image_points: (B, N, 2) px.
        camera: `Camera`, or pinhole matrices (3, 3) or (B, 3, 3).
        information: (B, N, 2, 2) 1/px^2, zero for points not seen.
        huber: as in `solve`.
    """
    step = torch.zeros(len(r), 6, dtype=r.dtype, device=r.device, requires_grad=True)
    with torch.enable_grad():
        # X_cam of the moved pose, the rotation to second order: the Hessian needs no more
        turned = object_points @ r.mT
        w = step[:, None, 3:].expand_as(turned)
        once = torch.linalg.cross(w, turned)
        moved = turned + once + 0.5 * torch.linalg.cross(w, once) + (t + step[:, :3])[:, None]
        xy = moved[..., :2] / moved[..., 2:]
        if isinstance(camera, Camera):
            projected = camera.distort(xy)
        else:
            matrix = camera if camera.ndim == 2 else camera[:, None]
            projected = (matrix[..., :2, :2] @ xy[..., None]).squeeze(-1) + matrix[..., :2, 2]
        residual = (projected - image_points)[..., None]
        square = (residual.mT @ information @ residual).flatten(1)
        if huber != float("inf"):
            outside = square > huber**2
            length = torch.where(outside, square, 1).sqrt()
            square = torch.where(outside, huber * (2 * length - huber), square)
        gradient = torch.autograd.grad(square.sum(), step, create_graph=True)[0]
        rows = [torch.autograd.grad(gradient[:, k].sum(), step, retain_graph=True)[0] for k in range(6)]
        newton = -torch.linalg.solve(torch.stack(rows, 1).detach(), gradient)
        newton = newton - newton.detach()
        return rotations.exp(newton[:, 3:]) @ r, t + newton[:, :3]

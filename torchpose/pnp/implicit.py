"""Gradients of a minimum by the implicit function theorem, whatever way led to it.

At the minimum of cost(x, p) over the pose x, dx/dp = -H^-1 d(grad_x cost)/dp with the exact Hessian H. One Newton step
with H held fixed has this gradient and, at the minimum, the value zero.
"""

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.pnp.normal_equations import robust
from torchpose.pnp.problem import Inputs
from torchpose.pnp.result import PnPCode, PnPResult


def attach_gradient(result: PnPResult, inputs: Inputs) -> PnPResult:
    """The result with R and t as differentiable functions of points, pixels and camera, where there is a pose."""
    count = inputs.pixels.shape[1]
    good = (result.code <= PnPCode.AMBIGUOUS).nonzero().squeeze(1)
    part = inputs.rows(good)
    root = part.whitening()
    if root.ndim == 3:
        root = root * torch.eye(2, dtype=root.dtype, device=root.device)[..., None, None]
    root = root.expand(2, 2, count, len(good)).permute(3, 2, 0, 1)
    if (keep := part.keep()) is not None:
        seen = keep.T[..., None]
        part = replace(part, pixels=torch.where(seen, part.pixels, 0.0), points=torch.where(seen, part.points, 0.0))
    r, t = _minimum(result.R[good], result.t[good], part, root.mT @ root)
    return replace(result, R=result.R.index_copy(0, good, r), t=result.t.index_copy(0, good, t))


def _minimum(r: Tensor, t: Tensor, inputs: Inputs, information: Tensor) -> tuple[Tensor, Tensor]:
    """Minima R (B, 3, 3), t (B, 3) with gradients; information (B, N, 2, 2) 1/px^2, zero for points not seen."""
    camera = inputs.camera
    step = torch.zeros(len(r), 6, dtype=r.dtype, device=r.device, requires_grad=True)
    with torch.enable_grad():
        # X_cam of the moved pose, the rotation to second order: the Hessian needs no more
        turned = inputs.points @ r.mT
        w = step[:, None, 3:].expand_as(turned)
        once = torch.linalg.cross(w, turned)
        moved = turned + once + 0.5 * torch.linalg.cross(w, once) + (t + step[:, :3])[:, None]
        xy = moved[..., :2] / moved[..., 2:]
        if isinstance(camera, Camera):
            projected = camera.distort(xy)
        else:
            matrix = camera if camera.ndim == 2 else camera[:, None]
            projected = (matrix[..., :2, :2] @ xy[..., None]).squeeze(-1) + matrix[..., :2, 2]
        residual = (projected - inputs.pixels)[..., None]
        square = (residual.mT @ information @ residual).flatten(1)
        if inputs.huber is not None:
            square, _ = robust(square, inputs.huber)
        gradient = torch.autograd.grad(square.sum(), step, create_graph=True)[0]
        rows = [torch.autograd.grad(gradient[:, k].sum(), step, retain_graph=True)[0] for k in range(6)]
        newton = -torch.linalg.solve(torch.stack(rows, 1).detach(), gradient)
        newton = newton - newton.detach()
        return rotations.exp(newton[:, 3:]) @ r, t + newton[:, :3]

"""Cramer-Rao bound of the target pose: no unbiased estimator from the grey values has a smaller covariance."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.sim import boundary, renderer
from torchpose.sim.sensor import GREY_MAX
from torchpose.sim.shapes import rings
from torchpose.target import Target

_CHUNK_POSES = 16  # poses differentiated at a time


@dataclass(frozen=True, eq=False)
class Conditions:
    """Of B frames, numbers or (B,): Gaussian blur in px, grey levels of 0..255 and their white noise, bits of the
    sensor, whose step is 255 / (2^bits - 1) grey levels.
    """

    psf_sigma: float | Tensor = 0.7
    dark: float | Tensor = 30.0
    light: float | Tensor = 220.0
    noise_sigma: float | Tensor = 1.0
    bits: int = 8


@torch.enable_grad()
def pose_crlb(camera: Camera, target: Target, R: Tensor, t: Tensor, **conditions: Any) -> Float[Tensor, "B 6 6"]:
    """Lower bound of the pose covariance from frames of `torchpose.sim.render` with white Gaussian noise.

    Inverse Fisher information of the grey values (Kay 1993, section 3.9), of all pixels of every marker's bounding box
    and of a margin as wide as the blur reaches; derivatives by forward-mode differentiation of the renderer. Unknown
    besides the pose: one blur per frame, a dark and a light level per marker. The camera is exact. Quantisation counts
    as noise of step^2 / 12, which holds from a noise of about half a step upwards; clipping is not modelled.

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        conditions: fields of `Conditions`: ``psf_sigma``, ``dark``, ``light``, ``noise_sigma``, ``bits``.

    Returns:
        float64, mm and rad: translation, then rotation w with R_true = exp(w) R. NaN where the markers in view do not
        determine the pose.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0. FrameError: shapes of R and t disagree.
    """
    R, t = renderer.check_poses(R, t)
    given = Conditions(**conditions)
    sigma = renderer.check_blur(given.psf_sigma, t)
    dark, light, noise = (renderer.per_frame(level, t) for level in (given.dark, given.light, given.noise_sigma))
    step = GREY_MAX / (2**given.bits - 1)
    parts = zip(*(x.split(_CHUNK_POSES) for x in (R, t, sigma, light - dark)), strict=True)
    information = torch.cat([_fisher(camera, target, *part) for part in parts]) if len(t) else t.new_zeros(0, 7, 7)
    inverse, known = scaled_inverse(information / (noise.square() + step * step / 12)[:, None, None])
    return torch.where(known[:, None, None], inverse, torch.nan)[:, :6, :6]


def _fisher(camera: Camera, target: Target, R: Tensor, t: Tensor, sigma: Tensor, contrast: Tensor) -> Tensor:
    """Fisher information (B, 7, 7) of translation, rotation and blur at unit noise, grey levels eliminated."""
    marks = rings(target).to(t).in_frames(torch.arange(t.shape[0], device=t.device))
    edges = boundary.sample_boundary(camera, marks, R, t, sigma)
    # windows of one size, its corner at a whole pixel, for every marker in view
    pair, window = edges.shape.unique(return_inverse=True)
    if len(pair) == 0:
        return t.new_zeros(t.shape[0], 7, 7)
    frame = marks.frame[pair]
    pixel = boundary.project(camera, edges, R, t)[0]
    index = window[:, None].expand_as(pixel)
    low = torch.zeros_like(pixel[: len(pair)]).scatter_reduce(0, index, pixel, "amin", include_self=False)
    high = torch.zeros_like(low).scatter_reduce(0, index, pixel, "amax", include_self=False)
    margin = (0.5 + boundary.REACH * sigma[frame, None]).ceil()
    low, high = low.floor() - margin, high.ceil() + margin
    size = (high - low).amax(0).long() + 1
    width, height = size.tolist()
    boxes = boundary.Boxes(low.long(), size.expand(len(pair), 2))

    def coverage(delta: Tensor) -> tuple[Tensor, Tensor]:
        rotation, translation, blur = rotations.exp(delta[3:6]) @ R, t + delta[:3], sigma + delta[6]
        position, dv = boundary.project(camera, edges, rotation, translation)
        rows = boundary.fill(position, dv, blur[edges.frame], window, boxes)
        covered = rows.view(len(pair), height, width + 1)[..., :width]
        return covered, covered

    jacobian, c = torch.func.jacfwd(coverage, has_aux=True)(t.new_zeros(7))  # (P, h, w, 7), (P, h, w)

    u = low[:, :1] + torch.arange(width, dtype=t.dtype, device=t.device)
    v = low[:, 1:] + torch.arange(height, dtype=t.dtype, device=t.device)
    use_u = (u >= 0) & (u < camera.width) & (u <= high[:, :1])
    use_v = (v >= 0) & (v < camera.height) & (v <= high[:, 1:])
    use = (use_v[:, :, None] & use_u[:, None]).flatten(1).to(t)
    c = c.flatten(1)
    jacobian = (contrast[frame, None, None] * jacobian.flatten(1, 2)) * use[:, :, None]
    # levels: grey = dark c + light (1 - c) for rings darker than their ground, and the same two columns otherwise
    levels = torch.stack([c, 1 - c], -1) * use[:, :, None]
    cross = levels.mT @ jacobian
    fisher = jacobian.mT @ jacobian - cross.mT @ torch.linalg.solve(levels.mT @ levels, cross)
    return t.new_zeros(t.shape[0], 7, 7).index_add(0, frame, fisher)

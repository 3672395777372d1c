"""Cramer-Rao bound of the target pose: no unbiased estimator from the grey values has a smaller covariance."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera, CameraRig
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.moments.views import motion_in_view, motion_of_place
from torchpose.sim import boundary, renderer
from torchpose.sim.blur import Blur, Pair, blur_of, blurred, start
from torchpose.sim.boundary import Boxes
from torchpose.sim.sensor import GREY_MAX
from torchpose.sim.shapes import rings
from torchpose.target import Target

_CHUNK_POSES = 16  # poses differentiated at a time
_UNKNOWN = 9  # translation, rotation, the blur's S11, S12 and S22

# derivatives by u and v and their factors: those of a blurred picture by the blur's S11, S12 and S22
_HEAT = (((2, 0), 0.5), ((1, 1), 1.0), ((0, 2), 0.5))

_REACH = 3.5  # standard deviations of the blur, of an edge's part in the information (tests/analysis/test_crlb.py)


@dataclass(frozen=True, eq=False)
class Conditions:
    """Of B frames, numbers or (B,): blur in px, grey levels of 0..255 and their white noise, bits of the sensor, whose
    step is 255 / (2^bits - 1) grey levels. ``psf_sigma`` (a covariance too), ``smear`` and ``disc`` as in
    `torchpose.sim.Imaging`.
    """

    psf_sigma: float | Tensor = 0.7
    smear: Pair | None = None
    disc: float | Tensor = 0.0
    dark: float | Tensor = 30.0
    light: float | Tensor = 220.0
    noise_sigma: float | Tensor = 1.0
    bits: int = 8


@checked
@torch.no_grad()
def pose_crlb(camera: Camera, target: Target, R: Tensor, t: Tensor, **conditions: Any) -> Float[Tensor, "B 6 6"]:
    """Lower bound of the pose covariance from frames of `torchpose.sim.render` with white Gaussian noise.

    Inverse Fisher information of the grey values (Kay 1993, section 3.9), of all pixels of every marker's bounding box
    and of a margin as wide as the blur reaches; derivatives by the pose are integrals along the rings' edges
    (`torchpose.sim.boundary.fill_moved`), those by the blur follow from the heat equation. The camera is exact.
    Quantisation counts as noise of step^2 / 12, which holds from a noise of about half a step upwards; clipping is not
    modelled.

    Unknown besides the pose: the three numbers of the blur's covariance per frame, a dark and a light level per marker.
    Of smear and disc only the shape is known: whatever changes the covariance, theirs or the Gaussian's, changes the
    picture alike. Three numbers instead of one raise the deviations of quad40 under round blur of 0.7 px by at most
    0.007 % at 140 to 200 mm and 0.04 % where its rings have radii of 12 px (tests/analysis/test_crlb.py).

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        conditions: fields of `Conditions`: ``psf_sigma``, ``smear``, ``disc``, ``dark``, ``light``, ``noise_sigma``,
            ``bits``.

    Returns:
        float64, mm and rad: translation, then rotation w with R_true = exp(w) R. NaN where the markers in view do not
        determine the pose.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0 or no covariance, ``disc`` is below 0. FrameError: shapes disagree.
    """
    R, t = renderer.check_poses(R, t)
    given = Conditions(**conditions)
    blur = blur_of(given.psf_sigma, given.smear, given.disc, t)
    dark, light, noise = (renderer.per_frame(level, t) for level in (given.dark, given.light, given.noise_sigma))
    step = GREY_MAX / (2**given.bits - 1)
    parts = (slice(first, first + _CHUNK_POSES) for first in range(0, len(t), _CHUNK_POSES))
    information = torch.cat(
        [t.new_zeros(0, _UNKNOWN, _UNKNOWN)]
        + [_fisher(camera, target, R[part], t[part], blur[part], (light - dark)[part]) for part in parts]
    )
    inverse, known = scaled_inverse(information / (noise.square() + step * step / 12)[:, None, None])
    return torch.where(known[:, None, None], inverse, torch.nan)[:, :6, :6]


@checked
def rig_crlb(rig: CameraRig, target: Target, R: Tensor, t: Tensor, **conditions: Any) -> Float[Tensor, "B 6 6"]:
    """`pose_crlb` from the frames that all cameras of a rig take at one time; poses in the first camera.

    What the cameras' places leave open counts as further unknowns with the prior that the rig states. A camera in whose
    frame nothing of the target is contributes nothing.
    """
    size = rig.factor().shape[-1]
    information = torch.zeros(len(t), 6 + size, 6 + size, dtype=torch.float64, device=t.device)
    for number, camera in enumerate(rig.cameras):
        own_R, own_t = rig.seen_by(number, R, t)
        own = pose_crlb(camera, target, own_R, own_t, **conditions)
        there = own.isfinite().flatten(1).all(1)
        fisher, known = scaled_inverse(torch.where(there[:, None, None], own, torch.eye(6).to(own)))
        fisher = torch.where((there & known)[:, None, None], fisher, 0.0)
        turn = motion_in_view(rig, number).to(own).expand(len(own), -1, -1)
        columns = torch.cat([turn, motion_of_place(rig, number, own_t)], -1)
        information = information + columns.mT @ fisher @ columns
    information.diagonal(dim1=-2, dim2=-1)[:, 6 : 6 + size] += 1
    inverse, known = scaled_inverse(information)
    return torch.where(known[:, None, None], inverse, torch.nan)[:, :6, :6]


def _fisher(camera: Camera, target: Target, R: Tensor, t: Tensor, blur: Blur, contrast: Tensor) -> Tensor:
    """Fisher information (B, 9, 9) of translation, rotation and blur at unit noise, grey levels eliminated."""
    marks = rings(target).to(t).in_frames(torch.arange(t.shape[0], device=t.device))
    edges = boundary.sample_boundary(camera, marks, R, t, blur.finest, (blur.reach + blur.disc)[marks.frame])
    pair, window = edges.shape.unique(return_inverse=True)
    if len(pair) == 0:
        return t.new_zeros(t.shape[0], _UNKNOWN, _UNKNOWN)
    frame = marks.frame[pair]
    edges = replace(edges, shape=window)

    pixel, dv = boundary.project(camera, edges, R, t)
    sharp = start(edges, pixel[None], dv[None], blur)
    samples = blurred(replace(sharp, swept=boundary.swept_by_pose(camera, edges, R, t)), blur, blur.disc[frame])
    # windows of one size for every marker in view, of which only its own part counts
    own = boundary.boxes_around(samples.pixel, samples.shape, (blur.margin + blur.disc)[frame], camera)
    boxes = Boxes(own.corner, own.size.amax(0).expand(len(pair), 2))
    width, height = boxes.size[0].tolist()

    def image(rows: Tensor) -> Tensor:
        return rows.view(len(pair), height, width + 1, -1)[:, :, :width].flatten(1, 2)

    # what single precision and the tails cost is no digit of a bound; the sums over pixels are in double
    samples = samples.to(torch.float32)
    c = image(boundary.fill(samples, boxes, reach=_REACH))[..., 0].to(t)
    # by the pose, and by S11, S12 and S22 after the heat equation
    by_blur = [scale * image(boundary.fill(samples, boxes, by, reach=_REACH)) for by, scale in _HEAT]
    by_pose = image(boundary.fill_moved(samples, boxes, reach=_REACH))
    jacobian = torch.cat([by_pose, *by_blur], -1).to(t)  # (P, h w, 9)
    row, column = (torch.arange(n, device=t.device) for n in (height, width))
    use = (row[:, None] < own.size[:, 1, None, None]) & (column < own.size[:, 0, None, None])
    use = use.flatten(1).to(t)
    jacobian = jacobian * (contrast[frame, None] * use)[..., None]
    # levels: grey = dark c + light (1 - c) for rings darker than their ground, and the same two columns otherwise
    levels = torch.stack([c, 1 - c], -1) * use[..., None]
    cross = levels.mT @ jacobian
    known, determined = scaled_inverse(levels.mT @ levels)
    fisher = jacobian.mT @ jacobian - cross.mT @ known @ cross
    # of a marker that hardly reaches into the frame nothing is known
    fisher = torch.where(determined[:, None, None], fisher, 0.0)
    return t.new_zeros(t.shape[0], _UNKNOWN, _UNKNOWN).index_add(0, frame, fisher)

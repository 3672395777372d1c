"""Predicted pose covariance: of straight edges in closed form, and as the estimator itself states it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import ellipse
from torchpose.analysis.joint import POSE, grown, joint_inverse, marker_columns
from torchpose.analysis.sensitivity import ring_edges
from torchpose.camera import Camera, CameraRig
from torchpose.design.view import RIM_POINTS, rims, rings_that_count
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.geometry.projection import by_pose
from torchpose.identify import MIN_MARKERS, MarkerTable
from torchpose.moments.joint import Seen, joint_pose
from torchpose.moments.views import motion_in_view, motion_of_place
from torchpose.pose import PLACE, Evidence, Setting, on_print
from torchpose.refine import Sight, refine_photometric
from torchpose.sim import Defocus, add_noise, render
from torchpose.target import Target

_MARGIN_PX = 16  # around the rings, for blur and the band of the refinement
_PIXEL_VARIANCE = 1 / 12  # px^2, of the pixel's own width
_QUANTISATION = 1 / 12  # grey levels^2


@dataclass(frozen=True)
class Imaging:
    """Conditions of the frames.

    Attributes:
        psf_sigma: blur of the lens in focus, px, Gaussian.
        noise: grey levels of 0..255, Gaussian and white.
        dark: grey level of the print.
        light: grey level of the paper.
        lens: for the blur out of focus; None: sharp everywhere.

    Raises:
        ConfigError: a number is out of range.
    """

    psf_sigma: float = 0.7
    noise: float = 2.0
    dark: float = 30.0
    light: float = 220.0
    lens: Defocus | None = None

    def __post_init__(self) -> None:
        if not 0 < self.psf_sigma <= 4:
            raise ConfigError(f"blur: {self.psf_sigma:g} px; give a standard deviation above 0 and up to 4 px")
        if not 0 <= self.noise <= 64:
            raise ConfigError(f"noise: {self.noise:g} grey levels; give a standard deviation of 0 to 64")
        if not 0 <= self.dark < self.light <= 255:
            raise ConfigError(f"levels: {self.dark:g} {self.light:g}; give dark and light, 0 <= dark < light <= 255")

    def blur(self, camera: Camera, depth: Tensor) -> Tensor:
        """Standard deviation (...) in px at depths (...) in mm; a disc has the variance radius^2 / 4 along any axis."""
        rho = torch.zeros_like(depth) if self.lens is None else self.lens.radius(camera, depth)
        return (self.psf_sigma**2 + rho.square() / 4).sqrt()

    def of_camera(self, rig: CameraRig, number: int) -> Self:
        """Those of one camera of a rig: each is focused on the point of the first one's axis on which that one is."""
        if self.lens is None or number == 0:
            return self
        focus = float(rig.R[number, 2, 2] * self.lens.focus_distance + rig.t[number, 2])
        # one that has this point behind it has the target there, too
        return self if focus <= 0 else replace(self, lens=replace(self.lens, focus_distance=focus))

    def blur_at(self, camera: Camera, depths: Sequence[float]) -> list[float]:
        """`blur` at numbers."""
        return self.blur(camera, camera.matrix.new_tensor(depths)).tolist()


@checked
def best_focus(near: float, far: float) -> float:
    """Distance in mm to focus on, so that both ends of a range have the same disc of defocus: 2 / (1/near + 1/far)."""
    return 2 / (1 / near + 1 / far)


@checked
def sharp_range(camera: Camera, lens: Defocus, psf_sigma: float) -> tuple[float, float]:
    """Depths in mm between which defocus adds less blur than the lens has in focus: a disc of up to 2 psf_sigma px.

    |1/z - 1/z_focus| < 2 rho / (fx A) for a disc of radius rho px and the aperture A = focal length / f-number. At the
    limits the whole blur is sqrt(2) psf_sigma. The far one may be infinite.
    """
    reach = 4 * psf_sigma / (float(camera.matrix[0, 0]) * lens.focal_length / lens.f_number)
    focus = 1 / lens.focus_distance
    return 1 / (focus + reach), 1 / (focus - reach) if focus > reach else math.inf


@checked
def edge_covariance(
    camera: Camera | CameraRig, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> Float[Tensor, "B 6 6"]:
    """Covariance of the pose from the position of every bit of edge along its normal, grey levels and blur known.

    A straight blurred edge of contrast h and length L px fixes its offset with the information
    h^2 L / (2 sqrt(pi) s n^2), s and n the standard deviations of blur and noise (integral of the squared derivative
    of the normal law). What the target states of its print counts as further unknowns. The same as
    `torchpose.analysis.sensitivity.propagate` gives for the image's noise and the target on "rings", but with no
    derivative besides those by the pose and the edge gain, for searches.

    Args:
        camera: or several, whose places count as further unknowns with the covariance that the rig states, and which
            all see the target at one time. Of the first all rings count, of the others `rings_that_count`.
        R: (B, 3, 3), target to (first) camera.
        t: (B, 3), the same, mm.

    Returns:
        float64, mm and rad, translation first, rotation multiplied from the left.
    """
    rig = CameraRig.of(camera)
    target = _target_of(rig, target)
    told = [_edges_told(rig, number, target, R, t, imaging) for number in range(len(rig))]
    information, columns = (torch.cat(parts, 1) for parts in zip(*told, strict=True))
    inverse, known = joint_inverse(information, columns)
    return torch.where(known[:, None, None], inverse[:, :POSE, :POSE], torch.nan)


def _target_of(rig: CameraRig, target: Target) -> Target:
    """The target, of which no camera of several knows more than another by a calibration that both are from."""
    return target if len(rig) == 1 else replace(target, adjustment=None, cross_covariance=None)


def _edges_told(
    rig: CameraRig, number: int, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> tuple[Float[Tensor, "B M 7 7"], Float[Tensor, "B M 7 k"]]:
    """`marker_information` of one camera of several, and how its markers move with pose, cameras' places and print."""
    camera, (own_R, own_t) = rig.cameras[number], rig.seen_by(number, R, t)
    information = marker_information(camera, target, own_R, own_t, imaging.of_camera(rig, number))
    if number:
        counts = rings_that_count(camera, target, own_R, own_t)
        information = torch.where(counts[..., None, None], information, 0.0)
    columns = marker_columns(target, camera, own_R)
    turn = motion_in_view(rig, number).to(t).expand(len(t), -1, -1)
    moved = torch.cat([turn, motion_of_place(rig, number, own_t)], -1)[:, None]
    return information, torch.cat([columns[..., :POSE] @ moved, columns[..., POSE:]], -1)


def marker_information(
    camera: Camera, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> Float[Tensor, "B M 7 7"]:
    """What the edges of every marker tell of a pose of its own and of the edge gain.

    Arguments as of `edge_covariance`.
    """
    edge = ring_edges(camera, target, R, t, RIM_POINTS)
    jacobian = torch.cat([by_pose(edge.by_point, edge.arm), edge.by_radii @ grown(target)[:, None]], -1)
    blur = (imaging.blur(camera, edge.depth).square() + _PIXEL_VARIANCE).sqrt()
    weight = (imaging.light - imaging.dark) ** 2 / (2 * math.sqrt(math.pi) * (imaging.noise**2 + _QUANTISATION)) / blur
    weighted = weight[..., None, None] * (edge.information @ jacobian)
    return jacobian.flatten(2, 3).mT @ weighted.flatten(2, 3)


@checked
def predicted_covariance(
    camera: Camera | CameraRig, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> Float[Tensor, "B 6 6"]:
    """Covariance that the estimator (``method="photometric"``) states for a target at every pose.

    Simulated frames, cropped to the target, refined from the true pose: the covariance holds whatever the
    refinement leaves out or adds as unknowns, and what the files of target and camera state. The frame's noise scatters
    it by about a percent. One frame in twenty or so happens to look as if its noise were correlated, and the estimator
    then claims less: of two frames a pose the one that claims more counts.

    Arguments and result as of `edge_covariance`; NaN where the refinement fails.
    """
    rig = CameraRig.of(camera)
    target = _target_of(rig, target)
    edges = edge_covariance(rig, target, R, t, imaging) if len(rig) > 1 else t.new_zeros(len(t), POSE, POSE)
    out = []
    for i in range(len(t)):
        at, index = (R[i], t[i], edges[i]), torch.arange(i, 2 * len(rig) * len(t), len(t), device=t.device)
        seen = [_shot(rig, number, target, at, imaging, index[2 * number :][:2]) for number in range(len(rig))]
        shots = [shot for shot in seen if shot is not None]
        good = torch.stack([shot.setting.evidence.mask.any(-1) for shot in shots]).any(0)
        found = torch.where(good[:, None, None], _claimed(rig, shots, R[i], t[i]), torch.inf)
        least = found.diagonal(dim1=1, dim2=2).sum(-1).argmin()
        out.append(torch.where(good.any(), found[least], torch.nan)[None])
    return torch.cat(out) if out else t.new_zeros(0, 6, 6)


def _shot(
    rig: CameraRig, number: int, target: Target, at: tuple[Tensor, Tensor, Tensor], imaging: Imaging, index: Tensor
) -> Seen | None:
    """Two frames of one camera, cropped to the rings that count, refined from the true pose; None where none counts.

    Args:
        at: R (3, 3) and t (3,) in the first camera, and the covariance of the pose by all edges, which holds the fit of
            a camera that has too few rings.
        index: (2,), of the noise.
    """
    camera, imaging = rig.cameras[number], imaging.of_camera(rig, number)
    R, t = (part[None] for part in rig.seen_by(number, *at[:2]))
    counts = torch.ones(len(target), dtype=torch.bool, device=t.device)
    if number:
        counts = rings_that_count(camera, target, R, t)[0]
    if not bool(counts.any()):
        return None
    crop, frames, rings = _frames(camera, target, (R, t), counts, imaging, index)
    sight = Sight.of(frames, crop, target, torch.arange(2, device=t.device), rings.expand(2, -1, -1, -1))
    sight, prior, rows = replace(sight, mask=counts.expand(2, -1)), None, (R.expand(2, -1, -1), t.expand(2, -1))
    if int(counts.sum()) < MIN_MARKERS:
        turn = motion_in_view(rig, number).to(t)
        prior = torch.linalg.inv(turn @ at[2] @ turn.mT).expand(2, -1, -1)
    refined = refine_photometric(sight, *rows, prior=prior)
    # about poses of its own where a camera is alone, else about the common one
    poses = (refined.R, refined.t) if len(rig) == 1 else rows
    normals = replace(refined.normals, right=torch.zeros_like(refined.normals.right))  # residuals as the noise has them
    return Seen(number, _setting(crop, target, poses, sight.mask & refined.good[:, None]), normals, *poses)


def _frames(
    camera: Camera, target: Target, pose: tuple[Tensor, Tensor], counts: Tensor, imaging: Imaging, index: Tensor
) -> tuple[Camera, Tensor, Tensor]:
    """A camera cropped to the rings that count, its frames of a pose, one for each index, and the rings (M, 2, 5)."""
    look: dict[str, Any] = {name: getattr(imaging, name) for name in ("psf_sigma", "dark", "light")}
    look["defocus"] = imaging.lens
    R, t = pose
    circles = (rims(target) @ R[0].T + t[0]).unflatten(0, (-1, 2))[counts].flatten(0, 1)
    pixel = camera.project(circles)  # (2 K, S, 2)
    low = (pixel.flatten(0, 1).amin(0) - _MARGIN_PX).floor()
    width, height = (pixel.flatten(0, 1).amax(0) + _MARGIN_PX - low).ceil().int().tolist()
    matrix = camera.matrix.clone()
    matrix[:2, 2] -= low
    crop = replace(camera, width=width, height=height, matrix=matrix)
    levels = render(crop, target, R, t, **look)
    circle = torch.arange(len(pixel), device=t.device).repeat_interleave(pixel.shape[1])
    fitted = ellipse.fit((pixel - low).flatten(0, 1), circle, len(pixel)).view(-1, 2, 5)
    rings = fitted.new_zeros(len(target), 2, 5)
    rings[counts] = fitted
    return crop, add_noise(levels.expand(len(index), -1, -1), imaging.noise, index=index), rings


def _claimed(rig: CameraRig, shots: Sequence[Seen], R: Tensor, t: Tensor) -> Float[Tensor, "2 6 6"]:
    """Covariance of a pose, in either of its frames, with that of print and cameras."""
    first = shots[0]
    nothing = t.new_zeros(*first.setting.evidence.mask.shape, PLACE)
    if len(rig) == 1:
        return on_print(first.normals, first.setting, nothing).covariance
    return joint_pose(rig, [*shots], R.expand(2, -1, -1), t.expand(2, -1), nothing).covariance


def _setting(camera: Camera, target: Target, poses: tuple[Tensor, Tensor], mask: Tensor) -> Setting:
    """Rows of a target at poses, of which what was measured is in normal equations."""
    rows, markers = mask.shape
    table = MarkerTable.of([target], camera).to(mask.device)
    table = table[torch.zeros(rows, dtype=torch.int64, device=mask.device)]
    nothing = poses[1].new_zeros(rows, markers, 2)
    square = torch.eye(2, dtype=nothing.dtype, device=nothing.device).expand(rows, markers, 2, 2)
    ellipses, shapes = nothing.new_zeros(rows, markers, 2, 5), nothing.new_zeros(rows, markers, 2, 5, 5)
    evidence = Evidence(
        *(table.centers, table.normals, table.radii, nothing, square, ellipses, shapes, nothing[..., 0], mask),
        *(table.coplanar, table.polarity, torch.zeros_like(square), table.by_print, table.by_camera, table.scale_sigma),
        matrix=camera.matrix,
    )
    return Setting(evidence, *poses, camera, on_rims=True)


@checked
def deviations(covariance: Float[Tensor, "B 6 6"]) -> Float[Tensor, "B 6"]:
    """Standard deviations of covariances: x, y, z in um, then about x, y, z in mdeg."""
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt() * 1e3
    return torch.cat([std[:, :3], std[:, 3:].rad2deg()], 1)

"""Predicted pose covariance: of straight edges in closed form, and as the estimator itself states it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import ellipse
from torchpose.analysis.joint import POSE, grown, joint_inverse, marker_columns
from torchpose.analysis.sensitivity import around, ring_edges
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.geometry.projection import by_pose
from torchpose.identify import MarkerTable
from torchpose.pose import PLACE, Evidence, Setting, on_print
from torchpose.refine import Refined, Sight, refine_photometric
from torchpose.sim import Defocus, add_noise, render
from torchpose.target import Target

_SAMPLES = 48  # of a circle
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
def edge_covariance(camera: Camera, target: Target, R: Tensor, t: Tensor, imaging: Imaging) -> Float[Tensor, "B 6 6"]:
    """Covariance of the pose from the position of every bit of edge along its normal, grey levels and blur known.

    A straight blurred edge of contrast h and length L px fixes its offset with the information
    h^2 L / (2 sqrt(pi) s n^2), s and n the standard deviations of blur and noise (integral of the squared derivative
    of the normal law). What the target states of its print counts as further unknowns. The same as
    `torchpose.analysis.sensitivity.propagate` gives for the image's noise and the target on "rings", but with no
    derivative besides those by the pose and the edge gain, for searches.

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.

    Returns:
        float64, mm and rad, translation first, rotation multiplied from the left.
    """
    columns = marker_columns(target, camera, R)
    inverse, known = joint_inverse(marker_information(camera, target, R, t, imaging), columns)
    return torch.where(known[:, None, None], inverse[:, :POSE, :POSE], torch.nan)


def marker_information(
    camera: Camera, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> Float[Tensor, "B M 7 7"]:
    """What the edges of every marker tell of a pose of its own and of the edge gain.

    Arguments as of `edge_covariance`.
    """
    edge = ring_edges(camera, target, R, t, _SAMPLES)
    jacobian = torch.cat([by_pose(edge.by_point, edge.arm), edge.by_radii @ grown(target)[:, None]], -1)
    blur = (imaging.blur(camera, edge.depth).square() + _PIXEL_VARIANCE).sqrt()
    weight = (imaging.light - imaging.dark) ** 2 / (2 * math.sqrt(math.pi) * (imaging.noise**2 + _QUANTISATION)) / blur
    weighted = weight[..., None, None] * (edge.information @ jacobian)
    return jacobian.flatten(2, 3).mT @ weighted.flatten(2, 3)


@checked
def predicted_covariance(
    camera: Camera, target: Target, R: Tensor, t: Tensor, imaging: Imaging
) -> Float[Tensor, "B 6 6"]:
    """Covariance that the estimator (``method="photometric"``) states for a target at every pose.

    Simulated frames, cropped to the target, refined from the true pose: the covariance holds whatever the
    refinement leaves out or adds as unknowns, and what the files of target and camera state. The frame's noise scatters
    it by about a percent. One frame in twenty or so happens to look as if its noise were correlated, and the estimator
    then claims less: of two frames a pose the one that claims more counts.

    Arguments and result as of `edge_covariance`; NaN where the refinement fails.
    """
    rings, out = rims(target), []
    look: dict[str, Any] = {name: getattr(imaging, name) for name in ("psf_sigma", "dark", "light")}
    look["defocus"] = imaging.lens
    index = torch.arange(len(rings), device=t.device).repeat_interleave(_SAMPLES)
    for i in range(len(t)):
        pixel = camera.project(rings @ R[i].T + t[i])  # (2 M, S, 2)
        low = (pixel.flatten(0, 1).amin(0) - _MARGIN_PX).floor()
        width, height = (pixel.flatten(0, 1).amax(0) + _MARGIN_PX - low).ceil().int().tolist()
        matrix = camera.matrix.clone()
        matrix[:2, 2] -= low
        crop = replace(camera, width=width, height=height, matrix=matrix)
        pose = R[i : i + 1], t[i : i + 1]
        levels = render(crop, target, *pose, **look)
        twice = index.new_tensor([i, i + len(t)])
        noisy = add_noise(levels.expand(2, -1, -1), imaging.noise, index=twice)
        seen = (
            ellipse.fit((pixel - low).flatten(0, 1), index, len(pixel)).view(1, len(target), 2, 5).expand(2, -1, -1, -1)
        )
        refined = refine_photometric(
            Sight.of(noisy, crop, target, torch.arange(2, device=index.device), seen),
            *(part.repeat(2, *[1] * (part.ndim - 1)) for part in pose),
        )
        found = torch.where(refined.good[:, None, None], _stated(refined, crop, target), torch.inf)
        least = found.diagonal(dim1=1, dim2=2).sum(-1).argmin()
        out.append(torch.where(refined.good.any(), found[least], torch.nan)[None])
    return torch.cat(out) if out else t.new_zeros(0, 6, 6)


def _stated(refined: Refined, camera: Camera, target: Target) -> Float[Tensor, "B 6 6"]:
    """Covariance of refined poses with that of print and camera, all markers seen, residuals as the noise has them."""
    rows, markers = len(refined), len(target)
    table = MarkerTable.of([target], camera).to(refined.t.device)
    table = table[torch.zeros(rows, dtype=torch.int64, device=refined.t.device)]
    nothing = refined.t.new_zeros(rows, markers, 2)
    square = torch.eye(2, dtype=nothing.dtype, device=nothing.device).expand(rows, markers, 2, 2)
    ellipses, shapes = nothing.new_zeros(rows, markers, 2, 5), nothing.new_zeros(rows, markers, 2, 5, 5)
    evidence = Evidence(
        *(table.centers, table.normals, table.radii, nothing, square, ellipses, shapes, nothing[..., 0], table.valid),
        *(table.coplanar, table.polarity, torch.zeros_like(square), table.by_print, table.by_camera, table.scale_sigma),
        matrix=camera.matrix,
    )  # what was measured is in the normal equations
    normals = replace(refined.normals, right=torch.zeros_like(refined.normals.right))
    setting = Setting(evidence, refined.R, refined.t, camera, on_rims=True)
    return on_print(normals, setting, nothing.new_zeros(rows, markers, PLACE)).covariance


def rims(target: Target) -> Float[Tensor, "circles samples 3"]:
    """Points on the outer and inner circle of every marker, in turn, mm."""
    circle = target.printed_radii[..., None, None] * around(target, _SAMPLES)[0][:, None]
    return (target.centers[:, None, None] + circle).flatten(0, 1)


@checked
def deviations(covariance: Float[Tensor, "B 6 6"]) -> Float[Tensor, "B 6"]:
    """Standard deviations of covariances: x, y, z in um, then about x, y, z in mdeg."""
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt() * 1e3
    return torch.cat([std[:, :3], std[:, 3:].rad2deg()], 1)


def outlines(target: Target) -> Float[Tensor, "points 3"]:
    """Points on the outer circles of a target, 12 each, mm."""
    return rims(target)[::2, :: _SAMPLES // 12].flatten(0, 1)


def in_view(camera: Camera, points: Tensor, R: Tensor, t: Tensor, margin: float) -> bool:
    """Whether points (P, 3) of the target lie ``margin`` px inside the frame at all poses (B, 3, 3), (B, 3)."""
    seen = points @ R.mT + t[:, None]
    pixel = camera.project(seen)
    last = t.new_tensor([camera.width - 1, camera.height - 1]) - margin
    inside = ((pixel >= margin) & (pixel <= last)).all()
    return bool(inside & ((seen[..., :2] / seen[..., 2:]).norm(dim=-1) < camera.fold_radius).all())

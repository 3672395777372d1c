"""Monte-Carlo of the measuring chain: what propagation says to first order, by trial."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import pnp
from torchpose.analysis.errors import Pose, pose_difference
from torchpose.analysis.joint import grown, print_numbers
from torchpose.analysis.sensitivity import Uncertainty, marker_axes, markers_seen, radius_shift
from torchpose.camera import Camera
from torchpose.geometry import least_squares, rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import covariance_factor
from torchpose.pipeline import PoseEstimator
from torchpose.sim import add_noise, render
from torchpose.target import Target

_FRAMES = 16  # estimated at a time


@dataclass(frozen=True, eq=False)
class Trials:
    """Keywords of the simulations."""

    draws: int
    seed: int = 0
    true_camera: Camera | None = None  # about which cameras are drawn, if not the nominal one: for errors of known size


@checked
def simulate_points(
    camera: Camera, target: Target, R: Tensor, t: Tensor, uncertainty: Uncertainty, **trials: Any
) -> Float[Tensor, "D B 6"]:
    """Errors of poses from marker centres: truth drawn about the nominal one, projected, solved.

    Every draw has a camera and a print of its own, which all poses share; `torchpose.pnp.solve` gets the nominal ones.
    The markers seen are those of `propagate`, in the nominal pose.

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        uncertainty: as of `propagate` with features "centers".
        trials: fields of `Trials`: ``draws``, ``seed``, ``true_camera``.

    Returns:
        estimate minus truth: translation in mm, rotation vector in rad, about the camera axes; NaN without a pose.
    """
    wanted = Trials(**trials)
    generator, draws, true = torch.Generator().manual_seed(wanted.seed), wanted.draws, wanted.true_camera or camera
    drawn = _draw(true, target, uncertainty, draws, generator)
    points = torch.einsum("bij,dmj->dbmi", R, drawn.centers) + t[:, None]
    normals = torch.einsum("bij,dmj->dbmi", R, drawn.normals)
    xy = points[..., :2] / points[..., 2:]
    radii = drawn.radii[:, None].expand(*points.shape[:-1], 2)
    xy = xy + radius_shift(points, normals, radii, target.printed_radii)
    unbent = bool((drawn.distortion == true.distortion).all())
    bent = [true] if unbent else [replace(true, distortion=row) for row in drawn.distortion]
    pixels = torch.cat([one.distort(part) for one, part in zip(bent, xy.chunk(len(bent)), strict=True)])
    nominal = true.matrix.to(t)
    ideal = (pixels - nominal[:2, 2]) / nominal.diagonal()[:2]
    pixels = ideal * drawn.focal[:, None, None] + drawn.center[:, None, None]
    noise = torch.randn(pixels.shape, generator=generator, dtype=t.dtype, device=generator.device).to(t)
    exact, mask = replace(camera, covariance=None), markers_seen(camera, target, R, t).repeat(draws, 1)
    if isinstance(uncertainty.image, Tensor):
        spread = uncertainty.image.to(t).expand(*points.shape[:-1], 2, 2)
        pixels = pixels + (torch.linalg.cholesky(spread) @ noise[..., None]).squeeze(-1)
        found = pnp.solve(target.centers, pixels.flatten(0, 1), exact, covariances=spread.flatten(0, 1), mask=mask)
    else:
        pixels = pixels + uncertainty.image * noise
        sigma = uncertainty.image or 1.0  # for the solver's decisions only: equal weights give the same pose
        found = pnp.solve(target.centers, pixels.flatten(0, 1), exact, sigma_px=sigma, mask=mask)
    return _errors(found, R, t)


@checked
def simulate_frames(
    camera: Camera, target: Target, R: Tensor, t: Tensor, uncertainty: Uncertainty, **imaging: Any
) -> Float[Tensor, "D B 6"]:
    """Errors as of `simulate_points`, of frames rendered with the drawn camera and print, by `PoseEstimator`.

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        uncertainty: its ``image`` is not used: ``noise`` grey levels of every pixel and ``bits`` are.
        imaging: ``draws``, ``seed`` and ``true_camera`` as of `Trials`; ``noise`` (1), ``bits`` of the sensor (8),
            ``method`` of `PoseEstimator`; the rest is for `torchpose.sim.render`.

    Raises:
        ConfigError: a drawn print is no valid target any more: its uncertainty is too large for the target's rings.
    """
    draws, seed, true = imaging.pop("draws"), imaging.pop("seed", 0), imaging.pop("true_camera", camera)
    noise, bits, method = imaging.pop("noise", 1.0), imaging.pop("bits", 8), imaging.pop("method", "photometric")
    drawn = _draw(true, target, uncertainty, draws, torch.Generator().manual_seed(seed))
    estimator = PoseEstimator(replace(camera, covariance=None), target, method=method)
    together = max(1, _FRAMES // len(t))
    errors = []
    for chunk in torch.arange(draws, device="cpu").split(together):
        frames = [render(*drawn.scene(draw), R, t, **imaging) for draw in chunk.tolist()]
        index = int(chunk[0]) * len(t) + torch.arange(len(chunk) * len(t), device=t.device)
        errors.append(_errors(estimator(add_noise(torch.cat(frames), noise, seed, index=index, bits=bits)), R, t))
    return torch.cat(errors)


class _Draws(NamedTuple):
    """D cameras and prints, and what they were drawn about."""

    camera: Camera
    target: Target
    focal: Float[Tensor, "D 2"]
    center: Float[Tensor, "D 2"]
    distortion: Float[Tensor, "D n"]
    centers: Float[Tensor, "D M 3"]
    normals: Float[Tensor, "D M 3"]
    radii: Float[Tensor, "D M 2"]

    def scene(self, draw: int) -> tuple[Camera, Target]:
        matrix = self.camera.matrix.clone()
        matrix[[0, 1], [0, 1]], matrix[:2, 2] = self.focal[draw].to(matrix), self.center[draw].to(matrix)
        camera = replace(self.camera, matrix=matrix, distortion=self.distortion[draw], covariance=None)
        exact = replace(self.target, edge_gain=0.0, covariance=None, cross_covariance=None)
        return camera, replace(exact, centers=self.centers[draw], normals=self.normals[draw], radii=self.radii[draw])


def _draw(camera: Camera, target: Target, uncertainty: Uncertainty, draws: int, generator: torch.Generator) -> _Draws:
    centers = target.centers

    def normal(*shape: int) -> Tensor:
        numbers = torch.randn(draws, *shape, generator=generator, dtype=centers.dtype, device=generator.device)
        return numbers.to(centers)

    coefficients = len(camera.distortion)
    shift = normal(7 + coefficients)
    focal, center = camera.matrix.diagonal()[:2].expand(draws, 2), camera.matrix[:2, 2].expand(draws, 2)
    focal = focal * (1 + uncertainty.focal_length * shift[:, 4:5])
    center = center + uncertainty.principal_point * shift[:, 5:7]
    distortion = camera.distortion + centers.new_tensor(uncertainty.distortion or 0.0) * shift[:, 7:]
    by_print, by_camera = print_numbers(target, camera)
    stated = (by_print @ normal(by_print.shape[-1])[:, None, :, None]).squeeze(-1)  # (D, M, 7)
    if camera.covariance is not None:
        factor = covariance_factor(camera.covariance)
        count = factor.shape[1]
        numbers = torch.cat([shift[:, :4], normal(max(count - 4, 0))], -1)[:, :count]
        intrinsics = numbers @ factor.mT
        focal, center = focal + intrinsics[:, :2], center + intrinsics[:, 2:4]
        distortion = distortion + intrinsics[:, 4:] if len(factor) > 4 else distortion
        stated = stated + (by_camera @ numbers[:, None, :, None]).squeeze(-1)
    in_plane, along, radius = uncertainty.print_centers, uncertainty.print_flatness, uncertainty.print_radii
    off = normal(len(target), 5) * centers.new_tensor([in_plane, in_plane, along, radius, radius])
    scale = 1 + uncertainty.print_scale * normal(1, 1)
    moved = (off[..., None, :3] @ marker_axes(target)).squeeze(-2)
    radii = target.printed_radii * scale + off[..., 3:] + stated[..., 6:] * grown(target)
    normals = (rotations.exp(stated[..., 3:6]) @ target.normals[..., None]).squeeze(-1)
    printed = target.centers * scale + moved + stated[..., :3], normals, radii
    return _Draws(camera, target, focal, center, distortion, *printed)


def _errors(found: Pose, R: Tensor, t: Tensor) -> Tensor:
    """(D, B, 6) of poses (D * B)."""
    draws = len(found.t) // len(t)
    truth = least_squares.Pose(R.repeat(draws, 1, 1), t.repeat(draws, 1))
    return pose_difference(found, truth).unflatten(0, (draws, len(t)))

"""Monte-Carlo of the measuring chain: what propagation says to first order, by trial."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.analysis.sensitivity import Uncertainty, markers_seen, radius_shift
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.pipeline import Method, PoseEstimator
from torchpose.sim import add_noise, render
from torchpose.target import Target

_FRAMES = 16  # estimated at a time


def simulate_points(
    camera: Camera,
    target: Target,
    R: Tensor,
    t: Tensor,
    uncertainty: Uncertainty,
    *,
    draws: int,
    seed: int = 0,
    true_camera: Camera | None = None,
) -> Tensor:
    """Errors (D, B, 6) of poses from marker centres: truth drawn about the nominal one, projected, solved.

    Every draw has a camera and a print of its own, which all poses share; `torchpose.pnp.solve` gets the nominal ones.
    The markers seen are those of `propagate`, in the nominal pose.

    Args:
        R, t: (B, 3, 3), (B, 3) mm. uncertainty: as of `propagate` with features "centers".
        true_camera: about which the cameras are drawn, where it is not the nominal one: for errors of known size.

    Returns:
        estimate minus truth: translation in mm, rotation vector in rad, about the camera axes; NaN without a pose.
    """
    generator = torch.Generator().manual_seed(seed)
    batch, count = t.shape[0], len(target)
    cameras = _draw_cameras(true_camera or camera, uncertainty, draws, generator)
    centers, radii = _draw_prints(target, uncertainty, draws, generator)
    points = torch.einsum("bij,dmj->dbmi", R, centers) + t[:, None]
    normals = (target.normals @ R.mT).expand(draws, -1, -1, -1)
    xy = points[..., :2] / points[..., 2:]
    xy = xy + radius_shift(points, normals, radii[:, None].expand(-1, batch, -1, -1), target.radii)
    if uncertainty.distortion:
        pixels = torch.stack([c.distort(x) for c, x in zip(cameras, xy, strict=True)])
    else:
        focal = torch.stack([c.matrix.diagonal()[:2] for c in cameras])[:, None, None]
        middle = torch.stack([c.matrix[:2, 2] for c in cameras])[:, None, None]
        nominal = camera.matrix
        pixels = (camera.distort(xy) - nominal[:2, 2]) / nominal.diagonal()[:2] * focal + middle
    noise = torch.randn(draws, batch, count, 2, generator=generator, dtype=torch.float64)
    covariances = None
    if isinstance(uncertainty.image, Tensor):
        covariances = uncertainty.image.expand(draws, batch, -1, -1, -1)
        noise = (torch.linalg.cholesky(covariances) @ noise[..., None]).squeeze(-1)
        covariances = covariances.flatten(0, 1)
    else:
        noise = noise * uncertainty.image
    mask = markers_seen(camera, target, R, t).expand(draws, -1, -1)
    found = pnp.solve(
        target.centers,
        (pixels + noise).flatten(0, 1),
        replace(camera, covariance=None),
        sigma_px=_sigma(uncertainty),
        covariances=covariances,
        mask=mask.flatten(0, 1),
    )
    return _errors(found.R.unflatten(0, (draws, batch)), found.t.unflatten(0, (draws, batch)), R, t)


def simulate_frames(
    camera: Camera,
    target: Target,
    R: Tensor,
    t: Tensor,
    uncertainty: Uncertainty,
    *,
    draws: int,
    seed: int = 0,
    noise: float = 1.0,
    bits: int = 8,
    method: Method = "photometric",
    **imaging: Any,
) -> Tensor:
    """Errors (D, B, 6) as of `simulate_points`, of frames rendered with the drawn camera and print, by `PoseEstimator`.

    Args:
        uncertainty: its ``image`` is not used: ``noise`` grey levels of every pixel and ``bits`` are.
        imaging: of `torchpose.sim.render` (``psf_sigma``, ``dark``, ``light``, ``plate``).

    Raises:
        ConfigError: a drawn print is no valid target any more: its uncertainty is too large for the target's rings.
    """
    generator = torch.Generator().manual_seed(seed)
    cameras = _draw_cameras(camera, uncertainty, draws, generator)
    centers, radii = _draw_prints(target, uncertainty, draws, generator)
    estimator = PoseEstimator(replace(camera, covariance=None), target, method=method)
    together = max(1, _FRAMES // t.shape[0])
    errors = []
    for first in range(0, draws, together):
        chunk = range(first, min(first + together, draws))
        prints = [replace(target, centers=centers[draw], radii=radii[draw]) for draw in chunk]
        frames = [render(cameras[d], printed, R, t, **imaging) for d, printed in zip(chunk, prints, strict=True)]
        index = first * t.shape[0] + torch.arange(len(chunk) * t.shape[0])
        poses = estimator(add_noise(torch.cat(frames), noise, seed, index=index, bits=bits))
        shape = (len(chunk), t.shape[0])
        errors.append(_errors(poses.R.unflatten(0, shape), poses.t.unflatten(0, shape), R, t))
    return torch.cat(errors)


def _draw_cameras(camera: Camera, u: Uncertainty, draws: int, generator: torch.Generator) -> list[Camera]:
    coefficients = len(camera.distortion)
    shift = torch.randn(draws, 7 + coefficients, generator=generator, dtype=torch.float64)
    spread = torch.tensor(u.distortion or (0.0,) * coefficients, dtype=torch.float64)
    calibration = torch.zeros(4, 4, dtype=torch.float64)
    if camera.covariance is not None:
        values, vectors = torch.linalg.eigh(camera.covariance)
        calibration = vectors * values.clamp_min(0).sqrt()
    cameras = []
    for row in shift:
        intrinsics = calibration @ row[:4]
        matrix = camera.matrix.clone()
        matrix[0, 0] = matrix[0, 0] * (1 + u.focal_length * row[4]) + intrinsics[0]
        matrix[1, 1] = matrix[1, 1] * (1 + u.focal_length * row[4]) + intrinsics[1]
        matrix[:2, 2] += u.principal_point * row[5:7] + intrinsics[2:]
        cameras.append(replace(camera, matrix=matrix, distortion=camera.distortion + spread * row[7:], covariance=None))
    return cameras


def _draw_prints(target: Target, u: Uncertainty, draws: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Centres (D, M, 3) and radii (D, M, 2)."""
    shift = torch.randn(draws, len(target), 5, generator=generator, dtype=torch.float64)
    scale = 1 + u.print_scale * torch.randn(draws, 1, 1, generator=generator, dtype=torch.float64)
    one, two = plane_axes(target.normals)
    offset = u.print_centers * (shift[..., :1] * one + shift[..., 1:2] * two)
    offset = offset + u.print_flatness * shift[..., 2:3] * target.normals
    return target.centers * scale + offset, target.radii * scale + u.print_radii * shift[..., 3:]


def _sigma(u: Uncertainty) -> float:
    """For the solver's decisions only: equal weights give the same pose whatever they are."""
    return float(u.image) if not isinstance(u.image, Tensor) and u.image > 0 else 1.0


def _errors(found: Tensor, at: Tensor, R: Tensor, t: Tensor) -> Tensor:
    return torch.cat([at - t, rotations.log(found @ R.mT)], -1)

"""What `solve` was given, and what a chunk of it looks like to the minimiser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.pnp.normal_equations import Observations, Sums, product2, sums_of
from torchpose.pnp.planar import plane_frame


class Body(NamedTuple):
    """Points (3, N, B) about their centroid in units of their extent; B is 1 where all poses share them.

    Attributes:
        points: (3, N, B). sums: `Sums` of them where shared, else None, as for compiled code.
        frame: (3, 3, B), axes of their plane as rows, the last one normal to it.
        center: (3, B), centroid. unit: (B,), extent.
        flat, line: (B,) bool, do the points lie in a plane, on a line (or in a spot)?
        thin: (B,) bool, are they so nearly a plane that a second pose may explain them?
        warped: (B,) bool, do they lie in a plane, but not quite?
    """

    points: Tensor
    sums: Sums | None
    frame: Tensor
    center: Tensor
    unit: Tensor
    flat: Tensor
    line: Tensor
    thin: Tensor
    warped: Tensor


@dataclass(frozen=True)
class Inputs:
    """The arguments of `solve`, float64, every one shared by all poses or with the batch first."""

    points: Tensor
    pixels: Tensor
    camera: Camera | Tensor
    sigma_px: float
    covariances: Tensor | None
    weights: Tensor | None
    mask: Tensor | None
    huber: float | None
    body: Body | None = None

    @property
    def requires_grad(self) -> bool:
        """Is a gradient wanted by points, pixels or camera?"""
        camera = self.camera
        lens = (camera.matrix, camera.distortion) if isinstance(camera, Camera) else (camera,)
        return any(v.requires_grad for v in (self.points, self.pixels, *lens))

    def rows(self, rows: slice | Tensor) -> Inputs:
        """Those of some poses."""

        def part(value: Tensor | None, shared: int) -> Tensor | None:
            return value if value is None or value.ndim == shared else value[rows]

        points, camera = part(self.points, 2), self.camera
        assert points is not None
        return replace(
            self,
            points=points,
            pixels=self.pixels[rows],
            camera=camera if isinstance(camera, Camera) or camera.ndim == 2 else camera[rows],
            covariances=part(self.covariances, 3),
            weights=part(self.weights, 1),
            mask=part(self.mask, 1),
        )

    def with_body(self, sums: bool) -> Inputs:
        """With the points' frame, and ``sums`` if wanted, computed once, where all poses share and see all points."""
        if self.points.ndim == 3 or self.mask is not None or not bool(self.points.isfinite().all()):
            return self
        body = _body(self.points.T[..., None].contiguous(), None)
        return replace(self, body=body._replace(sums=sums_of(body.points)) if sums else body)

    def whitening(self) -> Tensor:
        """Square root of the information of the image points, 1/px: (1, N|1, B|1) diagonal or (2, 2, N, B|1) lower."""
        count = self.pixels.shape[1]
        factor = None if self.weights is None else self.weights.to(self.pixels).reshape(-1, count).T.sqrt()
        keep = self.keep()
        if keep is not None:
            factor = keep.to(self.pixels.dtype) if factor is None else torch.where(keep, factor, 0.0)
        if self.covariances is None:
            unit = self.pixels.new_full((1, 1, 1), 1 / self.sigma_px)
            return unit if factor is None else unit * factor
        c = self.covariances.to(self.pixels).reshape(-1, count, 2, 2).permute(2, 3, 1, 0)
        if keep is not None:
            c = torch.where(keep, c, torch.eye(2, dtype=c.dtype, device=c.device)[..., None, None])
        l00 = c[0, 0].sqrt()
        l10 = c[1, 0] / l00
        l11 = (c[1, 1] - l10.square()).sqrt()
        root = torch.stack([1 / l00, torch.zeros_like(l00), -l10 / (l00 * l11), 1 / l11]).unflatten(0, (2, 2))
        return root if factor is None else root * factor

    def keep(self) -> Tensor | None:
        """(N, B), was the point seen? None: all were."""
        batch, count = self.pixels.shape[:2]
        return None if self.mask is None else self.mask.reshape(-1, count).T.expand(count, batch)


class Problem(NamedTuple):
    """One chunk, batch last.

    Attributes:
        body: the object points.
        observed: undistorted normalised points, with the lens linearised at each of them.
        final: the same where there is no distortion, else pixels through the camera.
        pixel: as ``final`` with weights of one, for the RMS; or sigma, where chi-squared says it all.
        weight: (N, B), 1 for a point that was seen, 0 for one that was not; None: all were.
        seen: (B,), points seen.
        finite: (B,) bool.
        calibration: du, dv (4, N, B), by how many standard deviations four independent errors of fx, fy, cx, cy, of one
            standard deviation each, move an image point; None where the intrinsics are exact.
    """

    body: Body
    observed: Observations
    final: Observations
    pixel: Observations | float
    weight: Tensor | None
    seen: Tensor
    finite: Tensor
    calibration: tuple[Tensor, Tensor] | None


def prepare(inputs: Inputs) -> Problem:
    """Undistorts, whitens and centres; replaces what is not finite by zeros of weight zero."""
    pixels, camera = inputs.pixels, inputs.camera
    batch, count = pixels.shape[:2]
    image = pixels.permute(2, 1, 0).contiguous()
    keep, whitening = inputs.keep(), inputs.whitening()
    xy, slope = _rays(camera, pixels, image)
    linear = whitening * slope if whitening.ndim == slope.ndim == 3 else product2(whitening, slope)
    finite = _all_finite(xy, keep) & _all_finite(linear, keep)
    points = None
    if inputs.body is None:
        points = inputs.points.reshape(-1, count, 3).permute(2, 1, 0).contiguous()
        finite = finite & _all_finite(points, keep)
    finite = finite.expand(batch)
    weight = None
    if keep is not None or not bool(finite.all()):
        usable = finite if keep is None else keep & finite
        xy, image = (torch.where(usable, v, 0.0) for v in (xy, image))
        linear, whitening = torch.where(usable, linear, 0.0), torch.where(usable, whitening, 0.0)
        if points is not None:
            points = torch.where(usable, points, 0.0)
        if keep is not None:
            weight = keep.to(xy)
    body = inputs.body
    if body is None:
        assert points is not None
        body = _body(points, weight)

    observed = Observations(body.points, xy, linear, None, inputs.huber, body.sums)
    final = observed
    if isinstance(camera, Camera) and bool(camera.distortion.any()):
        final = observed._replace(xy=image, whitening=whitening, camera=camera)
    pixel: Observations | float = inputs.sigma_px
    if inputs.covariances is not None or inputs.weights is not None or inputs.huber is not None:
        pixel = final._replace(whitening=torch.ones_like(whitening) if final is not observed else slope)
    calibration = None
    if isinstance(camera, Camera) and camera.covariance is not None:
        calibration = _calibration(whitening, image, camera)
    seen = torch.full((batch,), count, device=pixels.device) if keep is None else keep.sum(0)
    return Problem(body, observed, final, pixel, weight, seen, finite, calibration)


def _body(points: Tensor, weight: Tensor | None) -> Body:
    frame = plane_frame(points, weight)
    unit = torch.where(frame.extent[2] > 0, frame.extent[2], 1)
    local = (points - frame.center[:, None]) / unit
    if weight is not None:
        local = torch.where(weight > 0, local, 0.0)
    spot = frame.extent[2] <= 1e-12 * frame.center.abs().amax(0)
    return Body(
        local,
        None,
        frame.axes,
        frame.center,
        unit,
        frame.flat,
        ~frame.wide | spot,
        frame.thin,
        frame.flat & ~frame.even,
    )


def _rays(camera: Camera | Tensor, pixels: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised points (2, N, B) and d(pixel)/d(normalised), (2, 1, B|1) where diagonal, else (2, 2, N|1, B|1)."""
    matrix = camera if isinstance(camera, Tensor) else camera.matrix.to(pixels)
    if isinstance(camera, Camera) and bool(camera.distortion.any()):
        xy = camera.undistort_points(pixels)
        slope = camera.J_distort(xy).permute(2, 3, 1, 0)
        return xy.permute(2, 1, 0).contiguous(), slope.contiguous()
    k = matrix.reshape(-1, 3, 3).permute(1, 2, 0)[:, :, None]  # (3, 3, 1, B)
    diagonal = torch.stack([k[0, 0], k[1, 1]])
    if bool((k[0, 1] == 0).all()):
        return (image - k[:2, 2]) / diagonal, diagonal
    y = (image[1] - k[1, 2]) / k[1, 1]
    x = (image[0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    zero = torch.zeros_like(k[0, 0])
    return torch.stack([x, y]), torch.stack([k[0, 0], k[0, 1], zero, k[1, 1]]).unflatten(0, (2, 2))


def _all_finite(value: Tensor, keep: Tensor | None) -> Tensor:
    """(B,) or (1,): are all numbers (..., N, B) of the points seen finite? Zero times anything else is NaN."""
    finite = (0 * value.flatten(0, -3)).sum(0) == 0
    return (finite if keep is None else finite | ~keep).all(0)


def _calibration(whitening: Tensor, image: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    assert camera.covariance is not None
    values, vectors = torch.linalg.eigh(camera.covariance[:4, :4].to(image))
    root = vectors * values.clamp_min(0).sqrt()  # (4, 4)
    matrix = camera.matrix.to(image)
    x, y = (image[0] - matrix[0, 2]) / matrix[0, 0], (image[1] - matrix[1, 2]) / matrix[1, 1]
    du = x * root[0, :, None, None] + root[2, :, None, None]  # (4, N, B)
    dv = y * root[1, :, None, None] + root[3, :, None, None]
    if whitening.ndim == 3:
        du, dv = du * whitening[0], dv * whitening[0]
    else:
        du, dv = whitening[0, 0] * du + whitening[0, 1] * dv, whitening[1, 0] * du + whitening[1, 1] * dv
    return du, dv

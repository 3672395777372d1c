"""First-order propagation of every error source to the six pose components: the error budget of a measurement.

The estimator minimises the residuals of what it measures, taking its camera and target for exact. With the Jacobian J
of the measurements by the pose, their weights W and the Jacobian S by another quantity, an error e of that quantity
moves the pose by (J^T W J)^-1 J^T W S e to first order. `torchpose.analysis.monte_carlo` runs the chain itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.target import Target

Features = Literal["centers", "rings"]
MIN_MARKERS = 3
_POINTS = 24  # on a circle: the sums over it are exact to the perspective's sixth power
_SINGULAR = 1e-12  # least eigenvalue of the information, scaled to a unit diagonal


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of what a measurement depends on. All errors are independent, with zero mean.

    Attributes:
        image: px. Of "centers": of each marker centre, on each axis; or covariances (M, 2, 2) or (B, M, 2, 2) px^2, by
            which the centres are weighted too. Of "rings": of the position of an edge averaged over 1 px of its length
            (`edge_noise`).
        focal_length: relative, common to fx and fy.
        principal_point: px, of cx and cy each.
        distortion: of each of the camera's coefficients, in their order; empty for none.
        print_centers: mm, of each marker's centre in the plane, on each axis.
        print_flatness: mm, of each marker's centre along its normal.
        print_radii: mm, of each circle's radius.
        print_scale: relative, of the whole print.
    """

    image: float | Tensor = 0.0
    focal_length: float = 0.0
    principal_point: float = 0.0
    distortion: tuple[float, ...] = ()
    print_centers: float = 0.0
    print_flatness: float = 0.0
    print_radii: float = 0.0
    print_scale: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Tensor):
                if not bool(value.isfinite().all()):
                    raise ValueError(f"{f.name} holds NaN or infinity")
            elif any(not 0 <= number < math.inf for number in (value if isinstance(value, tuple) else (value,))):
                raise ValueError(f"{f.name} is {value!r}; give standard deviations from 0")

    def only(self, source: str) -> Uncertainty:
        """The same with all sources but one exact."""
        return Uncertainty(**{source: getattr(self, source)})


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """What every source contributes to the covariance of B poses.

    Attributes:
        sources: by the names of the fields of `Uncertainty`, and ``calibration`` for `Camera.covariance`; those that
            are not zero. Each (B, 6, 6) float64, mm and rad: translation, then rotation w with R_true = exp(w) R, in
            camera axes. NaN where the markers in view do not determine the pose.
        total: (B, 6, 6), their sum.
        seen: (B, M) bool, the markers in view.
    """

    sources: dict[str, Tensor]
    total: Tensor
    seen: Tensor

    def std(self, source: str | None = None) -> Tensor:
        """(B, 6) standard deviations, mm and rad, of one source or of all together."""
        covariance = self.total if source is None else self.sources[source]
        return covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def edge_noise(noise: float, contrast: float, blur: float) -> float:
    """Least standard deviation (px) of an edge's position averaged over 1 px of its length: ``image`` of "rings".

    Cramer-Rao bound for a step of ``contrast`` grey levels under a Gaussian of ``blur`` px and white noise of ``noise``
    grey levels per pixel: noise sqrt(2 sqrt(pi) blur) / contrast (derived). The square pixel counts as a further blur
    of variance 1/12.
    """
    return noise * math.sqrt(2 * math.sqrt(math.pi * (blur * blur + 1 / 12))) / contrast


def propagate(
    camera: Camera,
    target: Target,
    R: Tensor,
    t: Tensor,
    uncertainty: Uncertainty,
    *,
    features: Features = "centers",
) -> ErrorBudget:
    """Covariances that the sources give the estimated poses, to first order, through the full camera model.

    Args:
        R, t: (B, 3, 3), (B, 3) mm, target to camera.
        uncertainty: of measurement, camera and print.
        features: what the pose is fitted to. "centers": the compensated marker centres, as `torchpose.pnp.solve`.
            "rings": both edges of every ring, weighted by their length in the image, as the refinements on edges and
            grey values do; the size of each ring then counts too.

    Raises:
        ValueError: as many standard deviations of distortion as coefficients are needed; shapes of R and t disagree.
    """
    if R.shape[1:] != (3, 3) or t.shape != (*R.shape[:1], 3):
        raise ValueError(f"R, t have shapes {tuple(R.shape)}, {tuple(t.shape)}; expected (B, 3, 3), (B, 3)")
    coefficients = len(camera.distortion)
    if len(uncertainty.distortion) not in (0, coefficients):
        raise ValueError(f"distortion has {len(uncertainty.distortion)} entries; the camera has {coefficients}")
    R, t = R.double(), t.double()
    camera, target = camera.to(R), target.to(R)
    seen = markers_seen(camera, target, R, t)
    # columns of the Jacobian: pose 6, fx fy cx cy 4, the marker's centre in its axes 3, its radii 2, scale, distortion
    zero = t.new_zeros(16 + coefficients)
    observe = _center_images if features == "centers" else _edge_images

    def image(delta: Tensor) -> Tensor:
        return observe(camera, target, R, t, delta)

    jacobian = torch.func.jacfwd(image)(zero)  # (B, M, N, 2, 16 + n): N points of each marker
    jacobian = torch.where(seen[:, :, None, None, None], jacobian, 0.0)
    if features == "centers":
        inverse = _inverse_covariances(uncertainty.image, jacobian)
        variance = 1.0 if isinstance(uncertainty.image, Tensor) else uncertainty.image**2
    else:
        inverse, variance = _edge_weights(camera, target, R, t), float(uncertainty.image) ** 2
    weighted = jacobian[..., :6].mT @ inverse  # (B, M, N, 6, 2)
    information = (weighted @ jacobian[..., :6]).sum((1, 2))
    inverted = _invert(information)
    # (B, M, 6, columns): how an error common to the points of a marker moves the pose
    gain = inverted[:, None] @ (weighted @ jacobian[..., 6:]).sum(2)
    whole = gain.sum(1)
    shares = {
        "focal_length": _outer(whole[:, :, :2] @ camera.matrix.diagonal()[:2, None]),
        "principal_point": _outer(whole[:, :, 2:4]),
        "distortion": _outer(whole[:, :, 10:] * t.new_tensor(uncertainty.distortion or (0.0,) * coefficients)),
        "print_centers": _outer(gain[..., 4:6]).sum(1),
        "print_flatness": _outer(gain[..., 6:7]).sum(1),
        "print_radii": _outer(gain[..., 7:9]).sum(1),
        "print_scale": _outer(whole[:, :, 9:10]),
    }
    sources = {"image": variance * inverted} if variance else {}
    for name, share in shares.items():
        size = getattr(uncertainty, name)
        if name == "distortion":
            sources |= {name: share} if any(size) else {}
        elif size:
            sources[name] = size**2 * share
    if camera.covariance is not None:
        sources["calibration"] = whole[:, :, :4] @ camera.covariance @ whole[:, :, :4].mT
    total = torch.stack([torch.zeros_like(inverted), *sources.values()]).sum(0) + 0 * inverted
    return ErrorBudget(sources, total, seen)


def markers_seen(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Tensor:
    """(B, M) bool: the marker's centre is inside the frame and its printed side faces the camera."""
    centers = target.centers @ R.mT + t[:, None]
    pixel = camera.project(centers)
    size = pixel.new_tensor([camera.width - 0.5, camera.height - 0.5])
    facing = ((target.normals @ R.mT) * centers).sum(-1) > 0
    enough = ((pixel >= -0.5) & (pixel <= size)).all(-1) & facing
    return enough & (enough.sum(-1, keepdim=True) >= MIN_MARKERS)


def _center_images(camera: Camera, target: Target, R: Tensor, t: Tensor, delta: Tensor) -> Tensor:
    """Pixels (B, M, 1, 2) of the compensated centres where pose, camera and print differ by ``delta``."""
    R, t = rotations.exp(delta[3:6]) @ R, t + delta[:3]
    centers, radii = _print(target, delta)
    c = centers @ R.mT + t[:, None]
    n = target.normals @ R.mT
    xy = c[..., :2] / c[..., 2:] + radius_shift(c, n, radii, target.radii)
    return _pixels(camera, xy, delta)[:, :, None]


def radius_shift(centers: Tensor, normals: Tensor, true: Tensor, nominal: Tensor) -> Tensor:
    """Shift (..., 2) of the centre that eq. (7) finds where the circles have other radii than it is told.

    Eq. (7) extrapolates the centres of both ellipses, e_inner + K2 (e_inner - e_outer), with K2 = r2^2 / (r1^2 - r2^2);
    the circle of radius r has its ellipse's centre at (c_xy c_z + r^2 n_xy n_z) / (c_z^2 - r^2 (1 - n_z^2)) (derived
    from the dual conic). On the normalised plane.

    Args:
        centers, normals: (..., 3) of the circles, camera frame. true, nominal: (..., 2) outer and inner radius.
    """
    nz, cz = normals[..., 2:], centers[..., 2:]

    def ellipse_center(radius: Tensor) -> Tensor:
        square = radius.square()[..., None]
        numerator = centers[..., :2] * cz + square * normals[..., :2] * nz
        return numerator / (cz.square() - square * (1 - nz.square()))

    def factor(radii: Tensor) -> Tensor:
        outer, inner = radii.square().unbind(-1)
        return (inner / (outer - inner))[..., None]

    return (factor(nominal) - factor(true)) * (ellipse_center(true[..., 1]) - ellipse_center(true[..., 0]))


def _edge_images(camera: Camera, target: Target, R: Tensor, t: Tensor, delta: Tensor) -> Tensor:
    """Pixels (B, M, 2 `_POINTS`, 2) of points on both circles of every ring."""
    R, t = rotations.exp(delta[3:6]) @ R, t + delta[:3]
    centers, radii = _print(target, delta)
    points = centers[:, None] + _circle(target, radii)
    return _pixels(camera, _normalised(points, R, t), delta)


def _edge_weights(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Tensor:
    """Information (B, M, 2 `_POINTS`, 2, 2) of the edges at unit noise: n n^T ds, n the normal in the image."""

    def image(turn: Tensor) -> Tensor:
        points = target.centers[:, None] + _circle(target, target.radii, turn)
        return camera.distort(_normalised(points, R, t))

    tangent = torch.func.jacfwd(image)(t.new_zeros(()))  # px per rad
    speed = tangent.norm(dim=-1, keepdim=True)
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / speed
    return normal[..., :, None] * normal[..., None, :] * (speed * 2 * torch.pi / _POINTS)[..., None]


def _circle(target: Target, radii: Tensor, turn: float | Tensor = 0.0) -> Tensor:
    """Offsets (M, 2 `_POINTS`, 3) mm of points of both circles from their centre."""
    angle = torch.arange(_POINTS, dtype=radii.dtype, device=radii.device) * (2 * torch.pi / _POINTS) + turn
    one, two = plane_axes(target.normals)
    direction = angle.cos()[:, None] * one[:, None] + angle.sin()[:, None] * two[:, None]
    return (radii[:, :, None, None] * direction[:, None]).flatten(1, 2)


def _normalised(points: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """(B, M, N, 2) of points (M, N, 3) in the target frame."""
    c = points @ R[:, None].mT + t[:, None, None]
    return c[..., :2] / c[..., 2:]


def _print(target: Target, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (M, 3) and radii (M, 2) of a print that differs from the target by ``delta``."""
    one, two = plane_axes(target.normals)
    offset = delta[10] * one + delta[11] * two + delta[12] * target.normals
    return target.centers * (1 + delta[15]) + offset, target.radii * (1 + delta[15]) + delta[13:15]


def _pixels(camera: Camera, xy: Tensor, delta: Tensor) -> Tensor:
    """Pixels of normalised points (..., 2) with a camera that differs by ``delta``."""
    bent = replace(camera, distortion=camera.distortion + delta[16:], covariance=None)
    focal, center = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    return (bent.distort(xy) - center) * (1 + delta[6:8] / focal) + center + delta[8:10]


def _inverse_covariances(image: float | Tensor, jacobian: Tensor) -> Tensor:
    """Weights (B | 1, M, 1, 2, 2) of the centres; the identity where all are alike."""
    if not isinstance(image, Tensor):
        return torch.eye(2).to(jacobian)
    return torch.linalg.inv(image.to(jacobian)).reshape(-1, jacobian.shape[1], 1, 2, 2)


def _outer(columns: Tensor) -> Tensor:
    return columns @ columns.mT


def _invert(information: Tensor) -> Tensor:
    """Inverse of positive semidefinite (B, 6, 6), whatever the units; NaN where it is singular."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(information.dtype).tiny).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, :, None] * scale[:, None])
    values = torch.where(values[:, :1] > _SINGULAR, values, torch.nan)
    vectors = scale[:, :, None] * vectors
    return (vectors / values[:, None]) @ vectors.mT

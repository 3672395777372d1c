"""First-order propagation of every error source to the six pose components: the error budget of a measurement.

The estimator minimises the residuals of what it measures, taking its camera and target for exact. With the Jacobian J
of the measurements by the pose, their weights W and the Jacobian S by another quantity, an error e of that quantity
moves the pose by (J^T W J)^-1 J^T W S e to first order. `torchpose.analysis.monte_carlo` runs the chain itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.rotations import plane_axes
from torchpose.target import Target

Features = Literal["centers", "rings"]
MIN_MARKERS = 3
_COLUMNS = 16  # by pose 6, fx fy cx cy 4, the marker's centre in its axes 3, its radii 2, scale; then distortion
_POINTS = 24  # on a circle: the sums over it are exact to the perspective's sixth power


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
            are not zero. In mm and rad: translation, then rotation w with R_true = exp(w) R, in
            camera axes. NaN where the markers in view do not determine the pose.
        total: their sum.
        seen: the markers in view.
    """

    sources: dict[str, Float[Tensor, "B 6 6"]]
    total: Float[Tensor, "B 6 6"]
    seen: Bool[Tensor, "B M"]

    def std(self, source: str | None = None) -> Float[Tensor, "B 6"]:
        """Standard deviations, mm and rad, of one source or of all together."""
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
    R: Float[Tensor, "B 3 3"],
    t: Float[Tensor, "B 3"],
    uncertainty: Uncertainty,
    *,
    features: Features = "centers",
) -> ErrorBudget:
    """Covariances that the sources give the estimated poses, to first order, through the full camera model.

    Args:
        camera: as the estimator has it.
        target: as the estimator has it.
        R: target to camera.
        t: target to camera, mm.
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
    observe = _center_images if features == "centers" else _edge_images

    def image(delta: Tensor) -> Tensor:
        return observe(camera, target, R, t, delta)

    jacobian = torch.func.jacfwd(image)(t.new_zeros(_COLUMNS + coefficients))  # (B, M, N, 2, 16 + n): N points a marker
    jacobian = torch.where(seen[:, :, None, None, None], jacobian, 0.0)
    inverse = _weights(camera, target, R, t, uncertainty.image, features).to(jacobian)
    weighted = jacobian[..., :6].mT @ inverse  # (B, M, N, 6, 2)
    inverted, known = scaled_inverse((weighted @ jacobian[..., :6]).sum((1, 2)))
    inverted = torch.where(known[:, None, None], inverted, torch.nan)
    # (B, M, 6, columns): how an error common to the points of a marker moves the pose
    gain = inverted[:, None] @ (weighted @ jacobian[..., 6:]).sum(2)
    by_covariance = features == "centers" and isinstance(uncertainty.image, Tensor)
    variance = 1.0 if by_covariance else float(uncertainty.image) ** 2
    sources = ({"image": variance * inverted} if variance else {}) | _shares(camera, gain, uncertainty)
    return ErrorBudget(sources, torch.stack([0 * inverted, *sources.values()]).sum(0), seen)


def _weights(camera: Camera, target: Target, R: Tensor, t: Tensor, image: float | Tensor, features: Features) -> Tensor:
    """Information (B | 1, M, N, 2, 2) of the points at unit noise, or of the covariances ``image`` of centres.

    That of an edge is n n^T ds, n the normal in the image.
    """
    if features == "centers":
        if isinstance(image, Tensor):
            return torch.linalg.inv(image).reshape(-1, len(target), 1, 2, 2)
        return torch.eye(2, device=R.device).expand(1, 1, 1, 2, 2)
    edge = ring_edges(camera, target, R, t, _POINTS)
    information = edge.normal[..., :, None] * (edge.length[..., None] * edge.normal)[..., None, :]
    return information.unflatten(1, (len(target), -1))


def _shares(camera: Camera, gain: Tensor, uncertainty: Uncertainty) -> dict[str, Tensor]:
    """Covariance (B, 6, 6) by every source but the image that is not exact, from `propagate`'s gains of markers."""
    whole = gain.sum(1)
    bent = any(uncertainty.distortion)
    # what moves with every marker on its own (B, M, 6, ...), and with all of them together (B, 1, 6, ...)
    columns = {
        "focal_length": whole[:, None, :, :2] @ camera.matrix.diagonal()[:2, None],
        "principal_point": whole[:, None, :, 2:4],
        "distortion": whole[:, None, :, 10:] * whole.new_tensor(uncertainty.distortion if bent else 0.0),
        "print_centers": gain[..., 4:6],
        "print_flatness": gain[..., 6:7],
        "print_radii": gain[..., 7:9],
        "print_scale": whole[:, None, :, 9:10],
    }
    sizes = {name: float(bent if name == "distortion" else getattr(uncertainty, name)) for name in columns}
    shares = {name: size**2 * (columns[name] @ columns[name].mT).sum(1) for name, size in sizes.items() if size}
    if camera.covariance is not None:
        shares["calibration"] = whole[:, :, :4] @ camera.covariance @ whole[:, :, :4].mT
    return shares


def markers_seen(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Bool[Tensor, "B M"]:
    """Whether the marker's centre is inside the frame and its printed side faces the camera."""
    centers = target.centers @ R.mT + t[:, None]
    pixel = camera.project(centers)
    size = pixel.new_tensor([camera.width - 0.5, camera.height - 0.5])
    facing = ((target.normals @ R.mT) * centers).sum(-1) > 0
    enough = ((pixel >= -0.5) & (pixel <= size)).all(-1) & facing
    return enough & (enough.sum(-1, keepdim=True) >= MIN_MARKERS)


def _center_images(camera: Camera, target: Target, R: Tensor, t: Tensor, delta: Tensor) -> Tensor:
    """Pixels (B, M, 1, 2) of the compensated centres where pose, camera and print differ by ``delta``."""
    R, t = rotations.exp(delta[3:6]) @ R, t + delta[:3]
    centers, radii = changed_print(target, delta[10:13], delta[13:15], delta[15])
    c = centers @ R.mT + t[:, None]
    xy = c[..., :2] / c[..., 2:] + radius_shift(c, target.normals @ R.mT, radii, target.radii)
    return _pixels(camera, xy, delta)[:, :, None]


def radius_shift(centers: Tensor, normals: Tensor, true: Tensor, nominal: Tensor) -> Tensor:
    """Shift (..., 2) of the centre that eq. (7) finds where the circles have other radii than it is told.

    Eq. (7) extrapolates the centres of both ellipses, e_inner + K2 (e_inner - e_outer), with K2 = r2^2 / (r1^2 - r2^2);
    the circle of radius r has its ellipse's centre at (c_xy c_z + r^2 n_xy n_z) / (c_z^2 - r^2 (1 - n_z^2)) (derived
    from the dual conic). On the normalised plane.

    Args:
        centers: (..., 3) of the circles, camera frame.
        normals: (..., 3) of the circles, camera frame.
        true: (..., 2) outer and inner radius.
        nominal: (..., 2) the same, as told.
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
    centers, radii = changed_print(target, delta[10:13], delta[13:15], delta[15])
    points = centers[:, None] + (radii[..., None, None] * around(target, _POINTS)[0][:, None]).flatten(1, 2)
    c = points @ R[:, None].mT + t[:, None, None]
    return _pixels(camera, c[..., :2] / c[..., 2:], delta)


class RingEdges(NamedTuple):
    """Points on both circles of every ring (P = M * 2 * count) and the bits of edge around them.

    Place about the target's origin in camera axes and depth, mm; derivatives of the image by the place; normal and
    length of the bit, px.
    """

    arm: Float[Tensor, "B P 3"]
    depth: Float[Tensor, "B P"]
    by_point: Float[Tensor, "B P 2 3"]
    normal: Float[Tensor, "B P 2"]
    length: Float[Tensor, "B P"]


def ring_edges(camera: Camera, target: Target, R: Tensor, t: Tensor, count: int) -> RingEdges:
    """The edges of a target's rings at poses (B, 3, 3), (B, 3) mm, ``count`` points on every circle."""
    radii, (out, ahead) = target.radii[..., None, None], around(target, count)
    arm = (target.centers[:, None, None] + radii * out[:, None]).flatten(0, 2) @ R.mT
    along = (radii * ahead[:, None]).flatten(0, 2) @ R.mT * (2 * math.pi / count)
    point = arm + t[:, None]
    depth, xy = point[..., 2], point[..., :2] / point[..., 2:]
    by_point = camera.J_distort(xy) @ image_by_point(xy, depth)
    x, y = (by_point @ along[..., None])[..., 0].unbind(-1)
    length = torch.hypot(x, y)
    return RingEdges(arm, depth, by_point, torch.stack([y, -x], -1) / length[..., None], length)


def around(target: Target, count: int) -> tuple[Float[Tensor, "M count 3"], Float[Tensor, "M count 3"]]:
    """Unit vectors around each ring in its plane, and those a quarter turn ahead of them."""
    angle = torch.arange(count, dtype=target.radii.dtype, device=target.radii.device)[:, None] * (2 * math.pi / count)
    one, two = (axis[:, None] for axis in plane_axes(target.normals))
    return angle.cos() * one + angle.sin() * two, angle.cos() * two - angle.sin() * one


def changed_print(target: Target, offset: Tensor, radii: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (..., M, 3) and radii (..., M, 2) of a print that is off.

    Args:
        target: as it should be.
        offset: (..., 3) mm of the centres, two directions in the plane and along the normal.
        radii: (..., 2) mm, what they are larger by.
        scale: relative, what the whole is larger by.
    """
    axes = torch.stack([*plane_axes(target.normals), target.normals], 1)
    moved = (offset[..., None, :] @ axes).squeeze(-2)
    return target.centers * (1 + scale) + moved, target.radii * (1 + scale) + radii


def _pixels(camera: Camera, xy: Tensor, delta: Tensor) -> Tensor:
    """Pixels of normalised points (..., 2) with a camera that differs by ``delta``."""
    bent = replace(camera, distortion=camera.distortion + delta[_COLUMNS:], covariance=None)
    focal, center = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    return (bent.distort(xy) - center) * (1 + delta[6:8] / focal) + center + delta[8:10]

"""First-order propagation of every error source to the six pose components: the error budget of a measurement.

The estimator minimises the residuals of what it measures, taking its camera and target for exact. With the Jacobian J
of the measurements by the pose, their weights W and the Jacobian S by another quantity, an error e of that quantity
moves the pose by (J^T W J)^-1 J^T W S e to first order. What the target file states of its print are further unknowns
with that prior where the estimator has them, too. `torchpose.analysis.monte_carlo` runs the chain itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.analysis.joint import POSE, grown, joint_inverse, marker_columns, print_numbers
from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import covariance_factor
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.rotations import plane_axes
from torchpose.pose import displaced
from torchpose.target import Target

Features = Literal["centers", "rings"]
MIN_MARKERS = 3
_RADII = slice(13, 15)  # columns of `_jacobian`
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

    By the names of the fields of `Uncertainty`, ``calibration`` for `Camera.covariance` with what a target measured in
    the same adjustment has in common with it, and ``target`` for the rest of `Target.covariance`; those that are not
    zero.
    In mm and rad: translation, then rotation w with R_true = exp(w) R, in camera axes. NaN where the markers in view do
    not determine the pose.
    """

    sources: dict[str, Float[Tensor, "B 6 6"]]
    total: Float[Tensor, "B 6 6"]  # their sum
    seen: Bool[Tensor, "B M"]  # the markers in view

    def std(self, source: str | None = None) -> Float[Tensor, "B 6"]:
        """Standard deviations, mm and rad, of one source or of all together."""
        covariance = self.total if source is None else self.sources[source]
        return covariance.diagonal(dim1=-2, dim2=-1).sqrt()


@checked
def edge_noise(noise: float, contrast: float, blur: float) -> float:
    """Least standard deviation (px) of an edge's position averaged over 1 px of its length: ``image`` of "rings".

    Cramer-Rao bound for a step of ``contrast`` grey levels under a Gaussian of ``blur`` px and white noise of ``noise``
    grey levels per pixel: noise sqrt(2 sqrt(pi) blur) / contrast (derived). The square pixel counts as a further blur
    of variance 1/12.
    """
    return noise * math.sqrt(2 * math.sqrt(math.pi * (blur * blur + 1 / 12))) / contrast


@checked
def propagate(
    camera: Camera, target: Target, R: Tensor, t: Tensor, uncertainty: Uncertainty, *, features: Features = "centers"
) -> ErrorBudget:
    """Covariances that the sources give the estimated poses, to first order, through the full camera model.

    Args:
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        uncertainty: of measurement, camera and print.
        features: what the pose is fitted to. "centers": the compensated marker centres, as `torchpose.pnp.solve`,
            weighted by their noise. "rings": both edges of every ring, weighted by their length in the image, as the
            refinements on edges and grey values do; the size of each ring then counts too, and the places and the edge
            gain of which the target states a covariance are unknowns with that prior.

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
    point = _centers(camera, target, R, t) if features == "centers" else ring_edges(camera, target, R, t, _POINTS)
    image = uncertainty.image
    if features == "centers" and isinstance(image, Tensor):
        information, variance = torch.linalg.inv(image.to(R)).reshape(-1, len(target), 1, 2, 2), 1.0
    else:
        information, variance = point.information, float(image) ** 2
    jacobian = torch.where(seen[:, :, None, None, None], _jacobian(camera, target, R, point), 0.0)
    own = torch.cat([jacobian[..., :POSE], jacobian[..., _RADII] @ grown(target)[:, None]], -1)
    weighted = own.mT @ information  # (B, M, N, 7, 2): N points of each marker
    each = (weighted @ own).sum(2)
    columns = marker_columns(target, camera, R)
    unknown = columns if features == "rings" else columns[..., :POSE]
    inverted, known = joint_inverse(each, unknown, variance)
    by_marker = torch.where(known[:, None, None], inverted, torch.nan)[:, None, :POSE] @ unknown.mT
    # (B, M, 6, columns): how an error common to the points of a marker moves the pose, and (B, M, 6, 7) its own motion
    gain, moved = by_marker @ (weighted @ jacobian[..., POSE:]).sum(2), by_marker @ each
    noise = variance * (moved @ by_marker.mT).sum(1)
    shared = displaced(R, target.centers @ R.mT, print_numbers(target, camera)[1])
    by_print, by_camera = ((moved @ numbers).sum(1) for numbers in (columns[..., POSE:], shared))
    sources = {"image": noise} if variance else {}
    sources |= _shares(camera, gain, uncertainty) | _stated(camera, target, gain.sum(1), by_print, by_camera)
    return ErrorBudget(sources, torch.stack([0 * noise, *sources.values()]).sum(0), seen)


class Points(NamedTuple):
    """N measured points of each marker."""

    arm: Float[Tensor, "B M N 3"]  # about the target's origin, camera axes, mm
    depth: Float[Tensor, "B M N"]  # mm
    xy: Float[Tensor, "B M N 2"]  # image on the plane z = 1
    by_point: Float[Tensor, "B M N 2 3"]  # derivatives of the pixels by the place
    by_radii: Float[Tensor, "B M N 2 2"]  # and by the marker's radii
    information: Float[Tensor, "B M N 2 2"]  # about the pixels at unit noise


def _jacobian(camera: Camera, target: Target, R: Tensor, point: Points) -> Tensor:
    """Derivatives (B, M, N, 2, 16 + n) of the pixels.

    By pose 6, fx fy cx cy, the marker's centre along its axes 3, its radii 2, the scale of the print, distortion n.
    """
    by_camera, axes = by_intrinsics(camera, point.xy), R[:, None] @ marker_axes(target).mT
    by_print = (point.by_point @ axes[:, :, None], point.by_radii, point.by_point @ point.arm[..., None])
    both = by_camera.tensor_split([4], -1)
    return torch.cat([by_pose(point.by_point, point.arm), both[0], *by_print, both[1]], -1)


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
    return {name: size**2 * (columns[name] @ columns[name].mT).sum(1) for name, size in sizes.items() if size}


def _stated(camera: Camera, target: Target, whole: Tensor, by_print: Tensor, by_camera: Tensor) -> dict[str, Tensor]:
    """Covariance (B, 6, 6) by what the files of camera and target state.

    Args:
        whole: gains of all markers together, of `propagate`.
        by_print: how the numbers of the print move poses, (B, 6, L).
        by_camera: the same of those of the camera that the target shares, (B, 6, C).
    """
    shares = {}
    if camera.covariance is not None:
        factor = covariance_factor(camera.covariance)
        by_camera = torch.cat([whole[:, :, :4], whole[:, :, 10:]], -1)[:, :, : len(factor)] @ factor + by_camera
        shares["calibration"] = by_camera @ by_camera.mT
    if target.covariance is not None:
        shares["target"] = by_print @ by_print.mT
    return shares


def markers_seen(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Bool[Tensor, "B M"]:
    """Whether the marker's centre is inside the frame and its printed side faces the camera."""
    centers = target.centers @ R.mT + t[:, None]
    pixel = camera.project(centers)
    size = pixel.new_tensor([camera.width - 0.5, camera.height - 0.5])
    facing = ((target.normals @ R.mT) * centers).sum(-1) > 0
    enough = ((pixel >= -0.5) & (pixel <= size)).all(-1) & facing
    return enough & (enough.sum(-1, keepdim=True) >= MIN_MARKERS)


def _centers(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Points:
    """The compensated centres, one point a marker."""
    arm, normal, radii = target.centers @ R.mT, target.normals @ R.mT, target.printed_radii
    xy, depth, by_point = _seen(camera, arm + t[:, None])
    # of `radius_shift` by the true radii
    outer, inner = radii.square().unbind(-1)
    by_factor = torch.stack([inner, -outer], -1) * 2 * radii / (outer - inner).square()[:, None]
    shift = _between_ellipses(arm + t[:, None], normal, radii)[..., None] * by_factor[:, None]
    eye = torch.eye(2, dtype=t.dtype, device=t.device).expand(*xy.shape, 2)
    return Points(*(value[:, :, None] for value in (arm, depth, xy, by_point, camera.J_distort(xy) @ shift, eye)))


def radius_shift(centers: Tensor, normals: Tensor, true: Tensor, nominal: Tensor) -> Tensor:
    """Shift (..., 2) of the centre that eq. (7) finds where the circles have other radii than it is told.

    Eq. (7) extrapolates the centres of both ellipses, e_inner + K2 (e_inner - e_outer), with K2 = r2^2 / (r1^2 - r2^2).
    On the plane z = 1; centres and normals (..., 3) in the camera frame, radii (..., 2) outer and inner.
    """

    def factor(radii: Tensor) -> Tensor:
        outer, inner = radii.square().unbind(-1)
        return (inner / (outer - inner))[..., None]

    return (factor(nominal) - factor(true)) * _between_ellipses(centers, normals, true)


def _between_ellipses(centers: Tensor, normals: Tensor, radii: Tensor) -> Tensor:
    """Centre of the inner ellipse minus that of the outer one, (..., 2).

    The circle of radius r has its ellipse's centre at (c_xy c_z + r^2 n_xy n_z) / (c_z^2 - r^2 (1 - n_z^2)) (derived
    from the dual conic).
    """
    (c, cz), (n, nz) = (vector[..., None, :].tensor_split([2], -1) for vector in (centers, normals))
    square = radii.square()[..., None]
    return ((c * cz + square * n * nz) / (cz.square() - square * (1 - nz.square()))).diff(dim=-2).squeeze(-2)


def ring_edges(camera: Camera, target: Target, R: Tensor, t: Tensor, count: int) -> Points:
    """Bits of edge, ``count`` on each of both circles of every ring, at poses (B, 3, 3), (B, 3) mm.

    The information about a bit is n n^T ds, n its normal in the image.
    """
    (out, ahead), radii = around(target, count), target.printed_radii[..., None, None]
    turn = R[:, None, None]
    out, ahead = out[:, None] @ turn.mT, ahead[:, None] @ turn.mT  # (B, M, 1, count, 3)
    arm = (target.centers @ R.mT)[:, :, None, None] + radii * out
    xy, depth, by_point = _seen(camera, arm + t[:, None, None, None])
    step = (by_point @ (radii * ahead * (2 * math.pi / count))[..., None])[..., 0]  # px from bit to bit
    normal = torch.stack([step[..., 1], -step[..., 0]], -1)
    information = normal[..., None] * normal[..., None, :] / step.norm(dim=-1)[..., None, None]
    of_circle = torch.eye(2, dtype=t.dtype, device=t.device)[:, None, None]  # its own radius only
    by_radii = (by_point @ out[..., None]) * of_circle
    each = (arm, depth, xy, by_point, by_radii, information)
    return Points(*(value.flatten(2, 3) for value in each))


def _seen(camera: Camera, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of points (..., 3): image on the plane z = 1, depth, derivatives (..., 2, 3) of the pixels."""
    depth, xy = point[..., 2], point[..., :2] / point[..., 2:]
    return xy, depth, camera.J_distort(xy) @ image_by_point(xy, depth)


def around(target: Target, count: int) -> tuple[Float[Tensor, "M count 3"], Float[Tensor, "M count 3"]]:
    """Unit vectors around each ring in its plane, and those a quarter turn ahead of them."""
    angle = torch.arange(count, dtype=target.radii.dtype, device=target.radii.device)[:, None] * (2 * math.pi / count)
    one, two = (axis[:, None] for axis in plane_axes(target.normals))
    return angle.cos() * one + angle.sin() * two, angle.cos() * two - angle.sin() * one


def marker_axes(target: Target) -> Float[Tensor, "M 3 3"]:
    """Rows: two directions in the plane of each marker and its normal."""
    return torch.stack([*plane_axes(target.normals), target.normals], 1)

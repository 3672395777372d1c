"""What was measured of the markers of each row, and how well a pose explains it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics, rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import constant, either
from torchpose.geometry.least_squares import covariance_factor
from torchpose.geometry.rows import Rows, replace, shared
from torchpose.identify import MarkerTable
from torchpose.pose.centers import common_center
from torchpose.rings import Rings

# px, and times the curvature a / b^2 and the blur's variance, of a px at least: what blur and mask do to an ellipse's
# shape. Blur alone draws an edge inwards by half of the product, more where it is wider.
SHAPE_FLOOR = (0.03, 0.5)
_EYE = ((1.0, 0.0), (0.0, 1.0))
# from the covariance (5, 5) of a fitted ellipse to that of e11 - e22 and 2 e12, both in a row
_PICK = ((0.0, 0.0, 1.0, 0.0, -1.0), (0.0, 0.0, 0.0, 2.0, 0.0))
_OF_SHAPE = tuple(tuple(p[i] * q[k] for p in _PICK for q in _PICK) for i in range(5) for k in range(5))
CENTER_RMS = 0.3  # px, of centres: small errors of calibration or print are no mix-up (convention)


@dataclass(frozen=True, eq=False)
class Evidence(Rows):
    """What was measured of the M markers of N rows; padded, see ``mask``.

    Attributes:
        points: target frame, mm.
        normals: the same.
        radii: outer and inner.
        center: compensated centres, ideal px.
        covariance: of these.
        shape: fitted ellipses, outer and inner, ideal px.
        shape_covariance: see `ellipse.EllipseFit`.
        blur: of the rings, variance along the major axis, px^2.
        mask: marker seen.
        coplanar: whether all markers of the target lie in one plane.
        polarity: of the target, as `MarkerTable.polarity`.
        placed: covariance that uncertain places on the print add to the centres, at most, ideal px^2.
        by_target: `MarkerTable.by_print`.
        by_camera: the same of `MarkerTable`.
        scale_sigma: the same.
        matrix: of the camera.
        of_camera: how many independent numbers are uncertain of it.
        gain: mm, edge gain of each plate that ``radii`` hold beyond those of the target's file; None for none.
    """

    points: Float[Tensor, "N M 3"]
    normals: Float[Tensor, "N M 3"]
    radii: Float[Tensor, "N M 2"]
    center: Float[Tensor, "N M 2"]
    covariance: Float[Tensor, "N M 2 2"]
    shape: Float[Tensor, "N M 2 5"]
    shape_covariance: Float[Tensor, "N M 2 5 5"]
    blur: Float[Tensor, "N M"]
    mask: Bool[Tensor, "N M"]
    coplanar: Bool[Tensor, " N"]
    polarity: Float[Tensor, " N"]
    placed: Float[Tensor, "N M 2 2"]
    by_target: Float[Tensor, "N M 7 L"]
    by_camera: Float[Tensor, "N M 7 C"]
    scale_sigma: Float[Tensor, " N"]
    matrix: Float[Tensor, "3 3"] = shared()
    of_camera: int = shared(0)
    gain: Float[Tensor, " N"] | None = None

    @property
    def numbers(self) -> int:
        """How many independent numbers are uncertain of camera and targets."""
        return self.of_camera + self.by_target.shape[-1]

    def without(self, marker: Tensor) -> Evidence:
        """The same rows with one marker each, (N,) int64, taken as not seen."""
        mask = self.mask.clone()
        mask[torch.arange(mask.shape[0], device=mask.device), marker] = False
        return replace(self, mask=mask)


@checked
def gather_evidence(
    rings: Rings,
    ring: Int[Tensor, "N M"],
    markers: MarkerTable,
    camera: Camera,
    locate: Callable[..., tuple[Tensor, Tensor]] = common_center,
) -> Evidence:
    """Lays the measurements of flat rings out by row and marker.

    Args:
        rings: of all frames.
        ring: which one each marker is, -1 where not seen.
        markers: of the target of each row.
        camera: for its matrix and covariance.
        locate: centres from both ellipses of a ring, as `centers.common_center`.
    """
    mask = ring >= 0
    row, marker = mask.nonzero().unbind(-1)
    which, radii = ring[row, marker], markers.radii[row, marker]
    outer, inner, blur = rings.outer[which], rings.inner[which], rings.blur[which]
    center, covariance = locate(outer, inner, radii)
    disc = radii[:, 1] < 0
    center = torch.where(disc[:, None], outer.params[:, :2], center)
    covariance = torch.where(disc[:, None, None], outer.center_covariance, covariance)

    def laid_out(values: Tensor, fill: float) -> Tensor:
        empty = torch.full((*ring.shape, *values.shape[1:]), fill, dtype=torch.float64, device=ring.device)
        return empty.index_put((row, marker), values)

    ellipses = laid_out(torch.stack([outer.params, inner.params], 1), 1.0)
    # a circle of the radius r has the shape matrix r A, A from the plane to the image
    variance = markers.by_print[:, :, :3].square().sum(-1).amax(-1) / markers.radii[..., 0].square()
    shape = conics.shape_matrix(ellipses[:, :, 0])
    return Evidence(
        markers.centers,
        markers.normals,
        markers.radii,
        laid_out(center, torch.nan),
        laid_out(covariance, torch.nan),
        ellipses,
        laid_out(torch.stack([outer.covariance, inner.covariance], 1), 1.0),
        laid_out(blurs.axes(blur)[1], 1.0),
        mask,
        markers.coplanar,
        markers.polarity,
        variance[..., None, None] * (shape @ shape),
        markers.by_print,
        markers.by_camera,
        markers.scale_sigma,
        camera.matrix,
        0 if camera.covariance is None else covariance_factor(camera.covariance).shape[1],
    )


def predicted_circles(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """Ellipses (N, S, M, 2, 5), ideal px, of every marker's circles under S poses R (N, S, 3, 3), t (N, S, 3)."""
    both = torch.cat([evidence.points, evidence.normals], 1)
    # of all poses in one product
    both = rotations.turned(R.flatten(1, 2), both).unflatten(2, (-1, 3)).transpose(1, 2)  # (N, S, 2 M, 3)
    x, normal = both.chunk(2, 2)
    x = (x + t[:, :, None])[..., None, :]
    return conics.seen_circle(
        evidence.matrix, x.expand(-1, -1, -1, 2, -1), normal[..., None, :], evidence.radii[:, None]
    )


@checked
def shape_chi2(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """`misfit_of_shapes` (N, S) under S poses."""
    return misfit_of_shapes(evidence, predicted_circles(evidence, R, t))


def misfit_of_shapes(evidence: Evidence, predicted: Tensor) -> Tensor:
    """Chi-squared (N, S) of the rings' shapes: elongation and its direction, which blur and threshold hardly touch.

    Args:
        evidence: N rows.
        predicted: as `predicted_circles`.
    """
    _, _, a, b, theta = evidence.shape.unbind(-1)
    _, _, other_a, other_b, other_theta = predicted.unbind(-1)
    # e11 - e22 and 2 e12 of the change, in the axes of the ellipse that was measured
    apart, turn = other_a - other_b, 2 * (other_theta - theta[:, None])
    v = torch.stack([(a - b)[:, None] - apart * turn.cos(), -apart * turn.sin()], -1)
    bend = a / b.square()
    floor = SHAPE_FLOOR[0] + SHAPE_FLOOR[1] * bend * evidence.blur[..., None].clamp_min(1.0)
    covariance = (evidence.shape_covariance.flatten(-2) @ constant(_OF_SHAPE, v)).unflatten(-1, (2, 2))
    covariance.diagonal(dim1=-2, dim2=-1).add_(floor.square()[..., None])
    seen = evidence.mask[..., None]
    weight = torch.linalg.inv_ex(torch.where(seen[..., None, None], covariance, constant(_EYE, v))).inverse
    chi2 = ((weight[:, None] * v[..., None, :]).sum(-1) * v).sum(-1)
    return either(seen[:, None], chi2, 0.0).sum((-1, -2))


@checked
def center_rms(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """RMS distance (N,) in px of the compensated centres from the projected ones."""
    x = rotations.turned(evidence.matrix @ R, evidence.points) + (t @ evidence.matrix.T)[:, None]
    at, depth = x.split_with_sizes([2, 1], -1)
    square = either(evidence.mask, (at / depth - evidence.center).square().sum(-1), 0.0)
    return (square.sum(-1) / evidence.mask.sum(-1)).sqrt()


def visible(covariance: Tensor, mask: Tensor) -> Tensor:
    """Covariances with the identity where nothing was seen."""
    return torch.where(mask[..., None, None], covariance, constant(_EYE, covariance))

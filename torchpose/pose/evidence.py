"""What was measured of the markers of each row, and how well a pose explains it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import covariance_factor
from torchpose.geometry.rows import Rows, shared
from torchpose.identify import MarkerTable
from torchpose.pose.centers import common_center
from torchpose.rings import Rings

# px, and times the curvature a / b^2 and the blur's variance, of a px at least: what blur and mask do to an ellipse's
# shape. Blur alone draws an edge inwards by half of the product, more where it is wider.
SHAPE_FLOOR = (0.03, 0.5)
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
    seen = rings[ring[row, marker]]
    center, covariance = locate(seen.outer, seen.inner, markers.radii[row, marker])
    disc = markers.radii[row, marker, 1] < 0
    center = torch.where(disc[:, None], seen.outer.params[:, :2], center)
    covariance = torch.where(disc[:, None, None], seen.outer.center_covariance, covariance)

    def laid_out(values: Tensor, fill: float) -> Tensor:
        empty = torch.full((*ring.shape, *values.shape[1:]), fill, dtype=torch.float64, device=ring.device)
        return empty.index_put((row, marker), values)

    ellipses = laid_out(torch.stack([seen.outer.params, seen.inner.params], 1), 1.0)
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
        laid_out(torch.stack([seen.outer.covariance, seen.inner.covariance], 1), 1.0),
        laid_out(blurs.axes(seen.blur)[1], 1.0),
        mask,
        markers.coplanar,
        markers.polarity,
        variance[..., None, None] * shape @ shape,
        markers.by_print,
        markers.by_camera,
        markers.scale_sigma,
        camera.matrix,
        0 if camera.covariance is None else covariance_factor(camera.covariance).shape[1],
    )


def predicted_circles(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """Ellipses (N, S, M, 2, 5), ideal px, of every marker's circles under S poses R (N, S, 3, 3), t (N, S, 3)."""
    x = (R[:, :, None] @ evidence.points[:, None, ..., None]).squeeze(-1) + t[:, :, None]  # (N, S, M, 3)
    return conics.circle_ellipse(
        evidence.matrix,
        R[:, :, None, None],
        x[..., None, :],
        evidence.normals[:, None, :, None],
        evidence.radii[:, None],
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
    difference = conics.shape_matrix(evidence.shape)[:, None] - conics.shape_matrix(predicted)
    theta = evidence.shape[..., 4]
    cos, sin = theta.cos(), theta.sin()
    axes = torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))[:, None]
    change = axes.mT @ difference @ axes
    v = torch.stack([change[..., 0, 0] - change[..., 1, 1], 2 * change[..., 0, 1]], -1)
    pick = torch.tensor([[0, 0, 1, 0, -1], [0, 0, 0, 2, 0]], dtype=v.dtype, device=v.device)
    bend = evidence.shape[..., 2] / evidence.shape[..., 3].square()
    floor = SHAPE_FLOOR[0] + SHAPE_FLOOR[1] * bend * evidence.blur[..., None].clamp_min(1.0)
    eye = torch.eye(2, dtype=v.dtype, device=v.device)
    covariance = pick @ evidence.shape_covariance @ pick.T + floor.square()[..., None, None] * eye
    seen = evidence.mask[..., None, None, None]
    weight = torch.linalg.inv(torch.where(seen, covariance, eye))[:, None]
    chi2 = (v[..., None, :] @ weight @ v[..., None]).squeeze(-1).squeeze(-1)
    return torch.where(evidence.mask[:, None, :, None], chi2, 0.0).sum((-1, -2))


@checked
def center_rms(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """RMS distance (N,) in px of the compensated centres from the projected ones."""
    x = (R[:, None] @ evidence.points[..., None]).squeeze(-1) + t[:, None]
    d = (x @ evidence.matrix.T)[..., :2] / x[..., 2:] - evidence.center
    square = torch.where(evidence.mask, d.square().sum(-1), 0.0)
    return (square.sum(-1) / evidence.mask.sum(-1)).sqrt()


def visible(covariance: Tensor, mask: Tensor) -> Tensor:
    """Covariances with the identity where nothing was seen."""
    eye = torch.eye(2, dtype=covariance.dtype, device=covariance.device)
    return torch.where(mask[..., None, None], covariance, eye)

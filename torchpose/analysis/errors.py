"""Errors of estimated poses against known ones, and whether the predicted covariance explains them."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.rows import Rows


class Pose(Protocol):
    """Poses that map target to camera: R (..., 3, 3), t (..., 3) in mm. `torchpose.sim.Truth` is one."""

    @property
    def R(self) -> Tensor: ...
    @property
    def t(self) -> Tensor: ...


class UncertainPose(Pose, Protocol):
    """`Pose` with its covariance (..., 6, 6) as in `torchpose.Poses`: t in mm, then rotation in rad (camera axes)."""

    @property
    def covariance(self) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class PoseErrors(Rows):
    """Estimate minus truth, float64; NaN where either has no pose.

    Attributes:
        translation: mm, along the camera axes.
        rotation: rad, rotation vector w about the camera axes with R_estimated = exp(w) R_true.
        nees: normalised estimation error squared e^T C^-1 e of e = (translation, rotation). Chi-squared with 6
            degrees of freedom, so 6 in the mean, where the errors are Gaussian with the predicted covariance C
            (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2). NaN where C is not positive definite.
    """

    translation: Float[Tensor, "*batch 3"]
    rotation: Float[Tensor, "*batch 3"]
    nees: Float[Tensor, "*batch"]

    @property
    def lateral(self) -> Float[Tensor, "*batch"]:
        """Length of the error across the optical axis, mm."""
        return torch.linalg.vector_norm(self.translation[..., :2], dim=-1)

    @property
    def depth(self) -> Float[Tensor, "*batch"]:
        """Signed error along the optical axis, mm; positive where the estimate is too far."""
        return self.translation[..., 2]

    @property
    def angle(self) -> Float[Tensor, "*batch"]:
        """Angle of the rotation between estimate and truth, rad."""
        return torch.linalg.vector_norm(self.rotation, dim=-1)


@checked
def pose_errors(estimated: UncertainPose, truth: Pose) -> PoseErrors:
    """Errors of estimated poses, row by row.

    Args:
        estimated: poses with covariance, for example `torchpose.Poses`.
        truth: poses of the same leading shape, or of one that broadcasts to it.
    """
    error = pose_difference(estimated, truth)
    factor, failed = torch.linalg.cholesky_ex(estimated.covariance)
    whitened = torch.linalg.solve_triangular(factor, error[..., None], upper=False)[..., 0]
    return PoseErrors(error[..., :3], error[..., 3:], whitened.square().sum(-1).masked_fill(failed != 0, torch.nan))


def pose_difference(estimated: Pose, truth: Pose) -> Float[Tensor, "*batch 6"]:
    """Translation (mm) and rotation vector (rad) of estimate minus truth, about the camera axes."""
    return torch.cat([estimated.t - truth.t, rotations.log(estimated.R @ truth.R.mT)], -1)


@checked
def rms(values: Tensor) -> Tensor:
    """Root mean square along the first dimension of (N, ...), without the rows that are NaN; NaN where all are."""
    return values.square().nanmean(0).sqrt()

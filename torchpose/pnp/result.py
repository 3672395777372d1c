"""What `torchpose.pnp.solve` returns."""

from dataclasses import dataclass
from enum import IntEnum

from torch import Tensor

from torchpose.errors import TorchposeError
from torchpose.geometry.rows import Rows


class PnPCode(IntEnum):
    """What became of one pose."""

    CONVERGED = 0
    AMBIGUOUS = 1  # two poses explain the points about equally well; the better one is given, the other one as R_alt
    DEGENERATE = 2  # the points lie on one line or in one spot, or do not fix all six parameters
    BEHIND_CAMERA = 3  # no pose with all points in front of the camera explains them
    NOT_CONVERGED = 4  # of two minima, both are to be reached
    TOO_FEW = 5  # fewer points than the method needs; those that coincide count once
    NOT_FINITE = 6  # NaN, infinity, a pixel without a ray, or a covariance that is not positive definite


class PnPError(TorchposeError):
    """A pose failed and ``raise_on_failure`` was set."""


@dataclass(frozen=True, eq=False)
class PnPResult(Rows):
    """B poses. Where ``code`` is neither CONVERGED nor AMBIGUOUS, every float is NaN.

    Attributes:
        R: (B, 3, 3) float64, object to camera: X_cam = R X + t.
        t: (B, 3) float64, in the unit of the object points.
        covariance: (B, 6, 6) float64, translation first, then rotation (rad, left-multiplied: R = exp(w) R_est).
        rms: (B,) float64, root mean square distance of the projections from the image points, px.
        chi2: (B,) float64, sum of squared whitened residuals (Huber's cost where chosen).
        iterations: (B,) int64, of Levenberg-Marquardt, 0 for a closed-form method.
        code: (B,) int64, `PnPCode`.
        R_alt: (B, 3, 3), the other minimum, NaN where there is none. Where it is out of the question, from where its
            search was stopped. Minima from starts given as ``initial`` are always followed to their end.
        t_alt: (B, 3), its translation.
        rms_alt: (B,), its `rms`.
        chi2_alt: (B,), its `chi2`; where the search was stopped an upper bound that is sure to stay above 2 chi2 + 40.
        ratio: (B,) float64, rms_alt / rms, NaN where there is no other minimum.
    """

    R: Tensor
    t: Tensor
    covariance: Tensor
    rms: Tensor
    chi2: Tensor
    iterations: Tensor
    code: Tensor
    R_alt: Tensor
    t_alt: Tensor
    rms_alt: Tensor
    chi2_alt: Tensor
    ratio: Tensor

    @property
    def converged(self) -> Tensor:
        """(B,) bool, `PnPCode.CONVERGED`."""
        return self.code == PnPCode.CONVERGED

"""What the pipeline returns: `Status`, `Reason`, `Detections`, `Poses`. Tensors; ragged results flat with an index."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any, Self

import torch
from torch import Tensor

from torchpose.geometry import rotations


class Status(IntEnum):
    """What became of one target in one frame."""

    OK = 0
    NO_TARGET = 1  # no marker of the target was found
    TOO_FEW_MARKERS = 2  # fewer than 3
    AMBIGUOUS = 3  # two poses explain all evidence about equally well; the better one is given
    REJECTED = 4  # markers were found, but no pose explains them; `Reason` says which
    UNREADABLE = 5  # the file could not be decoded
    WRONG_SIZE = 6  # the frame has not the size of the camera


class Reason(IntEnum):
    """Why a status is not OK."""

    NONE = 0
    RESIDUAL = 1  # no pose fits the marker centres within their noise (mix-up, damage, wrong camera or target file)
    RING_SHAPE = 2  # the centres fit, the rings' ellipses contradict the pose (motion blur, mix-up)
    DEGENERATE = 3  # the markers seen lie on one line, or the view is edge-on
    NOT_CONVERGED = 4
    BEHIND_CAMERA = 5
    TWO_SOLUTIONS = 6  # with Status.AMBIGUOUS


class _TensorBundle:
    """Common operations of the dataclasses of tensors below."""

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Same as `Tensor.to` on every tensor, nested ones too; integer tensors keep their dtype."""
        moved: dict[str, Any] = {}
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if isinstance(value, Tensor):
                target = value.to(*args, **kwargs)
                # integers go to the device only: a large id would not survive the way through a float
                moved[f.name] = target if value.is_floating_point() else value.to(target.device)
            elif isinstance(value, _TensorBundle):
                moved[f.name] = value.to(*args, **kwargs)
        return replace(self, **moved)  # type: ignore[type-var]

    def cpu(self) -> Self:
        return self.to("cpu")

    def __getitem__(self, index: Any) -> Self:
        """The rows selected by a mask, a slice or an index tensor."""
        picked = {}
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if isinstance(value, Tensor):
                picked[f.name] = value[index]
        return replace(self, **picked)  # type: ignore[type-var]


@dataclass(frozen=True, eq=False)
class Detections(_TensorBundle):
    """The K markers found in a batch, flat. Pixels are those of the raw (distorted) frame, OpenCV convention.

    Attributes:
        frame: (K,) int64, index of the frame in the batch.
        target: (K,) int64, index of the target.
        marker: (K,) int64, marker id as in the target file.
        center: (K, 2) float64, image of the marker's centre, compensated for perspective, px.
        center_cov: (K, 2, 2) float64, its covariance, px^2.
        outer, inner: (K, 5) float64, fitted ellipses cx, cy, a >= b (semi-axes, px), theta (rad, [0, pi)).
    """

    frame: Tensor
    target: Tensor
    marker: Tensor
    center: Tensor
    center_cov: Tensor
    outer: Tensor
    inner: Tensor

    def __len__(self) -> int:
        return self.frame.shape[0]


@dataclass(frozen=True, eq=False)
class Poses(_TensorBundle):
    """Poses of T targets in B frames as N = B * T rows, frame-major; with one target, row = frame.

    Where there is no pose, R, t, covariance and rms are NaN and `status` says why.

    Attributes:
        frame: (N,) int64, index of the frame in the batch.
        target: (N,) int64, index of the target.
        R: (N, 3, 3) float64, target to camera: X_cam = R X_target + t.
        t: (N, 3) float64, mm.
        covariance: (N, 6, 6) float64, translation (mm) first, then rotation (rad, left-multiplied: R = exp(w) R_est,
            that is about the camera axes).
        rms: (N,) float64, reprojection RMS of the compensated marker centres, px.
        status: (N,) int64, `Status`.
        reason: (N,) int64, `Reason`.
        markers: (N,) int64, number of markers used.
        chi2: (N,) float64, of all evidence (centres and ring shapes) at the pose.
        R_alt, t_alt, rms_alt, chi2_alt: the other minimum of the same evidence (the second planar solution); NaN
            where both coincide or there is none.
        detections: the markers of the whole batch; selecting rows leaves them alone, their `frame` and `target` say
            whose they are.
    """

    frame: Tensor
    target: Tensor
    R: Tensor
    t: Tensor
    covariance: Tensor
    rms: Tensor
    status: Tensor
    reason: Tensor
    markers: Tensor
    chi2: Tensor
    R_alt: Tensor
    t_alt: Tensor
    rms_alt: Tensor
    chi2_alt: Tensor
    detections: Detections

    def __len__(self) -> int:
        return self.frame.shape[0]

    @property
    def ok(self) -> Tensor:
        """(N,) bool, rows with `Status.OK`."""
        return self.status == Status.OK

    @property
    def rotation_vector(self) -> Tensor:
        """(N, 3) rotation vectors in rad."""
        return rotations.log(self.R)

    @property
    def quaternion(self) -> Tensor:
        """(N, 4) unit quaternions w, x, y, z with w >= 0."""
        return rotations.quaternion(self.R)

    @property
    def std(self) -> Tensor:
        """(N, 6) standard deviations of t (mm) and of the rotation (rad)."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    def moved(self, rotation: Tensor, translation: Tensor) -> Poses:
        """Poses of another frame fixed to the target, whose coordinates are ``rotation @ X_target + translation``.

        Args:
            rotation: (3, 3) or (N, 3, 3). translation: (3,) or (N, 3), mm (`Target.part_from_target`).
        """
        r_inv, t_inv = rotations.inverse(rotation.to(self.R), translation.to(self.t))
        r, t = rotations.compose(self.R, self.t, r_inv, t_inv)
        r_alt, t_alt = rotations.compose(self.R_alt, self.t_alt, r_inv, t_inv)
        # t' = t + R d with R = exp(w) R_est, so dt'/dw = -[R d]x
        jacobian = torch.eye(6, dtype=self.t.dtype, device=self.t.device).repeat(len(self), 1, 1)
        jacobian[:, :3, 3:] = -rotations.skew(t - self.t)
        covariance = jacobian @ self.covariance @ jacobian.mT
        return replace(self, R=r, t=t, covariance=covariance, R_alt=r_alt, t_alt=t_alt)

    def seen_from(self, rotation: Tensor, translation: Tensor) -> Poses:
        """Poses in another fixed frame whose coordinates are ``rotation @ X_cam + translation`` (hand-eye).

        Args:
            rotation: (3, 3) or (N, 3, 3). translation: (3,) or (N, 3), mm.
        """
        ra, ta = rotation.to(self.R), translation.to(self.t)
        r, t = rotations.compose(ra, ta, self.R, self.t)
        r_alt, t_alt = rotations.compose(ra, ta, self.R_alt, self.t_alt)
        turn = torch.zeros(*ra.shape[:-2], 6, 6, dtype=ra.dtype, device=ra.device)
        turn[..., :3, :3] = turn[..., 3:, 3:] = ra
        return replace(self, R=r, t=t, covariance=turn @ self.covariance @ turn.mT, R_alt=r_alt, t_alt=t_alt)

"""What the pipeline returns: `Status`, `Reason`, `Detections`, `Poses`. Tensors; ragged results flat with an index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.rows import Rows, shared

if TYPE_CHECKING:
    from kornia.geometry.liegroup import Se3


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
    MIRRORED = 7  # the target is seen from behind its printed side: a mirror in the path, or a file drawn y-up
    CAMERAS_DISAGREE = 8  # cameras of a rig contradict each other beyond their covariance


class Misfit(IntEnum):
    """What the residuals of a row show beyond noise and the stated uncertainties; its covariance is widened by that."""

    NONE = 0
    PRINT = 1  # markers sit beside their places, or edges do
    CAMERA = 2  # focal lengths, principal point or distortion are off, as far as one frame can tell
    SCATTER = 3  # neither: something else in the frame
    TONE = 4  # edges lie elsewhere by as many px all round: grey values that are not linear, light that floods


@dataclass(frozen=True, eq=False)
class Detections(Rows):
    """The K markers found in a batch, flat. Pixels are those of the raw (distorted) frame, OpenCV convention.

    Attributes:
        frame: index of the frame in the batch.
        target: index of the target.
        instance: number of the copy, as in `Poses`.
        marker: marker id as in the target file.
        center: image of the marker's centre, compensated for perspective, px.
        center_cov: its covariance, px^2.
        outer: fitted ellipse cx, cy, a >= b (semi-axes, px), theta (rad, [0, pi)).
        inner: that of the inner circle.
        camera: number in the rig, where several cameras look.
    """

    frame: Int[Tensor, " K"]
    target: Int[Tensor, " K"]
    instance: Int[Tensor, " K"]
    marker: Int[Tensor, " K"]
    center: Float[Tensor, "K 2"]
    center_cov: Float[Tensor, "K 2 2"]
    outer: Float[Tensor, "K 5"]
    inner: Float[Tensor, "K 5"]
    camera: Int[Tensor, " K"] | None = None


@dataclass(frozen=True, eq=False)
class Motions(Rows):
    """Poses of one row's target in the frame of another's: X_i = R X_j + t.

    Attributes:
        R: rotation.
        t: translation, mm.
        covariance: translation (mm) first, then rotation (rad, about the axes of frame i), of everything.
        noise: the part of it that is the noise of the two frames.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    noise: Float[Tensor, "N 6 6"]

    @property
    def std(self) -> Float[Tensor, "N 6"]:
        """Standard deviations of t (mm) and of the rotation (rad)."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    def unknown_where(self, unknown: Bool[Tensor, " N"]) -> Motions:
        """The same with NaN in those rows."""
        parts = (self.R, self.t, self.covariance, self.noise)
        return Motions(*(part.masked_fill(unknown.view(-1, *[1] * (part.ndim - 1)), torch.nan) for part in parts))


@dataclass(frozen=True, eq=False)
class Poses(Rows):
    """Poses of T targets in B frames, frame-major.

    N = B * T rows; with one target, row = frame. Where an estimator looks for several copies of a target (its
    ``instances`` above 1), every frame and target has at least one row and a further one for each further copy with a
    pose: count by `frame`, `target` and `instance` then. Where there is no pose, R, t, covariance and rms are NaN and
    `status` says why.

    Attributes:
        frame: index of the frame in the batch.
        target: index of the target.
        instance: number of the copy among those of the target in the frame, 0, 1, ... from left to right in the image,
            by the target's origin.
        copies: of the target that the frame shows, each by a pose or by four markers in their places; the same in all
            rows of a frame and target. More than there are rows: the others were left out, or no pose explains them.
            Where one copy is looked for, those at the coarse scale are counted, and there may be more.
        R: target to camera: X_cam = R X_target + t.
        t: mm.
        covariance: translation (mm) first, then rotation (rad, left-multiplied: R = exp(w) R_est, that is about the
            camera axes). Of everything: noise, target and camera.
        noise: the part of it that is the frame's own: how far the pose would scatter if the frame were taken again.
        systematic: how the pose errs with each of L numbers of unit variance that are the same in all frames: the
            uncertain parameters of the camera, the first ``of_camera``, and what is uncertain of the target.
        place: where the fit found the M markers beside their places, target frame, their dark edges outwards, and both
            edges of a ring further from its centre, all in mm, as far as the file or the residuals leave it open; NaN
            for markers that were not used.
        misfit: `Misfit`.
        residual_chi2: chi-squared of what the markers say against each other, under noise and the stated
            uncertainties alone; what stands above chance is counted in the covariance.
        freedom: its degrees of freedom.
        rms: reprojection RMS of the compensated marker centres, px.
        status: `Status`.
        reason: `Reason`, why it is not OK.
        markers: number of markers used.
        chi2: of all evidence (centres and ring shapes) at the pose.
        R_alt: rotation of the other minimum of the same evidence (the second planar solution); NaN where both coincide
            or there is none.
        t_alt: its translation.
        rms_alt: its `rms`.
        chi2_alt: its `chi2`.
        share: of the information about the pose, by camera of a rig, 0 where it contributes nothing; None without rig.
        consistency: chi-squared of what the C cameras of a rig say against each other, and its degrees of freedom; 0
            with one camera.
        odd: the camera of a rig that contradicts the others, where three or more tell; -1 else.
        detections: the markers of the whole batch; selecting rows leaves them alone, their `frame`, `target` and
            `instance` say whose they are.
    """

    frame: Int[Tensor, " N"]
    target: Int[Tensor, " N"]
    instance: Int[Tensor, " N"]
    copies: Int[Tensor, " N"]
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    noise: Float[Tensor, "N 6 6"]
    systematic: Float[Tensor, "N 6 L"]
    place: Float[Tensor, "N M 5"]
    misfit: Int[Tensor, " N"]
    residual_chi2: Float[Tensor, " N"]
    freedom: Int[Tensor, " N"]
    rms: Float[Tensor, " N"]
    status: Int[Tensor, " N"]
    reason: Int[Tensor, " N"]
    markers: Int[Tensor, " N"]
    chi2: Float[Tensor, " N"]
    R_alt: Float[Tensor, "N 3 3"]
    t_alt: Float[Tensor, "N 3"]
    rms_alt: Float[Tensor, " N"]
    chi2_alt: Float[Tensor, " N"]
    detections: Detections = shared()
    of_camera: int = shared(0)
    share: Float[Tensor, "N C"] | None = None
    consistency: Float[Tensor, "N 2"] | None = None
    odd: Int[Tensor, " N"] | None = None

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The rows of several batches, one after the other; frames are numbered through, those of detections too."""
        first, joined = 0, []
        for part in parts:
            found = replace(part.detections, frame=part.detections.frame + first)
            joined.append(replace(part, frame=part.frame + first, detections=found))
            first += int(part.frame.max()) + 1 if len(part) else 0
        detections = Detections.cat([part.detections for part in joined])
        return super().cat([replace(part, detections=detections) for part in joined])

    @property
    def ok(self) -> Bool[Tensor, " N"]:
        """Rows with `Status.OK`."""
        return self.status == Status.OK

    @property
    def cameras(self) -> Int[Tensor, " N"]:
        """How many cameras of a rig contribute; 1 or 0 of one camera alone."""
        if self.share is None:
            return self.t.isfinite().all(1).long()
        return (self.share > 0).sum(1)

    @property
    def rotation_vector(self) -> Float[Tensor, "N 3"]:
        """Rotation vectors in rad."""
        return rotations.log(self.R)

    @property
    def quaternion(self) -> Float[Tensor, "N 4"]:
        """Unit quaternions w, x, y, z with w >= 0."""
        return rotations.quaternion(self.R)

    @property
    def std(self) -> Float[Tensor, "N 6"]:
        """Standard deviations of t (mm) and of the rotation (rad), of everything."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    @property
    def noise_std(self) -> Float[Tensor, "N 6"]:
        """The same of the noise of the frame alone: repeatability."""
        return self.noise.diagonal(dim1=-2, dim2=-1).sqrt()

    def between(self, i: int | Tensor, j: int | Tensor) -> Motions:
        """The poses of rows j in the frames of rows i: how a target moved, or where one part is in another.

        What camera and target do to both rows alike cancels in the covariance as far as it does: the numbers of
        `systematic` are the same in all frames, those of the target where both rows are of one target.

        Args:
            i: number of a row, or (N,) numbers.
            j: the same; N motions, or one.
        """
        i, j = torch.broadcast_tensors(*(torch.as_tensor(k, device=self.t.device).reshape(-1) for k in (i, j)))
        one, two = self[i], self[j]
        back = one.R.mT
        arm = (two.t - one.t)[..., None]
        by_two = torch.zeros_like(two.covariance)
        by_two[:, :3, :3] = by_two[:, 3:, 3:] = back
        by_one = -by_two
        by_one[:, :3, 3:] = back @ rotations.skew(arm[..., 0])
        own, noise = self._own, self.noise
        common = by_one @ one.systematic + by_two @ two.systematic
        apart = torch.cat([by_one @ one.systematic, by_two @ two.systematic], -1)
        # numbers of two targets are others
        same = (one.target == two.target)[:, None, None]
        lens, prints = common[..., : self.of_camera], apart.unflatten(-1, (2, -1))[..., self.of_camera :].flatten(2)
        shared_by_both = torch.where(same, common @ common.mT, lens @ lens.mT + prints @ prints.mT)
        whole = by_one @ own[i] @ by_one.mT + by_two @ own[j] @ by_two.mT + shared_by_both
        alone = by_one @ noise[i] @ by_one.mT + by_two @ noise[j] @ by_two.mT
        return Motions(back @ two.R, (back @ arm)[..., 0], whole, alone)

    def relative_to(self, target: int) -> Poses:
        """Poses of the other targets in the frame of number ``target``: where one part is in another.

        One row a frame and target each, as `between` has them; their covariance is about that frame's axes. Where the
        reference has no pose, or is not sure, a row has its status and reason; where it has no row, `Status.NO_TARGET`.
        Of several copies of the reference, that of instance 0 counts.
        """
        index = (self.target != target).nonzero()[:, 0]
        at = ((self.target == target) & (self.instance == 0)).nonzero()[:, 0]
        row = torch.full((int(self.frame.max()) + 1 if len(self) else 0,), -1, device=at.device)
        reference = row.index_copy(0, self.frame[at], at)[self.frame[index]]
        there = reference >= 0
        reference = reference.clamp_min(0)
        other, base = self[index], self[reference]
        motion = self.between(reference, index).unknown_where(~there)
        codes, of_base = (torch.stack([rows.status, rows.reason], -1) for rows in (other, base))
        of_base = torch.where(there[:, None], of_base, of_base.new_tensor([int(Status.NO_TARGET), int(Reason.NONE)]))
        worse = (other.ok & (of_base[:, 0] != Status.OK))[:, None]
        status, reason = torch.where(worse, of_base, codes).unbind(-1)
        return replace(
            other,
            R=motion.R,
            t=motion.t,
            covariance=motion.covariance,
            noise=motion.noise,
            systematic=torch.full_like(other.systematic, torch.nan)[..., :0],
            status=status,
            reason=reason,
            R_alt=torch.full_like(other.R_alt, torch.nan),
            t_alt=torch.full_like(other.t_alt, torch.nan),
            rms_alt=torch.full_like(other.rms_alt, torch.nan),
            chi2_alt=torch.full_like(other.chi2_alt, torch.nan),
            of_camera=0,
        )

    @property
    def _own(self) -> Tensor:
        """Covariance (N, 6, 6) without what is common to all frames."""
        return self.covariance - self.systematic @ self.systematic.mT

    def se3(self) -> Se3:
        """The N poses as kornia's `Se3`, camera from target, mm; back by ``pose.so3.matrix(), pose.t``."""
        from kornia.geometry.liegroup import Se3
        from kornia.geometry.quaternion import Quaternion

        return Se3(Quaternion(self.quaternion), self.t)

    def moved(self, rotation: Tensor, translation: Tensor) -> Poses:
        """Poses of another frame fixed to the target, whose coordinates are ``rotation @ X_target + translation``.

        Args:
            rotation: (3, 3) or (N, 3, 3).
            translation: (3,) or (N, 3), mm (`Target.part_from_target`).
        """
        r_inv, t_inv = rotations.inverse(rotation.to(self.R), translation.to(self.t))
        r, t = rotations.compose(self.R, self.t, r_inv, t_inv)
        r_alt, t_alt = rotations.compose(self.R_alt, self.t_alt, r_inv, t_inv)
        # t' = t + R d with R = exp(w) R_est, so dt'/dw = -[R d]x
        jacobian = torch.eye(6, dtype=self.t.dtype, device=self.t.device).repeat(len(self), 1, 1)
        jacobian[:, :3, 3:] = -rotations.skew(t - self.t)
        return replace(self._spread(jacobian), R=r, t=t, R_alt=r_alt, t_alt=t_alt)

    def _spread(self, jacobian: Tensor) -> Poses:
        """The same poses with errors that are ``jacobian`` (N, 6, 6) or (6, 6) times those of these."""
        whole, noise = (jacobian @ matrix @ jacobian.mT for matrix in (self.covariance, self.noise))
        return replace(self, covariance=whole, noise=noise, systematic=jacobian @ self.systematic)

    def seen_from(self, rotation: Tensor, translation: Tensor) -> Poses:
        """Poses in another fixed frame whose coordinates are ``rotation @ X_cam + translation`` (hand-eye).

        Args:
            rotation: (3, 3) or (N, 3, 3).
            translation: (3,) or (N, 3), mm.
        """
        ra, ta = rotation.to(self.R), translation.to(self.t)
        r, t = rotations.compose(ra, ta, self.R, self.t)
        r_alt, t_alt = rotations.compose(ra, ta, self.R_alt, self.t_alt)
        turn = torch.zeros(*ra.shape[:-2], 6, 6, dtype=ra.dtype, device=ra.device)
        turn[..., :3, :3] = turn[..., 3:, 3:] = ra
        return replace(self._spread(turn), R=r, t=t, R_alt=r_alt, t_alt=t_alt)

"""Pinhole camera with Brown-Conrady (rational) or Kannala-Brandt distortion: projection, undistortion, Jacobian."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from torchpose.camera.fold import polynomial_fold, rational_fold
from torchpose.camera.tone import Tone
from torchpose.config import example
from torchpose.errors import ConfigError
from torchpose.geometry.covariance import covariance_fault

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

Model = Literal["brown_conrady", "kannala_brandt"]
# of normalised coordinates: a step of less leaves an error of its own square, about, which one more step squares again
_LAST_STEP = 1e-6
_MAX_ITERATIONS = 60
_NEAR = 1e-2  # of the root of the rounding: a step of Newton's from there is exact to rounding (derived: it squares)
# the tensors of a camera and what files call them
_FIELDS = {
    "matrix": "camera_matrix",
    "distortion": "distortion_coefficients",
    "covariance": "camera_matrix_covariance",
}


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsic calibration of one camera; the conventions and coefficients of OpenCV.

    Pixel centres lie at integer coordinates, u to the right, v down. With normalised coordinates x = X/Z, y = Y/Z and
    r^2 = x^2 + y^2, the distorted normalised point is

    - brown_conrady (Brown 1971; rational radial part as in OpenCV), coefficients k1 k2 p1 p2 [k3 [k4 k5 k6]]:
      s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
      (s x + 2 p1 x y + p2 (r^2 + 2 x^2), s y + p1 (r^2 + 2 y^2) + 2 p2 x y);
    - kannala_brandt (Kannala, Brandt 2006), coefficients k1 k2 k3 k4, with theta = atan(r):
      (x, y) theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r.

    Attributes:
        width: of the frame, px.
        height: of the frame, px.
        matrix: (3, 3) float64, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] px. Skew is rejected: none of the file formats but
            the bare matrix could hold it, and OpenCV ignores it.
        distortion: (0|4|5|8,) float64 for brown_conrady, (4,) for kannala_brandt. The 12 or 14 coefficients of OpenCV's
            thin-prism and tilted models are accepted where those beyond the eighth are zero.
        model: which of the two.
        covariance: float64 of fx, fy, cx, cy in px^2 (4, 4), or of these and all n coefficients of the distortion
            (4 + n, 4 + n), or None.
        tone: how stored grey values follow light; None where nothing is said, which counts as linear.
        adjustment: name of the adjustment that it comes from: a target measured there is correlated with it
            (`Target.cross_covariance`). None where there is none.

    Arguments may be anything that `torch.as_tensor` accepts. All methods take any leading dimensions (...), work in the
    dtype and on the device of their points, and are differentiable in the points, ``matrix`` and ``distortion``.

    Raises:
        ConfigError: a field is wrong; the message names it as the native camera file does.
    """

    width: int
    height: int
    matrix: Tensor
    distortion: Tensor
    model: Model = "brown_conrady"
    covariance: Tensor | None = None
    tone: Tone | None = None
    adjustment: str | None = None

    if TYPE_CHECKING:  # of tensors the fields are made by __post_init__

        def __init__(
            self,
            width: int,
            height: int,
            matrix: Tensor | np.ndarray | Sequence[Sequence[float]],
            distortion: Tensor | np.ndarray | Sequence[float],
            model: Model = "brown_conrady",
            covariance: Tensor | np.ndarray | Sequence[Sequence[float]] | None = None,
            tone: Tone | None = None,
            **adjustment: str | None,
        ) -> None: ...

    @classmethod
    def ideal(cls, width: int, height: int, focal: float) -> Camera:
        """A camera without distortion, its optical axis in the middle of the frame; all in px."""
        return cls(width, height, [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], [])

    def __post_init__(self) -> None:
        for name, field in _FIELDS.items():
            value = getattr(self, name)
            if value is None and name == "covariance":
                continue
            if not (isinstance(value, Tensor) and value.is_floating_point()):
                try:
                    value = torch.as_tensor(value, dtype=torch.float64)
                except (ValueError, TypeError, RuntimeError):
                    raise ConfigError(f"{field}: is not a table of numbers; write numbers only") from None
            if not bool(value.detach().isfinite().all()):
                raise ConfigError(f"{field}: holds NaN or infinity; calibrate again or correct the entry")
            object.__setattr__(self, name, value)
        for field, size in (("image_width", self.width), ("image_height", self.height)):
            if isinstance(size, bool) or not isinstance(size, int) or size <= 0:
                raise ConfigError(f"{field}: is {size!r}; give the frame size as a positive integer, in px")
        self._check_matrix()
        self._check_distortion()
        if self.covariance is not None:
            _check_covariance(self.covariance.detach(), len(self.distortion))

    def _check_matrix(self) -> None:
        if self.matrix.shape != (3, 3):
            raise ConfigError(f"camera_matrix: has shape {tuple(self.matrix.shape)}; give 3 rows of 3")
        (fx, skew, _), (below, fy, _), last = self.matrix.tolist()
        if last != [0, 0, 1]:
            raise ConfigError(f"camera_matrix: last row is {last}; write [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if skew or below:
            raise ConfigError(f"camera_matrix: has a skew entry ({skew or below}); calibrate without skew and write 0")
        for name, focal in (("fx", fx), ("fy", fy)):
            if focal <= 0:
                raise ConfigError(f"camera_matrix: focal length {name} is {focal}; give a positive number of px")

    def _check_distortion(self) -> None:
        if self.model not in get_args(Model):
            raise ConfigError(f"distortion_model: is {self.model!r}; known are {', '.join(get_args(Model))}")
        if self.distortion.ndim != 1:
            raise ConfigError(f"distortion_coefficients: has shape {tuple(self.distortion.shape)}; give one list")
        count = len(self.distortion)
        if self.model == "brown_conrady" and count in (12, 14):
            if bool(self.distortion[8:].any()):
                raise ConfigError(
                    "distortion_coefficients: thin-prism or tilted terms are not zero; calibrate with 8 coefficients"
                )
            object.__setattr__(self, "distortion", self.distortion[:8])
        elif count not in ((4,) if self.model == "kannala_brandt" else (0, 4, 5, 8)):
            wanted = "k1 k2 k3 k4" if self.model == "kannala_brandt" else "none or k1 k2 p1 p2 [k3 [k4 k5 k6]]"
            raise ConfigError(f"distortion_coefficients: {count} coefficients for {self.model}; give {wanted}")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Camera:
        """Reads a camera file, see `torchpose.camera.formats.load`; ``FILE#cam1`` picks one of several."""
        from torchpose.camera import formats

        return formats.load(example(path, "cameras"))

    def save(
        self, path: str | os.PathLike[str], format: Literal["opencv", "json", "ros", "kalibr", "colmap"] | None = None
    ) -> None:
        """Writes the camera file in one piece, see `torchpose.camera.formats.save`."""
        from torchpose.camera import formats

        formats.save(self, path, format)

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Same as `Tensor.to` on every tensor; ``self`` where nothing changes. Nothing is checked or read again."""
        tensors = {name: value for name in _FIELDS if (value := getattr(self, name)) is not None}
        moved = {name: value.to(*args, **kwargs) for name, value in tensors.items()}
        if all(moved[name] is value for name, value in tensors.items()):
            return self
        # what is derived once goes along: another device would have to wait for it
        _, known = self.fold_radius, self._any_coefficient
        camera = copy(self)
        camera.__dict__.update(moved, _coefficients=(_version(moved["distortion"]), known))
        return camera

    def reduced(self, factor: int) -> Camera:
        """The camera of frames of which blocks of ``factor`` x ``factor`` px make one; without the covariance."""
        matrix = self.matrix.clone()
        matrix[:2, 2] -= 0.5 * (factor - 1)
        matrix[:2] /= factor
        camera = copy(self)
        size = {"width": self.width // factor, "height": self.height // factor}
        camera.__dict__.update(size, matrix=matrix, covariance=None)
        return camera

    def pinhole(self, R: Tensor | None = None, t: Tensor | None = None) -> PinholeCamera:
        """Kornia's camera of the same matrix at B poses; it has no distortion, its pixels are ideal ones.

        Args:
            R: (B, 3, 3) rotations, target to camera, such as `Poses.R`; the identity (B = 1) where there are none.
            t: (B, 3) translations, mm. Kornia's world is the target, its extrinsics are these poses.
        """
        from kornia.geometry.camera import PinholeCamera

        matrix = self.matrix if R is None else self.matrix.to(R)
        extrinsics = torch.eye(4).to(matrix).repeat(1 if R is None else len(R), 1, 1)
        if R is not None and t is not None:
            extrinsics[:, :3, :3], extrinsics[:, :3, 3] = R, t.to(R)
        intrinsics = torch.block_diag(matrix, torch.ones(1, 1).to(matrix)).expand_as(extrinsics)
        height, width = (matrix.new_full((len(extrinsics),), size) for size in (self.height, self.width))
        return PinholeCamera(intrinsics, extrinsics, height, width)

    @classmethod
    def from_pinhole(cls, camera: PinholeCamera, index: int = 0) -> Camera:
        """The camera number ``index`` of kornia's batch; its extrinsics are poses and stay behind.

        Raises:
            ConfigError: its matrix has skew, or another field is wrong.
        """
        width, height = (int(size[index]) for size in (camera.width, camera.height))
        return cls(width, height, camera.camera_matrix[index].double(), [])

    @property
    def distorts(self) -> bool:
        """Whether any coefficient moves a point, or might (while it is being estimated)."""
        return self.model == "kannala_brandt" or self.distortion.requires_grad or self._any_coefficient

    @property
    def lens_stated(self) -> bool:
        """Whether the covariance is that of the distortion, too."""
        return self.covariance is not None and len(self.covariance) > 4

    @property
    def _any_coefficient(self) -> bool:
        """Whether one is not zero; looked at anew only where the tensor was written to: a GPU would be waited for."""
        version, known = self.__dict__.get("_coefficients", (None, False))
        if version != _version(self.distortion):
            known = bool(self.distortion.detach().any())
            self.__dict__["_coefficients"] = _version(self.distortion), known
        return known

    @cached_property
    def fold_radius(self) -> float:
        """Largest normalised radius r up to which the radial distortion has one inverse (inf where it always has).

        Beyond it the model folds back onto the image, or a pole of the rational model is near (`camera.fold`).
        """
        d = np.zeros(8)
        d[: len(self.distortion)] = self.distortion.tolist()
        if self.model == "kannala_brandt":
            return polynomial_fold(d[:4])
        return rational_fold(d[[0, 1, 4]], d[5:8])

    def project(self, points_camera: Tensor) -> Tensor:
        """Pixels (..., 2) of points (..., 3) in the camera frame, mm. NaN where Z <= 0: there is no image."""
        z = points_camera[..., 2:]
        ahead = z > 0
        pixels = self.distort(points_camera[..., :2] / torch.where(ahead, z, torch.ones_like(z)))
        return torch.where(ahead, pixels, torch.nan)

    def distort(self, xy: Tensor) -> Tensor:
        """Pixels (..., 2) of undistorted normalised coordinates (..., 2), x = X/Z, y = Y/Z."""
        focal, center = self._intrinsics(xy)
        return torch.stack(self._warp(*xy.unbind(-1), slopes=False), -1) * focal + center

    def linearised(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """`distort` and `J_distort` at once."""
        focal, center = self._intrinsics(xy)
        u, v, j_xx, j_xy, j_yy = self._warp(*xy.unbind(-1))
        jacobian = torch.stack([j_xx, j_xy, j_xy, j_yy], -1).unflatten(-1, (2, 2)) * focal[:, None]
        return torch.stack([u, v], -1) * focal + center, jacobian

    def J_distort(self, xy: Tensor) -> Tensor:
        """Jacobian (..., 2, 2) of `distort`: d(u, v)/d(x, y), px per unit of normalised coordinates."""
        return torch.stack(self.slopes(*xy.unbind(-1)), -1).unflatten(-1, (2, 2))

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The entries du/dx, du/dy, dv/dx, dv/dy (...) of `J_distort` at x, y (...), unstacked, for many points."""
        (fx, fy), _ = self._intrinsics(x)
        _, _, j_xx, j_xy, j_yy = self._warp(x, y)
        return j_xx * fx, j_xy * fx, j_xy * fy, j_yy * fy

    def undistort_points(self, uv: Tensor) -> Tensor:
        """Undistorted normalised coordinates (..., 2) of pixels (..., 2): the inverse of `distort`, to rounding.

        Newton's method with the analytic Jacobian; steps are halved where the residual does not fall or the iterate
        would pass `fold_radius`. The gradient follows from the implicit function theorem (first derivatives only).
        NaN where there is no valid inverse: the pixel lies beyond the image of `fold_radius`, or is not finite.
        """
        focal, center = self._intrinsics(uv)
        xy_distorted = (uv - center) / focal
        if not self.distorts:
            return xy_distorted
        x, y, *_ = self._undistorted(*xy_distorted.unbind(-1))
        return torch.stack([x, y], -1)

    def rays(self, uv: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Undistorted x, y (...) of pixels (..., 2), see `undistort_points`, and `slopes` there, which cost nothing."""
        focal, center = self._intrinsics(uv)
        (fx, fy), (x, y) = focal, ((uv - center) / focal).unbind(-1)
        if not self.distorts:
            none = torch.zeros_like(x)
            return x, y, (fx.expand_as(x), none, none, fy.expand_as(x))
        x, y, j_xx, j_xy, j_yy = self._undistorted(x, y)
        return x, y, (j_xx * fx, j_xy * fx, j_xy * fy, j_yy * fy)

    def _undistorted(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Undistorted x, y of distorted ones, and xx, xy, yy of the Jacobian within a last step of there."""
        with torch.no_grad():
            x, y = self._invert(u.detach().contiguous(), v.detach().contiguous())
        # one more Newton step, differentiable: d(x, y) = J^-1 (d(u, v) - what the coefficients move)
        x_distorted, y_distorted, *jacobian = self._warp(x, y)
        j_xx, j_xy, j_yy = (j.detach() for j in jacobian)
        dx, dy = _newton_step(x_distorted - u, y_distorted - v, j_xx, j_xy, j_yy)
        return x - dx, y - dy, j_xx, j_xy, j_yy

    def _invert(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Undistorted x, y of distorted ones, to within the last step that `undistort_points` makes."""
        # plain steps reach nearly all pixels of nearly all lenses, in a third of the calls
        x, y = u, v
        for _ in range(2):
            x_distorted, y_distorted, *jacobian = self._warp(x, y)
            dx, dy = _newton_step(x_distorted - u, y_distorted - v, *jacobian)
            x, y = x - dx, y - dy
        x_distorted, y_distorted = self._warp(x, y, slopes=False)
        dx, dy = _newton_step(x_distorted - u, y_distorted - v, *jacobian)
        x, y = x - dx, y - dy
        sure = (torch.hypot(dx, dy) < _LAST_STEP) & (torch.hypot(x, y) < 0.9 * self.fold_radius)
        if bool(sure.all()):
            return x, y
        slow = self._invert_slowly(u, v)
        return torch.where(sure, x, slow[0]), torch.where(sure, y, slow[1])

    def _invert_slowly(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """The same wherever there is an inverse; NaN elsewhere."""
        eps = torch.finfo(u.dtype).eps
        limit = self.fold_radius
        radius = torch.hypot(u, v)
        near = _NEAR * math.sqrt(eps) * (1 + radius)
        inside = (0.99 * limit / radius.clamp_min(eps)).clamp_max(1)
        x, y = inside * u, inside * v
        x_distorted, y_distorted, *jacobian = self._warp(x, y)
        ex, ey = x_distorted - u, y_distorted - v
        error = torch.hypot(ex, ey)
        fraction = torch.ones_like(error)
        for _ in range(_MAX_ITERATIONS):
            if bool(((error <= near) | ~error.isfinite() | (fraction < 1e-6)).all()):
                break
            dx, dy = _newton_step(ex, ey, *jacobian)
            x_trial, y_trial = x - fraction * dx, y - fraction * dy
            x_distorted, y_distorted, *trial_jacobian = self._warp(x_trial, y_trial)
            ex_trial, ey_trial = x_distorted - u, y_distorted - v
            trial_error = torch.hypot(ex_trial, ey_trial)
            better = (trial_error < error) & (torch.hypot(x_trial, y_trial) < limit)
            old = x, y, ex, ey, error, *jacobian
            new = x_trial, y_trial, ex_trial, ey_trial, trial_error, *trial_jacobian
            x, y, ex, ey, error, *jacobian = (torch.where(better, b, a) for a, b in zip(old, new, strict=True))
            fraction = torch.where(better, 1.0, 0.5 * fraction)
        j_xx, j_xy, j_yy = jacobian
        valid = (error <= near.clamp_min(1e4 * eps)) & (j_xx * j_yy - j_xy * j_xy > 0)
        return torch.where(valid, x, torch.nan), torch.where(valid, y, torch.nan)

    def _intrinsics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        m = self.matrix.to(like)
        return m.diagonal()[:2], m[:2, 2]

    def _warp(self, x: Tensor, y: Tensor, *, slopes: bool = True) -> tuple[Tensor, ...]:
        """Distorted normalised x, y; with ``slopes`` the xx, xy, yy of the Jacobian, symmetric in both models."""
        r2 = torch.addcmul(x * x, y, y)
        if self.model == "kannala_brandt":
            k1, k2, k3, k4 = self.distortion.to(x).unbind()
            small = r2 < 1e-6
            r2_safe = torch.where(small, torch.ones_like(r2), r2)
            r = r2_safe.sqrt()
            theta_over_r = torch.where(small, 1 - r2 / 3 + r2 * r2 / 5, torch.atan(r) / r)
            t2 = theta_over_r * theta_over_r * r2
            s = theta_over_r * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
            if not slopes:
                return s * x, s * y
            growth = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + r2)
            # 2 ds/d(r^2), and its series at the axis
            slope = torch.where(small, 2 * (k1 - 1 / 3) + r2 * (4 * k2 - 4 * k1 + 0.8), (growth - s) / r2_safe)
            return s * x, s * y, s + slope * x * x, slope * x * y, s + slope * y * y
        d = self.distortion.to(x)
        if not len(d):
            one = torch.ones_like(x)
            return (x, y, one, torch.zeros_like(x), one) if slopes else (x, y)
        k1, k2, p1, p2, *more = d.unbind()
        along, below = [k1, k2, *more[:1]], more[1:]
        twice = [*(2 * (power + 1) * k for power, k in enumerate(along))] if slopes else []
        s = 1 + r2 * _polynomial(r2, along)
        if below:
            denominator = 1 + r2 * _polynomial(r2, below)
            s = s / denominator
        # 2 (p1 y + p2 x) x + p2 r^2 is OpenCV's 2 p1 x y + p2 (r^2 + 2 x^2)
        px, py = 2 * p2 * x, 2 * p1 * y
        s_tangential = s + (px + py)
        bent = torch.addcmul(s_tangential * x, r2, p2), torch.addcmul(s_tangential * y, r2, p1)
        if not slopes:
            return bent
        slope = _polynomial(r2, twice)
        if below:
            slope = (slope - s * _polynomial(r2, [2 * (power + 1) * k for power, k in enumerate(below)])) / denominator
        sx = slope * x
        return (
            *bent,
            torch.addcmul(s_tangential + 2 * px, sx, x),
            torch.addcmul(2 * (p1 * x + p2 * y), sx, y),
            torch.addcmul(s_tangential + 2 * py, slope * y, y),
        )


def _polynomial(at: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """c0 + c1 at + c2 at^2 + ... (Horner)."""
    value = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = torch.addcmul(c, at, value)
    return value


def _check_covariance(covariance: Tensor, coefficients: int) -> None:
    field, fix = "camera_matrix_covariance", "give the covariance of fx fy cx cy in px^2"
    whole = 4 + coefficients
    if covariance.shape == (whole, whole) and coefficients:
        field, fix = "intrinsics_covariance", f"give the covariance of fx fy cx cy and {coefficients} coefficients"
    elif covariance.shape != (4, 4):
        of_all = f", or {whole} x {whole} with the distortion" if coefficients else ""
        raise ConfigError(f"{field}: has shape {tuple(covariance.shape)}; give 4 x 4 for fx fy cx cy{of_all}")
    if fault := covariance_fault(covariance):
        raise ConfigError(f"{field}: {fault}; {fix}")


def _newton_step(ex: Tensor, ey: Tensor, j_xx: Tensor, j_xy: Tensor, j_yy: Tensor) -> tuple[Tensor, Tensor]:
    """J^-1 e by Cramer's rule."""
    determinant = j_xx * j_yy - j_xy * j_xy
    return (j_yy * ex - j_xy * ey) / determinant, (j_xx * ey - j_xy * ex) / determinant


def _version(tensor: Tensor) -> int:
    """How often a tensor was written to, as far as torch counts."""
    return -1 if tensor.is_inference() else tensor._version

"""Pinhole camera with Brown-Conrady (rational) or Kannala-Brandt distortion: projection, undistortion, Jacobian."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

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
# (derived: that is rounding)
_LAST_STEP = 1e-4
_PLAIN_STEPS = 3
_MAX_ITERATIONS = 60
_NEAR = 1e-2  # of the root of the rounding: a step of Newton's from there is exact to rounding (derived: it squares)
_NONE = torch.zeros(0)
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
        return self._lens(xy).bent(xy.movedim(-1, 0)).movedim(0, -1) * focal + center

    def linearised(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """`distort` and `J_distort` at once."""
        focal, center = self._intrinsics(xy)
        bent, slopes = self._lens(xy).linearised(xy.movedim(-1, 0))
        (xx, yy), mixed = slopes
        jacobian = torch.stack([xx, mixed, mixed, yy], -1).unflatten(-1, (2, 2)) * focal[:, None]
        return bent.movedim(0, -1) * focal + center, jacobian

    def J_distort(self, xy: Tensor) -> Tensor:
        """Jacobian (..., 2, 2) of `distort`: d(u, v)/d(x, y), px per unit of normalised coordinates."""
        return self.linearised(xy)[1]

    def undistort_points(self, uv: Tensor) -> Tensor:
        """Undistorted normalised coordinates (..., 2) of pixels (..., 2): the inverse of `distort`, to rounding.

        Newton's method with the analytic Jacobian; steps are halved where the residual does not fall or the iterate
        would pass `fold_radius`. The gradient follows from the implicit function theorem (first derivatives only).
        NaN where there is no valid inverse: the pixel lies beyond the image of `fold_radius`, or is not finite.
        """
        focal, center = self._intrinsics(uv)
        bent = (uv - center) / focal
        return self._undistorted(bent.movedim(-1, 0))[0].movedim(0, -1) if self.distorts else bent

    def rays(self, uv: Tensor) -> tuple[Tensor, Slopes]:
        """Undistorted x, y (2, ...) of pixels (2, ...), see `undistort_points`, and the slopes there, which cost
        nothing."""
        focal, center = (v.view(2, *[1] * (uv.ndim - 1)) for v in self._intrinsics(uv))
        bent = (uv - center) / focal
        return self._undistorted(bent) if self.distorts else (bent, _straight(bent))

    def _undistorted(self, bent: Tensor) -> tuple[Tensor, Slopes]:
        """Undistorted x, y (2, ...) of distorted ones, and the slopes within a last step of there."""
        lens, bent = self._lens(bent), bent.contiguous()
        with torch.no_grad():
            xy = self._invert(lens, bent.detach())
        # one more Newton step, differentiable: d(x, y) = J^-1 (d(u, v) - what the coefficients move)
        found, slopes = lens.linearised(xy)
        slopes = Slopes(*(v.detach() for v in slopes))
        return xy - slopes.inverse().of(found - bent), slopes

    def _invert(self, lens: _Lens, bent: Tensor) -> Tensor:
        """Undistorted x, y (2, ...) of distorted ones, to within the last step that `undistort_points` makes."""
        # plain steps reach nearly all pixels of nearly all lenses, in a third of the calls
        xy = bent
        for number in range(_PLAIN_STEPS):
            found, slopes = lens.linearised(xy)
            step = slopes.inverse().of(found - bent)
            xy = xy - step
            if number:
                sure = (_square(step) < _LAST_STEP**2) & (_square(xy) < (0.9 * self.fold_radius) ** 2)
                if bool(sure.all()):
                    return xy
        return torch.where(sure, xy, self._invert_slowly(lens, bent))

    def _invert_slowly(self, lens: _Lens, bent: Tensor) -> Tensor:
        """The same wherever there is an inverse; NaN elsewhere."""
        eps = torch.finfo(bent.dtype).eps
        limit = self.fold_radius
        radius = torch.hypot(*bent)
        near = _NEAR * math.sqrt(eps) * (1 + radius)
        xy = (0.99 * limit / radius.clamp_min(eps)).clamp_max(1) * bent
        found, slopes = lens.linearised(xy)
        off = found - bent
        error = torch.hypot(*off)
        fraction = torch.ones_like(error)
        for _ in range(_MAX_ITERATIONS):
            if bool(((error <= near) | ~error.isfinite() | (fraction < 1e-6)).all()):
                break
            trial = xy - fraction * slopes.inverse().of(off)
            found, trial_slopes = lens.linearised(trial)
            trial_off = found - bent
            trial_error = torch.hypot(*trial_off)
            better = (trial_error < error) & (torch.hypot(*trial) < limit)
            old, new = (xy, off, error, *slopes), (trial, trial_off, trial_error, *trial_slopes)
            xy, off, error, *both = (torch.where(better, b, a) for a, b in zip(old, new, strict=True))
            slopes = Slopes(*both)
            fraction = torch.where(better, 1.0, 0.5 * fraction)
        valid = (error <= near.clamp_min(1e4 * eps)) & (slopes.determinant > 0)
        return torch.where(valid, xy, torch.nan)

    def _intrinsics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        m = self.matrix.to(like)
        return m.diagonal()[:2], m[:2, 2]

    def _lens(self, like: Tensor) -> _Lens:
        d = self.distortion.to(like)
        if self.model == "kannala_brandt":
            return _Lens("fisheye", d.unbind())
        if not len(d):
            return _Lens("none")
        k1, k2, _, _, *more = d.unbind()
        # of x and y: 2 (p1 y + p2 x) x + p2 r^2 is OpenCV's 2 p1 x y + p2 (r^2 + 2 x^2)
        aside = d[2:4].flip(0).view(2, *[1] * (like.ndim - 1))
        return _Lens("brown", (k1, k2, *more[:1]), tuple(more[1:]), aside, 2 * aside)


class Slopes(NamedTuple):
    """Symmetric 2 x 2 matrices as planes: xx and yy (2, ...), and xy (...). Of a lens d(distorted)/d(undistorted),
    normalised coordinates both; its Jacobian is symmetric in all models."""

    straight: Tensor
    mixed: Tensor

    @property
    def determinant(self) -> Tensor:
        xx, yy = self.straight.unbind()
        return torch.addcmul(xx * yy, self.mixed, self.mixed, value=-1)

    def inverse(self) -> Slopes:
        """By Cramer's rule."""
        over = self.determinant.reciprocal()
        return Slopes(self.straight.flip(0) * over, self.mixed * -over)

    def of(self, xy: Tensor) -> Tensor:
        """Times vectors (2, ...)."""
        return torch.addcmul(self.straight * xy, self.mixed, xy.flip(0))


def _straight(xy: Tensor) -> Slopes:
    """Of no lens."""
    return Slopes(torch.ones_like(xy), torch.zeros_like(xy[0]))


class _Lens(NamedTuple):
    """What a lens does to planes x, y (2, ...): its kind, radial coefficients of numerator and denominator, and the
    tangential ones p2, p1 (2, ...), and twice these."""

    kind: Literal["none", "brown", "fisheye"]
    along: Sequence[Tensor] = ()
    below: Sequence[Tensor] = ()
    aside: Tensor = _NONE
    twice: Tensor = _NONE

    def bent(self, xy: Tensor) -> Tensor:
        """Distorted x, y (2, ...)."""
        if self.kind == "none":
            return xy
        r2 = _square(xy)
        if self.kind == "fisheye":
            return self._fisheye(r2)[0] * xy
        x, y = (self.twice * xy).unbind()
        return torch.addcmul((self._radial(r2)[0] + x + y) * xy, r2, self.aside)

    def linearised(self, xy: Tensor) -> tuple[Tensor, Slopes]:
        """Distorted x, y, and the slopes there."""
        if self.kind == "none":
            return xy, _straight(xy)
        r2 = _square(xy)
        if self.kind == "fisheye":
            s, slope = self._fisheye(r2)
            steep = slope * xy
            return s * xy, Slopes(torch.addcmul(s, steep, xy), steep[0] * xy[1])
        s, denominator = self._radial(r2)
        slope = _polynomial(r2, [2 * (power + 1) * k for power, k in enumerate(self.along)])
        if denominator is not None:
            below = _polynomial(r2, [2 * (power + 1) * k for power, k in enumerate(self.below)])
            slope = (slope - s * below) / denominator
        lean, steep, (x, y) = self.twice * xy, slope * xy, xy.unbind()
        lean_x, lean_y = lean.unbind()
        s = s + lean_x + lean_y
        p2, p1 = self.twice.unbind()
        across = torch.addcmul(p1 * x, p2, y)
        slopes = Slopes(torch.add(s, lean, alpha=2).addcmul(steep, xy), across.addcmul(steep[0], y))
        return torch.addcmul(s * xy, r2, self.aside), slopes

    def _radial(self, r2: Tensor) -> tuple[Tensor, Tensor | None]:
        """Scale of x and y at r^2, and the polynomial below, if there is one."""
        s = 1 + r2 * _polynomial(r2, self.along)
        if not self.below:
            return s, None
        denominator = 1 + r2 * _polynomial(r2, self.below)
        return s / denominator, denominator

    def _fisheye(self, r2: Tensor) -> tuple[Tensor, Tensor]:
        """Scale of x and y at r^2, and twice its derivative by r^2."""
        k1, k2, k3, k4 = self.along
        small = r2 < 1e-6
        r2_safe = torch.where(small, torch.ones_like(r2), r2)
        r = r2_safe.sqrt()
        theta_over_r = torch.where(small, 1 - r2 / 3 + r2 * r2 / 5, torch.atan(r) / r)
        t2 = theta_over_r * theta_over_r * r2
        s = theta_over_r * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        growth = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + r2)
        # with its series at the axis
        return s, torch.where(small, 2 * (k1 - 1 / 3) + r2 * (4 * k2 - 4 * k1 + 0.8), (growth - s) / r2_safe)


def _square(xy: Tensor) -> Tensor:
    """x^2 + y^2 (...) of (2, ...)."""
    x, y = xy.unbind()  # sums of planes of two rows take twice as long
    return torch.addcmul(x * x, y, y)


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


def _version(tensor: Tensor) -> int:
    """How often a tensor was written to, as far as torch counts."""
    return -1 if tensor.is_inference() else tensor._version

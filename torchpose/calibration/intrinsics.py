"""Intrinsics of a camera from views of known points, with their covariance and what there is to doubt about them."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import pnp
from torchpose.calibration.bundle import Bundle, adjust
from torchpose.calibration.lenses import slopes
from torchpose.calibration.plate import Plate
from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.camera.model import Model
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.geometry.projection import image_by_point

LENS_MODELS: dict[str, tuple[Model, tuple[str, ...]]] = {
    "pinhole": ("brown_conrady", ()),
    "brown4": ("brown_conrady", ("k1", "k2", "p1", "p2")),
    "brown5": ("brown_conrady", ("k1", "k2", "p1", "p2", "k3")),
    "rational8": ("brown_conrady", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kannala_brandt": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
}
"""Name of a lens model to the camera model and its coefficients, in the order of the camera file."""

MIN_POINTS = 4  # of a view that counts
_START_FOCALS = (0.6, 1.0, 1.8, 3.5)  # over the width, tried where no camera is given
_START_SIGMA = 1.0  # px, of points without a covariance, until their residuals tell
_OUTLIER = 27.6  # chi-squared of a point beyond which it is left out: 1e-6 of good points
_MEDIAN = 2 * math.log(2)  # of chi-squared with two degrees of freedom
_RIM_OUTLIER, _RIM_MEDIAN = 38.3, 5.35  # the same of a ring, with six degrees of freedom
_ROUNDS = 4  # of leaving out points and finding the common error
_PLATE_ROUNDS = 1  # more where the plate has unknowns: the first fit of its places
_WIDE_SIGMA = 1e-3  # of a focal length, above which views are called too alike
_LITTLE_TILT_DEG = 15.0  # between the views' normals, below which they are
_LARGE_ERROR = 1.0  # px, of all points, above which something else than their noise is wrong
_MOST_RESIDUAL = 0.1  # RMS over the distance between points: from there on points are mixed up, not measured badly
_LEAST_AGREEING = 0.5  # of the points, of a calibration that more than chance explains (a convention)
_LEAST_FACTOR = 0.25  # of numerator and denominator of a rational lens: a real one's stay above, what cancels does not
_OPEN_COEFFICIENT = 1.0  # standard deviation of k4: as much as the coefficient of a real lens
_LITTLE_COVER = 0.5  # of the frame's width or height, below which distortion is extrapolated
_DIGITS = 12  # of the name of an adjustment
_SINGULAR = 1e-12  # least eigenvalue of the information, scaled to a unit diagonal


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate_intrinsics`."""

    camera: Camera  # with its covariance
    covariance: Float[Tensor, "n n"]  # of fx, fy, cx, cy (px) and the distortion
    joint: Float[Tensor, "u u"]  # of these and the unknowns of the plate
    names: tuple[str, ...]  # of the intrinsics
    views: Views  # that were used, with the points that were used
    bundle: Bundle  # poses and residuals of these
    left_out: int  # points left out because they contradict the others
    chi2: float  # sum over all points
    degrees: float  # of freedom
    # px per axis, that had to be added to every point (print, flatness, lens model) to make the reduced chi-squared 1;
    # 0 where the covariances of the points explain the residuals
    common_sigma_px: float
    plate: Plate | None = None  # what was unknown of the target
    seen: Views | None = None  # all views that there were
    warnings: list[str] = field(default_factory=list)  # what makes the result doubtful, one sentence each

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals, px."""
        return float(self.bundle.residual.square().sum(-1).mean().sqrt())

    @property
    def reduced_chi2(self) -> float:
        return self.chi2 / self.degrees

    @property
    def pose_covariance(self) -> Float[Tensor, "N 6 6"]:
        """Of the views' poses, the uncertainty of the intrinsics and of the plate included."""
        gain = self.bundle.gain
        return self.bundle.pose_covariance + gain @ self.joint @ gain.mT


def start_cameras(width: int, height: int, lens: str) -> list[Camera]:
    """Cameras without distortion, of different focal lengths, to start from where nothing is known.

    Raises:
        ConfigError: an unknown lens model.
    """
    model, names = coefficients_of(lens)
    ideal = [Camera.ideal(width, height, focal * width) for focal in _START_FOCALS]
    return [replace(camera, model=model, distortion=camera.matrix.new_zeros(len(names))) for camera in ideal]


def coefficients_of(name: str) -> tuple[Model, tuple[str, ...]]:
    if name not in LENS_MODELS:
        raise ConfigError(f"--model: {name!r} is not known; choose one of {', '.join(LENS_MODELS)}")
    return LENS_MODELS[name]


def with_lens(camera: Camera, lens: str) -> Camera:
    """The camera with the coefficients of another lens model: cut off or filled up with zeros; none of another kind.

    Raises:
        ConfigError: an unknown lens model.
    """
    model, names = coefficients_of(lens)
    old = camera.distortion if camera.model == model else camera.distortion[:0]
    distortion = torch.nn.functional.pad(old, (0, len(names) - len(old)))
    return replace(camera, model=model, distortion=distortion, covariance=None).to(torch.float64)


@checked
def calibrate_intrinsics(
    views: Views, starts: list[Camera], *, lens: str = "brown5", plate: Plate | None = None
) -> Calibration:
    """Maximum-likelihood intrinsics of one camera and the poses of its views.

    All points of all views are adjusted together (`torchpose.calibration.bundle.adjust`). Points that contradict the
    others by more than 1e-6 of good ones would are left out. Where the residuals are larger than the covariances of the
    points say, an error common to all points and axes is added to these (variance component by its residuals, as
    Foerstner 1979), so that the covariance of the result covers it. Errors that repeat in every view, such as those of
    the print, are counted as such where ``plate`` has them, and else as if they did not repeat.

    Args:
        views: a covariance of zero means unknown; the common error then stands for it.
        starts: cameras to start from; the one that fits best is taken. `start_cameras` where nothing is known.
        lens: a name of `LENS_MODELS`.
        plate: what is unknown of the target beside its poses; None where its points are exact.

    Raises:
        ConfigError: too few views or points, views that do not determine the intrinsics, or no convergence.
    """
    _, coefficients = coefficients_of(lens)
    names, seen = ("fx", "fy", "cx", "cy", *coefficients), views
    views = views.of_views(views.counts >= MIN_POINTS)
    _check_count(views, len(names))
    fits = [first_fit(views, with_lens(start, lens).to(views.pixels)) for start in starts]
    best = min(filter(None, fits), key=lambda one: _robust_cost(one[1], len(views.view)), default=None)
    if best is None:
        raise ConfigError("INPUT: no pose explains the views; give --camera to start from and check the target")
    before = len(best[0].view)
    views, bundle, common = weigh(*best, len(names), plate)
    if not bundle.converged:
        raise ConfigError("INPUT: calibration did not converge; use a simpler --model or more varied views")
    check_residuals(views, bundle.residual, before)
    joint = covariance_of(bundle.information, names)
    covariance = joint[: len(names), : len(names)]
    check_lens(bundle.camera, covariance, names)
    return Calibration(
        replace(bundle.camera, covariance=covariance, adjustment=name_of(joint, bundle.camera.matrix)),
        covariance,
        joint,
        names,
        views,
        bundle,
        before - len(views.view),
        float(bundle.chi2.sum()),
        channels(views, bundle)[0].redundancy(common.px),
        common.px,
        plate,
        seen,
        doubts_of(views, bundle.camera, bundle.R, covariance, common.px),
    )


def name_of(*results: Tensor) -> str:
    """A name of an adjustment that two of different frames do not share."""
    digest = hashlib.sha256(b"".join(result.detach().double().cpu().numpy().tobytes() for result in results))
    return f"ba-{digest.hexdigest()[:_DIGITS]}"


def locate_views(views: Views, camera: Camera) -> tuple[Views, Bundle]:
    """Poses of the views of a camera that is known; points are weighed and left out as in `calibrate_intrinsics`.

    Raises:
        ConfigError: no view has a pose.
    """
    return _located(views, camera, None)[:2]


def measure_plate(views: Views, camera: Camera, plate: Plate) -> Calibration:
    """What is unknown of a plate seen by a camera that is known, held as it is; its covariance is carried through.

    Raises:
        ConfigError: no view has a pose, or the views do not determine the plate.
    """
    seen, n = views, 4 + len(camera.distortion)
    views, bundle, common = _located(views, camera, plate)
    if not bundle.converged:
        raise ConfigError("INPUT: the target could not be measured; use more varied views")
    names = ("fx", "fy", "cx", "cy", *(f"d{k}" for k in range(1, n - 3)))
    held = stated_intrinsics(camera).to(bundle.information)
    joint = carried(bundle.information, held, ())
    degrees = channels(views, bundle)[0].redundancy(common.px)
    left_out, chi2 = len(seen.view) - len(views.view), float(bundle.chi2.sum())
    return Calibration(camera, held, joint, names, views, bundle, left_out, chi2, degrees, common.px, plate, seen)


def stated_intrinsics(camera: Camera) -> Float[Tensor, "n n"]:
    """Covariance of all intrinsics, zero of those of which the camera states none."""
    covariance = camera.matrix.new_zeros(4 + len(camera.distortion), 4 + len(camera.distortion))
    if camera.covariance is not None:
        known = len(camera.covariance)
        covariance[:known, :known] = camera.covariance
    return covariance


def carried(information: Float[Tensor, "u u"], held: Float[Tensor, "n n"], names: tuple[str, ...]) -> Tensor:
    """Covariance (u, u) where the first n unknowns were held, which have that covariance; names of the others."""
    n = len(held)
    rest = covariance_of(information[n:, n:], names)
    moved = -rest @ information[n:, :n]  # d the others / d what was held
    cross = moved @ held
    return torch.cat([torch.cat([held, cross.mT], 1), torch.cat([cross, rest + cross @ moved.mT], 1)])


def _located(views: Views, camera: Camera, plate: Plate | None) -> tuple[Views, Bundle, Common]:
    views = views.of_views(views.counts >= MIN_POINTS)
    first = first_fit(views, camera.to(views.pixels), free=False) if len(views) else None
    if first is None:
        raise ConfigError("INPUT: no view has a pose; check --camera, the target and the frames")
    return weigh(*first, 0, plate)


class Common(NamedTuple):
    """Standard deviations that are added to every point (px) and to what its rims tell (relative depth, gain in mm)."""

    px: float = 0.0
    depth: float = 0.0
    gain: float = 0.0


def weigh(views: Views, bundle: Bundle, unknowns: int, plate: Plate | None = None) -> tuple[Views, Bundle, Common]:
    """Views without contradicting points, their fit, weighted, of n unknown intrinsics, and the common error.

    ``bundle`` is a `first_fit`: with equal weights. The noise of a robot is what its residuals show.
    """
    # with wrong places residuals tell nothing of the noise: the first fit that moves them goes by the covariances alone
    told = plate is not None and bool(views.covariance.any())
    common = Common() if told else _common(views, bundle, Common(_START_SIGMA))

    def fit(bundle: Bundle, views: Views, common: Common, rows: slice | Tensor = slice(None)) -> Bundle:
        start = bundle.plate if len(bundle.plate) else None
        poses = bundle.R[rows], bundle.t[rows]
        return adjust(_with_common(views, common), bundle.rig, *poses, free=unknowns > 0, plate=plate, start=start)

    for number in range(_ROUNDS + (0 if plate is None else _PLATE_ROUNDS)):
        if number:
            common = _common(views, bundle, common)
        if number and bundle.robot is not None:
            views = replace(views, robot=bundle.robot.again())
        bundle = fit(bundle, views, common)
        keep = _agree(bundle.chi2, _OUTLIER, _MEDIAN)
        keep &= _agree(_rim_chi2(views, bundle, common), _RIM_OUTLIER, _RIM_MEDIAN)
        if bool(keep.all()):
            continue
        views = views[keep]
        enough = views.counts >= MIN_POINTS
        views = views.of_views(enough)
        _check_count(views, unknowns)
        bundle = fit(bundle, views, common, enough)
    return views, bundle, common


def _agree(chi2: Tensor, most: float, median: float) -> Tensor:
    """Points (K,) that do not contradict the others, by the chi-squared of one in 10^6 and of every second good one."""
    return chi2 < most * max(1.0, float(chi2.median()) / median)


def _rim_chi2(views: Views, bundle: Bundle, common: Common) -> Tensor:
    """Chi-squared (K,) of what the rims tell, zero where they were not asked."""
    rims = _with_common(views, common).rims
    if rims is None or bundle.rims.shape[1] == 0:
        return torch.zeros_like(bundle.chi2)
    return (rims.roots @ bundle.rims[..., None]).square().sum((-1, -2))


class _Channel(NamedTuple):
    """Residuals of K observations that share a common error, their covariance by noise, and that of the prediction."""

    residual: Float[Tensor, "K d"]
    covariance: Float[Tensor, "K d d"]
    predicted: Float[Tensor, "K d d"]

    def redundancy(self, common: float) -> float:
        """The sum of the observations' redundancies: degrees of freedom of their residuals."""
        share = torch.linalg.solve(widened(self.covariance, common), self.predicted)
        return float(self.residual.numel() - share.diagonal(dim1=-2, dim2=-1).sum())


def channels(views: Views, bundle: Bundle) -> tuple[_Channel, ...]:
    """Pixels, and where rims were asked their relative distances and edge gains."""
    rims = views.rims
    if rims is None or bundle.rims.shape[1] == 0:
        return (_Channel(bundle.residual, views.covariance, bundle.predicted),)
    xy = rims.t[:, :2] / rims.t[:, 2:]
    by_place = slopes(rims.cameras, views.lens, xy) @ image_by_point(xy, rims.t[:, 2])
    parts = [_Channel(bundle.residual, views.covariance, by_place @ bundle.predicted[:, :3, :3] @ by_place.mT)]
    for k, unit in ((2, rims.t[:, 2]), (6, torch.ones_like(rims.t[:, 2]))):
        of = (
            values[:, k, k, None, None] / unit[:, None, None].square() for values in (rims.covariance, bundle.predicted)
        )
        parts.append(_Channel((bundle.rims[:, k] / unit)[:, None], *of))
    return tuple(parts)


def redundancy(views: Views, bundle: Bundle) -> float:
    """Degrees of freedom of the residuals of a fit to pixels."""
    return channels(replace(views, rims=None), bundle)[0].redundancy(0.0)


def _common(views: Views, bundle: Bundle, before: Common) -> Common:
    """The common errors that the residuals of a fit show, which was made with other ones."""
    told = channels(views, bundle)
    return Common(
        *(
            common_sigma(one.residual, one.covariance, max(1.0, one.redundancy(sigma)))
            for one, sigma in zip(told, before, strict=False)
        )
    )


def common_sigma(residual: Float[Tensor, "K d"], covariance: Float[Tensor, "K d d"], degrees: float) -> float:
    """Standard deviation s per axis, with sum of r^T (C + s^2 I)^-1 r = degrees of freedom; 0 where C suffices.

    The covariance C is zero where it is unknown.
    """

    def excess(sigma: float) -> float:
        return float((residual * torch.linalg.solve(widened(covariance, sigma), residual)).sum()) / degrees - 1

    high = max(float(residual.square().sum() / degrees) ** 0.5, 1e-9)
    low = 1e-6 * high
    # two standard deviations of the reduced chi-squared: what lies within says nothing about the covariances
    if excess(low) < 2 * math.sqrt(2 / degrees):
        return 0.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def widened(covariance: Tensor, sigma: float) -> Tensor:
    size = covariance.shape[-1]
    return covariance + sigma * sigma * torch.eye(size, dtype=covariance.dtype, device=covariance.device)


def _with_common(views: Views, common: Common) -> Views:
    rims = views.rims
    if rims is not None and any(common):
        rims = rims.widened(*common, views.lens)
    return replace(views, covariance=widened(views.covariance, common.px), rims=rims)


def first_fit(views: Views, camera: Camera, *, free: bool = True) -> tuple[Views, Bundle] | None:
    """Fit with equal weights from one start: poses, everything, poses anew (the other planar solution), everything."""
    found = None
    for _ in range(2):
        points, pixels, mask = views.padded()
        poses = pnp.solve(points, pixels, camera, mask=mask)
        R, t = poses.R, poses.t
        solved = R.isfinite().all(-1).all(-1) & (t[:, 2] > 0)
        if found is not None:  # beyond the image of the lens model's fold pixels have no ray, but the view has a pose
            R, t = found[1].R.where(~solved[:, None, None], R), found[1].t.where(~solved[:, None], t)
            solved = torch.ones_like(solved)
        if not bool(solved.any()):
            return None
        views = views.of_views(solved)
        equal = replace(views, covariance=widened(torch.zeros_like(views.covariance), _START_SIGMA))
        try:
            found = views, adjust(equal, camera, R[solved], t[solved], free=free)
        except (ConfigError, torch.linalg.LinAlgError):
            return found
        camera = found[1].camera
    return found


def _robust_cost(bundle: Bundle, points: int) -> float:
    """Of a first fit: no point costs more than one that is left out (Geman-McClure), and one of a lost view as much."""
    chi2 = bundle.chi2
    return float((chi2 / (1 + chi2 / _OUTLIER)).sum()) + _OUTLIER * (points - len(chi2))


def _degrees(views: Views, unknowns: int) -> int:
    return 2 * len(views.view) - 6 * len(views) - unknowns


def _check_count(views: Views, unknowns: int) -> None:
    if unknowns and len(views) < 3:
        raise ConfigError(f"INPUT: {len(views)} usable views; calibration takes 3 at least, better 15, tilted all ways")
    if _degrees(views, unknowns) < 1:
        raise ConfigError(
            f"INPUT: {len(views)} views with {len(views.view)} points do not determine {unknowns} intrinsics; "
            "add views, or use a simpler --model"
        )


def check_residuals(views: Views, residual: Tensor, before: int) -> None:
    """
    Raises:
        ConfigError: the residuals cannot be those of a calibration.
    """
    if len(views.view) < _LEAST_AGREEING * before:
        raise ConfigError(
            f"INPUT: only {len(views.view)} of {before} points agree with each other; check that --target or --board "
            "is what the frames show, and that all frames are of one camera with one focus"
        )
    # as far as points apart, on average: the square root of the area that each has
    pixels = views.padded()[1]
    seen = views.padded()[2][..., None]
    reach = torch.where(seen, pixels, -torch.inf).amax(1) - torch.where(seen, pixels, torch.inf).amin(1)
    apart = float((reach.prod(-1) / views.counts).sqrt().median())
    rms = float(residual.square().sum(-1).mean().sqrt())
    if rms > _MOST_RESIDUAL * apart:
        raise ConfigError(
            f"INPUT: points that are {apart:.0f} px apart fit to {rms:.2g} px only, which no lens or print explains; "
            "check that --target or --board is what they show, and that all frames are of one camera with one focus"
        )


def check_lens(camera: Camera, covariance: Tensor, names: tuple[str, ...]) -> None:
    """
    Raises:
        ConfigError: numerator and denominator of a rational lens cancel, so that its coefficients mean nothing.
    """
    if "k4" not in names or camera.model != "brown_conrady":
        return
    k1, k2, _, _, k3, k4, k5, k6 = camera.distortion
    corners = camera.matrix.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]]) * camera.matrix.new_tensor(
        [camera.width - 1, camera.height - 1]
    )
    focal, center = camera.matrix.diagonal()[:2], camera.matrix[:2, 2]
    # no farther than a ray may be for the model; a corner without distortion where there is no ray
    rays = torch.where((rays := camera.undistort_points(corners)).isfinite(), rays, (corners - center) / focal)
    r2 = torch.linspace(0, 1, 100).to(rays) * rays.square().sum(-1).max()
    factors = torch.stack([1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6))])
    at = names.index("k4")
    sigma = float(covariance[at, at].sqrt())
    if float(factors.min()) < _LEAST_FACTOR or sigma > _OPEN_COEFFICIENT:
        raise ConfigError(
            f"--model: the views do not tell the coefficients of rational8 apart (k1 {float(k1):.3g}, "
            f"k4 {float(k4):.3g} +- {sigma:.2g} cancel); use brown5, or kannala_brandt for a wide lens, "
            "or add views that reach the corners"
        )


def covariance_of(information: Tensor, names: tuple[str, ...]) -> Tensor:
    """Inverse of the information about the intrinsics of these names, and whatever follows them."""
    scale = information.diagonal().clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, None] * scale)
    if not float(values[0]) > _SINGULAR:
        told, what = dict(enumerate(names)), "intrinsics" if any(n.endswith("fx") for n in names) else "places"
        most = vectors[:, 0].abs().topk(2).indices.sort().values.tolist()
        direction = ", ".join(dict.fromkeys(told.get(i, "places of the target") for i in most))
        raise ConfigError(
            f"INPUT: the views are too alike to tell the {what} apart (mostly {direction}); "
            "add views tilted by 20 to 45 degrees in different directions"
        )
    root = scale[:, None] * vectors * values.rsqrt()
    return root @ root.T


def doubts_of(views: Views, camera: Camera, R: Tensor, covariance: Tensor, common: float) -> list[str]:
    """What makes the intrinsics of a camera doubtful, with the turns (N, 3, 3) of its views."""
    normal, reach = R[:, :, 2], views.pixels.amax(0) - views.pixels.amin(0)
    spread = float((normal @ normal.T).clamp(-1, 1).acos().max().rad2deg())
    focal = float((covariance.diagonal()[:2].sqrt() / camera.matrix.diagonal()[:2]).max())
    covered = reach > _LITTLE_COVER * reach.new_tensor([camera.width, camera.height])
    doubts = [
        (
            common > _LARGE_ERROR,
            f"the points are {common:.2g} px off, more than print and lens explain; check the target file, --model, "
            "and that all frames are of one camera with one focus",
        ),
        (
            spread < _LITTLE_TILT_DEG,
            f"views too alike: their tilts differ by {spread:.0f} degrees at most, so focal length and distance are "
            "hard to tell apart; add views tilted by 20 to 45 degrees in different directions",
        ),
        (
            focal > _WIDE_SIGMA,
            f"the focal length is known to {focal:.2%} only, which is the relative error of every distance; "
            "add tilted views, or views that fill the frame",
        ),
        (
            len(camera.distortion) > 0 and not bool(covered.all()),
            "the points cover less than half of the frame's width or height, so the distortion beyond them is "
            "extrapolated; add views with the target near borders and corners",
        ),
    ]
    return [text for doubtful, text in doubts if doubtful]

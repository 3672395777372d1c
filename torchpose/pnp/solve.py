"""`solve`: poses from points in pixels, by any method of this package, with covariance and a code for every pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from typing import Literal, TypeVar

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.small_linalg import cross, matmul3, orthonormalise
from torchpose.pnp._compile import compiled
from torchpose.pnp.candidates import Candidates
from torchpose.pnp.dlt import dlt
from torchpose.pnp.epnp import epnp
from torchpose.pnp.implicit import attach_gradient
from torchpose.pnp.iterative import (
    SIGNS,
    Estimate,
    Observations,
    covariance,
    distance,
    linearise,
    minimise,
    normal_equations,
    product2,
    residuals,
)
from torchpose.pnp.p3p import p3p
from torchpose.pnp.planar import COLLINEARITY, FLATNESS, ippe, planar, plane_frame
from torchpose.pnp.posit import posit
from torchpose.pnp.result import PnPCode, PnPError, PnPResult

Method = Literal["iterative", "planar", "dlt", "p3p", "epnp", "posit"]
_CLOSED_FORMS: dict[str, Callable[[Tensor, Tensor, Tensor | None], Candidates]] = {
    "planar": planar,
    "dlt": dlt,
    "p3p": p3p,
    "epnp": epnp,
    "posit": posit,
}
# points that each method needs
_LEAST = {"iterative": 4, "planar": 4, "dlt": 6, "p3p": 3, "epnp": 4, "posit": 4}
_T = TypeVar("_T")
# root mean square of a start, in normalised coordinates, above which points may lie behind the camera
_SUSPICIOUS = 1e-3
# bytes; the most that glibc lets the threshold grow to is 32 MiB
_KEPT = 30 << 20
_Rows = TypeVar("_Rows", slice, Tensor)
# chi-squared difference below which two minima are called ambiguous
DECISION = 20.0
# squared Mahalanobis distance below which two minima are one
COINCIDENCE = 1.0
# least 1 - (multiple correlation)^2 of a parameter below which the points do not fix the pose
INDEPENDENCE = 1e-11
# poses whose working set fits the cache of one core
_CHUNK = 8192
# most iterations in float32: what is slow there is no faster for being done twice
_SINGLE = 8
# poses put off that are solved at once
_LATE = 16384
# iterations after which a pose is put off, where there are many
_FIRST_PASS = 3


def solve(
    object_points: Tensor,
    image_points: Tensor,
    camera: Camera | Tensor,
    *,
    method: Method = "iterative",
    sigma_px: float = 1.0,
    covariances: Tensor | None = None,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    initial: tuple[Tensor, Tensor] | None = None,
    huber: float = float("inf"),
    max_iterations: int = 100,
    compile: bool = False,
    raise_on_failure: bool = False,
) -> PnPResult:
    """Poses of B sets of N points.

    Args:
        object_points: (N, 3) shared by all poses, or (B, N, 3).
        image_points: (B, N, 2) px.
        camera: `Camera`, or the pinhole matrix (3, 3) or (B, 3, 3).
        method: "iterative" is the maximum-likelihood estimate (Levenberg-Marquardt through the full camera model from
            every start that a closed form finds); the others return their closed form as it is, with the covariance
            that the maximum-likelihood estimate would have there.
        sigma_px: standard deviation of the image points, per axis.
        covariances: (N, 2, 2) or (B, N, 2, 2) px^2, of the image points; replace ``sigma_px``.
        weights: (N,) or (B, N), factors on the information of the points.
        mask: (B, N) bool, True where the point was seen; what a missing point holds is ignored.
        initial: R (B, 3, 3), t (B, 3) to start from, with method "iterative", or S starts (B, S, 3, 3), (B, S, 3) each;
            only their own minima are then found.
        huber: residual, in standard deviations, above which the cost of a point grows linearly.
        max_iterations: of Levenberg-Marquardt, float32 and float64 together about.
        compile: run the inner functions through torch.compile (first call with a new number of points: many seconds).
        raise_on_failure: raise instead of returning codes other than CONVERGED and AMBIGUOUS.

    Returns:
        `PnPResult`, float64, on the device of ``image_points``. With method "iterative", R and t are differentiable in
        the points, the pixels and the camera (implicit function theorem); the other fields are not.

    Raises:
        ValueError: shapes do not fit, or an unknown method.
        PnPError: with ``raise_on_failure``.
        ConfigError: ``compile`` without a C++ compiler.
    """
    if image_points.ndim != 3 or image_points.shape[-1] != 2:
        raise ValueError(f"image_points has shape {tuple(image_points.shape)}; expected (B, N, 2)")
    batch, count = image_points.shape[:2]
    pixels = image_points.double()
    points = object_points.to(pixels)
    _expect("object_points", points, (count, 3), batch)
    options = {"covariances": ((count, 2, 2), covariances), "weights": ((count,), weights), "mask": ((count,), mask)}
    for name, (shape, value) in options.items():
        if value is not None:
            _expect(name, value, shape, batch)
    if method not in _LEAST:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(_LEAST)}")
    if initial is not None and method != "iterative":
        raise ValueError(f"initial is for method 'iterative'; method {method!r} needs no start")
    if initial is not None:
        rotation, translation = initial
        if rotation.shape[0] != batch or rotation.shape[-2:] != (3, 3) or translation.shape != rotation.shape[:-1]:
            shapes = [tuple(v.shape) for v in initial]
            raise ValueError(
                f"initial has shapes {shapes}; expected (B, 3, 3) and (B, 3), or (B, S, 3, 3) and (B, S, 3)"
            )
    if max_iterations < 1:
        raise ValueError(f"max_iterations is {max_iterations}; expected 1 or more")
    if isinstance(camera, Tensor):
        camera = camera.to(pixels)
        _expect("camera", camera, (3, 3), batch)

    @torch.no_grad()
    def run(rows: slice | Tensor, limit: int) -> tuple[PnPResult, Tensor]:
        def part(value: Tensor, shared: int) -> Tensor:
            return value if value.ndim == shared else value[rows]

        return _solve_chunk(
            part(points, 2),
            pixels[rows],
            part(camera, 2) if isinstance(camera, Tensor) else camera,
            method,
            sigma_px,
            None if covariances is None else part(covariances, 3),
            None if weights is None else part(weights, 1),
            None if mask is None else part(mask, 1),
            None if initial is None else (initial[0][rows].to(pixels), initial[1][rows].to(pixels)),
            huber,
            limit,
            compile,
        )

    inputs = [points, pixels, *([camera] if isinstance(camera, Tensor) else [camera.matrix, camera.distortion])]
    needs_gradient = torch.is_grad_enabled() and method == "iterative" and any(v.requires_grad for v in inputs)

    if batch <= _CHUNK:
        result = _map(lambda rows: run(rows, max_iterations), [slice(None)], pixels)[0][0]
    else:
        # the few poses that need many iterations are put off and solved together
        first = min(_FIRST_PASS, max_iterations)
        parts = _map(lambda rows: run(rows, first), [slice(k, k + _CHUNK) for k in range(0, batch, _CHUNK)], pixels)
        result = _join([part for part, _ in parts])
        late = torch.cat([unfinished for _, unfinished in parts]).nonzero().squeeze(1)
        if max_iterations > first and len(late) > 0:
            # few and long: what counts is the number of calls, so chunks of them may be large
            again = _join([part for part, _ in _map(lambda rows: run(rows, max_iterations), late.split(_LATE), pixels)])
            result = PnPResult(
                **{f.name: getattr(result, f.name).index_copy(0, late, getattr(again, f.name)) for f in fields(again)}
            )
    if needs_gradient:
        result = _with_gradient(result, points, pixels, camera, sigma_px, covariances, weights, mask, huber)
    if raise_on_failure:
        failed = result.code > PnPCode.AMBIGUOUS
        if bool(failed.any()):
            first = int(failed.nonzero()[0])
            code = PnPCode(int(result.code[first])).name
            raise PnPError(f"pose {first}: {code}; {int(failed.sum())} of {batch} poses failed")
    return result


def _with_gradient(
    result: PnPResult,
    points: Tensor,
    pixels: Tensor,
    camera: Camera | Tensor,
    sigma_px: float,
    covariances: Tensor | None,
    weights: Tensor | None,
    mask: Tensor | None,
    huber: float,
) -> PnPResult:
    """The result with R and t as differentiable functions of points, pixels and camera, where there is a pose."""
    batch, count = pixels.shape[:2]
    good = (result.code <= PnPCode.AMBIGUOUS).nonzero().squeeze(1)
    keep = None if mask is None else mask.reshape(-1, count).T.expand(count, batch)
    root = _whitening((count, batch), sigma_px, covariances, weights, keep, pixels)
    if root.ndim == 3:
        root = root * torch.eye(2, dtype=root.dtype, device=root.device)[..., None, None]
    root = root.expand(2, 2, count, batch).permute(3, 2, 0, 1)[good]
    seen = None if mask is None else mask.expand(batch, count)[good][..., None]

    def part(value: Tensor, shared: int) -> Tensor:
        return value if value.ndim == shared else value[good]

    image, model = pixels[good], part(points, 2)
    if seen is not None:
        image, model = torch.where(seen, image, 0.0), torch.where(seen, model, 0.0)
    lens = part(camera, 2) if isinstance(camera, Tensor) else camera
    r, t = attach_gradient(result.R[good], result.t[good], model, image, lens, root.mT @ root, huber)
    return replace(result, R=result.R.index_copy(0, good, r), t=result.t.index_copy(0, good, t))


def _map(function: Callable[[_Rows], _T], chunks: Sequence[_Rows], like: Tensor) -> list[_T]:
    """The function of every chunk, in parallel on the CPU; the first one alone, as it may compile."""
    if like.device.type != "cpu":
        return [function(rows) for rows in chunks]
    # a chunk is made to fit the cache of one core: no threads inside, they would only wait for each other
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        results = [function(chunks[0])]
        workers = min(threads, len(chunks) - 1)
        if workers < 2:
            return results + [function(rows) for rows in chunks[1:]]
        # glibc gives freed memory above a threshold back to the system, and every chunk would fault it in again;
        # freeing one large block raises that threshold to its size. Not touched, it costs nothing.
        torch.empty(_KEPT, dtype=torch.uint8)
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            results.extend(pool.map(function, chunks[1:]))
        return results
    finally:
        torch.set_num_threads(threads)


def _join(parts: list[PnPResult]) -> PnPResult:
    return PnPResult(**{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(PnPResult)})


def _expect(name: str, value: Tensor, shape: tuple[int, ...], batch: int) -> None:
    if value.shape not in (shape, (batch, *shape)):
        raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {shape} or {(batch, *shape)}")


def _whitening(
    shape: tuple[int, int],
    sigma_px: float,
    covariances: Tensor | None,
    weights: Tensor | None,
    keep: Tensor | None,
    like: Tensor,
) -> Tensor:
    """Square root of the information of the image points, 1/px: (1|2, N|1, B|1) diagonal or (2, 2, N, B|1) lower."""
    factor = None if weights is None else weights.to(like).reshape(-1, shape[0]).T.sqrt()
    if keep is not None:
        factor = keep.to(like.dtype) if factor is None else torch.where(keep, factor, 0.0)
    if covariances is None:
        unit = like.new_full((1, 1, 1), 1 / sigma_px)
        return unit if factor is None else unit * factor
    c = covariances.to(like).reshape(-1, shape[0], 2, 2).permute(2, 3, 1, 0)
    if keep is not None:
        c = torch.where(keep, c, torch.eye(2, dtype=c.dtype, device=c.device)[..., None, None])
    l00 = c[0, 0].sqrt()
    l10 = c[1, 0] / l00
    l11 = (c[1, 1] - l10.square()).sqrt()
    root = torch.stack([1 / l00, torch.zeros_like(l00), -l10 / (l00 * l11), 1 / l11]).unflatten(0, (2, 2))
    return root if factor is None else root * factor


def _solve_chunk(
    object_points: Tensor,
    pixels: Tensor,
    camera: Camera | Tensor,
    method: Method,
    sigma_px: float,
    covariances: Tensor | None,
    weights: Tensor | None,
    mask: Tensor | None,
    initial: tuple[Tensor, Tensor] | None,
    huber: float,
    max_iterations: int,
    compile: bool,
) -> tuple[PnPResult, Tensor]:
    """The poses of one chunk, and (B,) bool where more iterations are needed."""
    batch, count = pixels.shape[:2]
    points = object_points.reshape(-1, count, 3).permute(2, 1, 0).contiguous()
    image = pixels.permute(2, 1, 0).contiguous()
    keep = None if mask is None else mask.reshape(-1, count).T.expand(count, batch)
    whitening = _whitening((count, batch), sigma_px, covariances, weights, keep, pixels)
    xy, slope = _rays(camera, pixels, image)
    if slope.ndim == 3 and whitening.shape[0] == 1:
        linear = whitening * slope
    else:
        full = slope if slope.ndim == 4 else torch.stack([slope, slope]) * torch.eye(2).to(slope)[..., None, None]
        linear = whitening * full if whitening.ndim == 3 else product2(whitening, full)

    seen = torch.full((batch,), count, device=pixels.device) if keep is None else keep.sum(0)
    finite = _all_finite(points, keep) & _all_finite(xy, keep) & _all_finite(linear, keep)
    finite = finite.expand(batch)
    weight = None
    if keep is not None or not bool(finite.all()):
        usable = finite if keep is None else keep & finite
        points, xy, image = (torch.where(usable, v, 0.0) for v in (points, xy, image))
        linear, whitening = torch.where(usable, linear, 0.0), torch.where(usable, whitening, 0.0)
        if keep is not None:
            weight = keep.to(xy)

    frame, center, extent = plane_frame(points, weight)
    unit = torch.where(extent[2] > 0, extent[2], 1)
    local = (points - center[:, None]) / unit
    if weight is not None:
        local = torch.where(weight > 0, local, 0.0)
    flat = extent[0] <= FLATNESS * extent[2]
    line = (extent[1] <= COLLINEARITY * extent[2]) | (extent[2] <= 1e-12 * center.abs().amax(0))

    observed = Observations(local, xy, linear, None, huber)
    if initial is not None:
        starts, shifts = (v if v.ndim == n else v[:, None] for v, n in zip(initial, (4, 3), strict=True))
        starts = starts.permute(2, 3, 1, 0)
        minimum, options = 3, starts.shape[2]
        t0 = (shifts.permute(2, 1, 0) + (starts * center[:, None]).sum(1)) / unit
        r0, t0 = starts.flatten(2), t0.flatten(1)
    else:
        candidates = _start(method, observed, weight, frame, flat, line, compile)
        minimum = _LEAST[method]
        options = candidates[0].shape[2]
        r0, t0 = candidates[0].flatten(2), candidates[1].flatten(1)
    mirrored = r0[0, 0].isinf().unflatten(0, (options, batch)).any(0)
    started = (_finite(r0.flatten(0, 1)) & _finite(t0)).unflatten(0, (options, batch)).any(0)

    final = observed
    if isinstance(camera, Camera) and bool(camera.distortion.any()):
        final = Observations(local, image, whitening, camera, huber)
    state = _refine(observed, final, r0, t0, options, max_iterations if method == "iterative" else 0, compile)
    pixel: Observations | float = sigma_px  # of equal weights and squares: chi-squared says it all
    if covariances is not None or weights is not None or huber != float("inf"):
        pixel = final._replace(whitening=torch.ones_like(whitening) if final is not observed else slope)
    bad = (
        (~started, PnPCode.DEGENERATE),
        (mirrored, PnPCode.BEHIND_CAMERA),
        (line, PnPCode.DEGENERATE),
        (~finite, PnPCode.NOT_FINITE),
        (seen < minimum, PnPCode.TOO_FEW),
    )
    late = (~state.converged & state.normal[27].isfinite()).unflatten(0, (options, batch))
    calibration = None
    if isinstance(camera, Camera) and camera.covariance is not None:
        calibration = _calibration(final, whitening, image, camera)
    report = compiled(_report) if compile and calibration is None else _report
    return PnPResult(*report(state, options, center, unit, pixel, seen, weight, bad, calibration)), late.any(0)


def _calibration(final: Observations, whitening: Tensor, image: Tensor, camera: Camera) -> Callable[[Estimate], Tensor]:
    """The function of a pose that gives J^T W J_K L (6, 4, B), where L L^T is the covariance of fx, fy, cx, cy."""
    assert camera.covariance is not None
    values, vectors = torch.linalg.eigh(camera.covariance.to(image))
    root = vectors * values.clamp_min(0).sqrt()  # (4, 4)
    matrix = camera.matrix.to(image)
    x, y = (image[0] - matrix[0, 2]) / matrix[0, 0], (image[1] - matrix[1, 2]) / matrix[1, 1]
    du = x * root[0, :, None, None] + root[2, :, None, None]  # (4, N, B)
    dv = y * root[1, :, None, None] + root[3, :, None, None]
    if whitening.ndim == 3:
        du, dv = du * whitening[0], dv * whitening[0]
    else:
        du, dv = whitening[0, 0] * du + whitening[0, 1] * dv, whitening[1, 0] * du + whitening[1, 1] * dv

    def mixed(pose: Estimate) -> Tensor:
        u_row, v_row, _ = linearise(final, pose.r, pose.t)
        rows = [(u * du).sum(1) + (v * dv).sum(1) for u, v in zip(u_row[:6], v_row[:6], strict=True)]
        signs = torch.tensor(SIGNS, dtype=image.dtype, device=image.device)
        return torch.stack(rows) * signs[:, None, None]

    return mixed


def _relevant(chi2: Tensor) -> Tensor:
    """Chi-squared above which one of several minima (S, B) needs no further digits."""
    return 2 * chi2.amin(0) + 2 * DECISION


def _start(
    method: Method,
    observed: Observations,
    weight: Tensor | None,
    frame: Tensor,
    flat: Tensor,
    line: Tensor,
    compile: bool,
) -> tuple[Tensor, Tensor]:
    """Candidates R (3, 3, S, B), t (3, S, B) about the centroid, in units of the extent."""
    count, batch = observed.xy.shape[1:]
    if method != "iterative":
        found = _CLOSED_FORMS[method](*_batch_first(observed, weight))
        return found.R.permute(2, 3, 1, 0), found.t.permute(2, 1, 0)
    low = observed.to(torch.float32)
    start = compiled(ippe) if compile else ippe
    center = torch.zeros_like(frame[0]).to(low.xy)
    r, t = start(low.points, low.xy, None if weight is None else weight.to(low.xy), frame.to(low.xy), center)
    r = torch.where(flat & ~line, r, torch.nan)
    rows = (~(flat | line)).expand(batch).nonzero().squeeze(1)
    if len(rows):
        # three of the points, and all of them at once where there are enough
        points, xy, mask = _batch_first(observed.select(rows), None if weight is None else weight[:, rows])
        found = p3p(points, xy, mask)
        solutions = [Candidates(*(v[:, :2] for v in found))]
        if count >= 6:
            solutions = [epnp(points, xy, mask), Candidates(*(v[:, :1] for v in found))]
            # points behind the camera have the image of their reflection at the centroid, in front of it
            if bool((solutions[0].rms > _SUSPICIOUS).any()):
                reflected = epnp(-points, xy, mask).rms < 0.1 * solutions[0].rms
                solutions = [
                    Candidates(torch.where(reflected[..., None, None], torch.inf, s.R), s.t, s.rms) for s in solutions
                ]
        r = r.index_copy(3, rows, torch.cat([s.R for s in solutions], 1).permute(2, 3, 1, 0).to(r))
        t = t.index_copy(2, rows, torch.cat([s.t for s in solutions], 1).permute(2, 1, 0).to(t))
    return r, t


def _batch_first(observed: Observations, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    points = observed.points.permute(2, 1, 0)
    points = points[0] if points.shape[0] == 1 else points
    return points, observed.xy.permute(2, 1, 0), None if weight is None else weight.T > 0


def _rays(camera: Camera | Tensor, pixels: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised points (2, N, B) and d(pixel)/d(normalised), (2, 1, B|1) where diagonal, else (2, 2, N|1, B|1)."""
    matrix = camera if isinstance(camera, Tensor) else camera.matrix.to(pixels)
    if isinstance(camera, Camera) and bool(camera.distortion.any()):
        xy = camera.undistort_points(pixels)
        slope = camera.J_distort(xy).permute(2, 3, 1, 0)
        return xy.permute(2, 1, 0).contiguous(), slope.contiguous()
    k = matrix.reshape(-1, 3, 3).permute(1, 2, 0)[:, :, None]  # (3, 3, 1, B)
    y = (image[1] - k[1, 2]) / k[1, 1]
    x = (image[0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    diagonal = torch.stack([k[0, 0], k[1, 1]])
    if bool((k[0, 1] == 0).all()):
        return torch.stack([x, y]), diagonal
    zero = torch.zeros_like(k[0, 0])
    return torch.stack([x, y]), torch.stack([k[0, 0], k[0, 1], zero, k[1, 1]]).unflatten(0, (2, 2))


def _finite(value: Tensor) -> Tensor:
    """Are all numbers along the first dimension finite? Zero times anything else is NaN; cheaper than `isfinite`."""
    return (0 * value).sum(0) == 0


def _all_finite(value: Tensor, keep: Tensor | None) -> Tensor:
    """(B,) or (1,): are all numbers (..., N, B) of the points seen finite?"""
    finite = _finite(value.flatten(0, -3))
    return (finite if keep is None else finite | ~keep).all(0)


def _refine(
    observed: Observations,
    final: Observations,
    r: Tensor,
    t: Tensor,
    options: int,
    max_iterations: int,
    compile: bool,
) -> Estimate:
    """Minima reached from R (3, 3, S B), t (3, S B): float32 first, then float64 where it can matter."""
    if max_iterations == 0:
        final = final.repeat(options)
        r, t = orthonormalise(r.double()), t.double()
        normal = normal_equations(final, r, t)
        return Estimate(r, t, normal, torch.zeros_like(normal[0], dtype=torch.int64), normal[27].isfinite())
    single = observed.to(torch.float32).repeat(options)
    limit = min(max_iterations, _SINGLE)
    first = minimise(single, r.float(), t.float(), max_iterations=limit, rtol=1e-4, compile=compile)
    r, t = orthonormalise(first.r.double()), first.t.double()
    chi2 = first.normal[27].unflatten(0, (options, -1))
    # neither is one that float32 did not reach: it may yet become the better one
    index = ((chi2 <= _relevant(chi2)).flatten() | ~first.converged).nonzero().squeeze(1)
    every = len(index) == r.shape[-1]
    part = (final.repeat(options), r, t)
    if not every:
        part = (final.select(index % observed.xy.shape[-1]), r[..., index], t[:, index])
    last = minimise(*part, max_iterations=max_iterations, rtol=1e-10, damping=1e-6, compile=compile)
    if every:
        return last._replace(iterations=first.iterations + last.iterations)
    normal = first.normal.double()
    for whole, fresh in zip((r, t, normal), last[:3], strict=True):
        whole.index_copy_(-1, index, fresh)
    return Estimate(
        r,
        t,
        normal,
        first.iterations.index_add(0, index, last.iterations),
        first.converged.index_copy(0, index, last.converged),
    )


def _pixel_rms(pixel: Observations, weight: Tensor | None, pose: Estimate) -> Tensor:
    x, y, z = matmul3(pose.r, pixel.points.expand(3, -1, pose.t.shape[-1])) + pose.t[:, None]
    square = residuals(pixel, torch.stack([x / z, y / z])).square().sum(0)
    return (square.mean(0) if weight is None else (square * weight).sum(0) / weight.sum(0)).sqrt()


def _coincide(a: Estimate, b: Estimate) -> Tensor:
    """(B,): are two poses within a standard deviation of each other, by the information of ``a``?"""
    relative = matmul3(b.r, a.r.transpose(0, 1))
    axis = torch.stack(
        [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
    )
    trace = relative[0, 0] + relative[1, 1] + relative[2, 2]
    # twice the tangent of half the angle; Cayley's vector, as in the steps of the minimiser
    step = torch.cat([b.t - a.t, 2 * axis / (1 + trace).clamp_min(1e-12)])
    return distance(a.normal, step) < COINCIDENCE


def _report(
    state: Estimate,
    options: int,
    center: Tensor,
    unit: Tensor,
    pixel: Observations | float,
    seen: Tensor,
    weight: Tensor | None,
    bad: tuple[tuple[Tensor, PnPCode], ...],
    calibration: Callable[[Estimate], Tensor] | None,
) -> tuple[Tensor, ...]:
    """The fields of `PnPResult`."""
    batch = state.t.shape[-1] // options
    split = Estimate(*(v.unflatten(-1, (options, batch)) for v in state))
    chi2 = torch.where(split.normal[27].isnan(), torch.inf, split.normal[27])
    chi2, order = chi2.sort(0)

    def pick(k: int) -> Estimate:
        if options == 1:
            return Estimate(*(v.squeeze(-2) for v in split))
        if options == 2:
            return Estimate(*(torch.where(order[k] == 0, v[..., 0, :], v[..., 1, :]) for v in split))
        return Estimate(*(v.gather(-2, order[k].expand(*v.shape[:-2], 1, batch)).squeeze(-2) for v in split))

    best = pick(0)
    cov, independence = covariance(best.normal)
    if calibration is not None:
        shift = (cov[:, :, None] * calibration(best)).sum(1)  # (6, 4, B): of the pose, by a deviation of the intrinsics
        cov = cov + (shift[:, None] * shift).sum(2)
    other, other_chi2, different = best, torch.full_like(chi2[0], torch.nan), torch.zeros_like(best.converged)
    for k in range(1, options):
        candidate = pick(k)
        new = chi2[k].isfinite() & ~_coincide(best, candidate) & ~different
        other = (
            candidate
            if options == 2
            else Estimate(*(torch.where(new, a, b) for a, b in zip(candidate, other, strict=True)))
        )
        other_chi2 = torch.where(new, chi2[k], other_chi2)
        different = different | new

    code = torch.zeros_like(best.iterations)
    verdicts = (
        (different & (other_chi2 - chi2[0] < DECISION), PnPCode.AMBIGUOUS),
        # another minimum that was not reached may be lower than where its search ended
        (~best.converged | (different & ~other.converged), PnPCode.NOT_CONVERGED),
        (~chi2[0].isfinite(), PnPCode.BEHIND_CAMERA),
        (~(independence > INDEPENDENCE) & chi2[0].isfinite(), PnPCode.DEGENERATE),
        *bad,
    )
    for failed, verdict in verdicts:
        code = torch.where(failed, int(verdict), code)
    good = code <= PnPCode.AMBIGUOUS

    def place(e: Estimate, valid: Tensor) -> tuple[Tensor, Tensor]:
        t = e.t * unit - (e.r * center).sum(1)
        return torch.where(valid, e.r, torch.nan).permute(2, 0, 1), torch.where(valid, t, torch.nan).T

    r, t = place(best, good)
    r_alt, t_alt = place(other, good & different)
    # from the centroid in units of the extent to the origin of the object: t = unit t' - R c
    arm = (best.r * center).sum(1)[:, None]
    cov = torch.cat([unit * cov[:3] + cross(arm, cov[3:]), cov[3:]])
    cov = torch.cat([unit * cov[:, :3] + cross(arm, cov[:, 3:].transpose(0, 1)).transpose(0, 1), cov[:, 3:]], 1)
    if isinstance(pixel, Observations):
        rms, rms_alt = _pixel_rms(pixel, weight, best), _pixel_rms(pixel, weight, other)
    else:
        rms, rms_alt = (pixel * (c / seen).sqrt() for c in (chi2[0], other_chi2))

    def fill(value: Tensor, valid: Tensor) -> Tensor:
        return torch.where(valid, value, torch.nan)

    rms, rms_alt = fill(rms, good), fill(rms_alt, good & different)
    return (
        r,
        t,
        fill(cov, good).permute(2, 0, 1),
        rms,
        fill(chi2[0], good),
        best.iterations,
        code,
        r_alt,
        t_alt,
        rms_alt,
        fill(other_chi2, good & different),
        rms_alt / rms,
    )

"""`solve`: poses from points in pixels, by any method of this package, with covariance and a code for every pose."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from torchpose.camera import Camera, CameraRig
from torchpose.camera.plausible import check_pinhole
from torchpose.errors import ArgumentError
from torchpose.geometry.arguments import expect_not_negative, expect_positive, one_device, taking_arrays
from torchpose.kernels import LEAST, compiled, padded
from torchpose.kernels.memory import keep_memory
from torchpose.pnp.candidates import Candidates, expect, expect_mask, expect_pixels
from torchpose.pnp.dlt import dlt
from torchpose.pnp.epnp import epnp
from torchpose.pnp.first_pass import EVALUATIONS, Rest, first_pass, upright
from torchpose.pnp.implicit import attach_gradient
from torchpose.pnp.iterative import minimise
from torchpose.pnp.normal_equations import COST, costs
from torchpose.pnp.p3p import p3p
from torchpose.pnp.planar import planar
from torchpose.pnp.posit import posit
from torchpose.pnp.problem import Body, Inputs, Problem, prepare
from torchpose.pnp.result import PnPCode, PnPError, PnPResult
from torchpose.pnp.second_pass import second_pass
from torchpose.pnp.several import solve_rig
from torchpose.pnp.starts import as_poses, batch_first, of_planes, planes, starts
from torchpose.pnp.third_pass import every_start, firm, start_roughly, third_pass, verdicts
from torchpose.pnp.verdict import Bad, Found, Minima, Table, choose, relevant, write

Method = Literal["iterative", "planar", "dlt", "p3p", "epnp", "posit"]
_CLOSED_FORMS: dict[str, Callable[[Tensor, Tensor, Tensor | None], Candidates]] = {
    "planar": planar,
    "dlt": dlt,
    "p3p": p3p,
    "epnp": epnp,
    "posit": posit,
}
# points that each method needs, and that a pose needs whose start is given
_LEAST = {"iterative": 4, "planar": 4, "dlt": 6, "p3p": 3, "epnp": 4, "posit": 4}
_LEAST_STARTED = 3
# poses solved at once: enough for torch to share an operation among its threads, few enough for the cache
_CHUNK = 16384
# points up to which the code of a pose is compiled, number by number; of these it takes a minute or two
_COMPILED_POINTS = 128


@taking_arrays
def solve(
    object_points: Tensor,
    image_points: Tensor,
    camera: Camera | CameraRig | Tensor,
    *,
    camera_index: Tensor | None = None,
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
    """Poses of B sets of N points; of lines, see `torchpose.pnp.lines`. Tensors may be NumPy arrays.

    Args:
        object_points: (N, 3) shared by all poses, or (B, N, 3).
        image_points: (B, N, 2) px.
        camera: `Camera`, pinhole matrix (3, 3) or (B, 3, 3), or `CameraRig` (method "iterative"): poses are
            then in its first camera, and what is uncertain of places and lenses is weighed with the noise.
        camera_index: (N,) or (B, N), of each point, with a rig.
        method: "iterative" is the maximum-likelihood estimate (Levenberg-Marquardt through the full camera model from
            every start that a closed form finds); the others return their closed form, with its covariance there.
        sigma_px: standard deviation of the image points, per axis.
        covariances: (N, 2, 2) or (B, N, 2, 2) px^2, of the image points; replace ``sigma_px``.
        weights: (N,) or (B, N), factors on the information of the points.
        mask: (B, N) bool, True where the point was seen; what a missing point holds is ignored.
        initial: R (B, 3, 3), t (B, 3) to start from, with method "iterative", or S starts (B, S, 3, 3), (B, S, 3) each;
            only their own minima are then found, and a start far above another one is left when it gains nothing.
        huber: residual, in standard deviations, above which the cost of a point grows linearly.
        max_iterations: of Levenberg-Marquardt, float32 and float64 together about.
        compile: one C++ loop (`torchpose.kernels`), made in seconds for each number of points; on the CPU, up to 128.
        raise_on_failure: raise instead of returning codes other than CONVERGED and AMBIGUOUS.

    Returns:
        `PnPResult`, float64, on the device of ``image_points``. With method "iterative", R and t are differentiable in
        the points, the pixels and the camera (implicit function theorem); the other fields are not.

    Raises:
        ArgumentError: shapes, dtypes or devices do not fit, a number is out of its range, or an unknown method.
        PnPError: with ``raise_on_failure``.
        ConfigError: ``compile`` without a C++ compiler; a matrix that cannot be that of the points (`check_pinhole`).
    """
    rig, one = _rig_of(camera, camera_index, method, huber)
    inputs, starts = _checked(
        Inputs(object_points, image_points, one, sigma_px, covariances, weights, mask, huber), method, initial
    )
    if max_iterations < 1:
        raise ArgumentError(f"max_iterations: is {max_iterations}; give 1 or more")
    compile = compile and inputs.pixels.device.type == "cpu" and inputs.pixels.shape[1] <= _COMPILED_POINTS
    with torch.no_grad():
        several = None if rig is None else solve_rig(inputs, *rig, starts, max_iterations)
        result = _solve(inputs, method, starts, max_iterations, compile) if several is None else several
    if rig is None and torch.is_grad_enabled() and method == "iterative" and inputs.requires_grad:
        result = attach_gradient(result, inputs)
    return _raised(result, raise_on_failure)


def _raised(result: PnPResult, wanted: bool) -> PnPResult:
    """The result; raises PnPError where that is wanted and a pose failed."""
    failed = result.code > PnPCode.AMBIGUOUS
    if wanted and bool(failed.any()):
        first = int(failed.nonzero()[0])
        code = PnPCode(int(result.code[first])).name
        raise PnPError(f"pose {first}: {code}; {int(failed.sum())} of {len(failed)} poses failed")
    return result


def _rig_of(
    camera: Camera | CameraRig | Tensor, index: Tensor | None, method: Method, huber: float
) -> tuple[tuple[CameraRig, Tensor] | None, Camera | Tensor]:
    """The rig with the camera of each point, if it is one; and a camera, of which nothing is used then."""
    if not isinstance(camera, Camera | CameraRig | Tensor):
        raise ArgumentError(f"camera: is {type(camera).__name__}; give a Camera, a CameraRig or a 3 x 3 matrix")
    if not isinstance(camera, CameraRig):
        if index is not None:
            raise ArgumentError("camera_index: goes with a CameraRig; give one, or leave it out")
        return None, camera
    if not isinstance(index, Tensor):
        raise ArgumentError("camera_index: is missing; give the number of the camera that saw each point")
    if method != "iterative":
        raise ArgumentError(f"method: is {method!r}; points of several cameras are for method 'iterative'")
    if huber != float("inf"):
        raise ArgumentError("huber: is for one camera; leave it out with a CameraRig")
    return (camera, index), camera.cameras[0]


def _checked(
    given: Inputs, method: Method, initial: tuple[Tensor, Tensor] | None
) -> tuple[Inputs, tuple[Tensor, Tensor] | None]:
    """The arguments in float64, and the starts R (B, S, 3, 3), t (B, S, 3); raises ArgumentError where one is wrong."""
    batch, count = expect_pixels(given.pixels)
    if count == 0:
        raise ArgumentError(
            "image_points: has no points; give three or more a pose, and a mask where some are not seen"
        )
    pixels, camera = given.pixels.double(), given.camera
    shapes = {"object_points": (given.points, (count, 3)), "covariances": (given.covariances, (count, 2, 2))}
    shapes |= {"weights": (given.weights, (count,))}
    if not isinstance(camera, Camera):
        shapes["camera"] = camera, (3, 3)
    for name, (value, shape) in shapes.items():
        if value is not None:
            expect(name, value, shape, (batch, *shape))
    expect_mask(given.mask, (count,), (batch, count))
    one_device(image_points=pixels, **{name: value for name, (value, _) in shapes.items()}, mask=given.mask)
    expect_positive(sigma_px=given.sigma_px)
    _expect_symmetric(given.covariances)
    if given.weights is not None:
        expect_not_negative(weights=given.weights)
    if given.huber is not None and not given.huber > 0:
        raise ArgumentError(f"huber: is {given.huber}; give a number of standard deviations above 0")
    if isinstance(camera, Tensor):
        check_pinhole(camera, pixels, given.mask)
    if method not in _LEAST:
        raise ArgumentError(f"method: is {method!r}; choose one of {', '.join(_LEAST)}")
    if initial is not None:
        initial = _checked_starts(initial, method, pixels)
    camera = camera if isinstance(camera, Camera) else camera.to(pixels)
    huber = None if given.huber in (None, float("inf")) else float(given.huber)
    return replace(given, points=given.points.to(pixels), pixels=pixels, camera=camera, huber=huber), initial


def _expect_symmetric(covariances: Tensor | None) -> None:
    """To half the digits of single precision: one triangle alone would be used."""
    if covariances is None:
        return
    one, other = covariances[..., 0, 1], covariances[..., 1, 0]
    slack = torch.finfo(torch.float32).eps ** 0.5 * torch.maximum(one.abs(), other.abs())
    if bool(((one - other).abs() > slack).any()):
        raise ArgumentError("covariances: are not symmetric; give [[uu, uv], [uv, vv]], px^2")


def _checked_starts(initial: tuple[Tensor, Tensor], method: Method, pixels: Tensor) -> tuple[Tensor, Tensor]:
    if method != "iterative":
        raise ArgumentError(f"initial: is for method 'iterative'; method {method!r} needs no start")
    rotation, translation = initial
    if rotation.shape[0] != len(pixels) or rotation.shape[-2:] != (3, 3) or translation.shape != rotation.shape[:-1]:
        raise ArgumentError(
            f"initial: has shapes {[tuple(v.shape) for v in initial]}; give (B, 3, 3) and (B, 3), or (B, S, 3, 3) and "
            "(B, S, 3)"
        )
    return rotation.to(pixels), translation.to(pixels)


def _solve(
    inputs: Inputs, method: Method, initial: tuple[Tensor, Tensor] | None, max_iterations: int, compile: bool
) -> PnPResult:
    """Chunk by chunk; whenever a chunk's worth of poses is left over by the first pass, they have their second one."""
    keep_memory()
    inputs, asked = inputs.with_body(sums=not compile), len(inputs.pixels)
    if compile and asked < LEAST:
        index = padded(torch.arange(asked))
        inputs, initial = inputs.rows(index), None if initial is None else (initial[0][index], initial[1][index])
    batch = len(inputs.pixels)
    table = Table.empty(batch, inputs.pixels, compile)
    doubt = torch.zeros(2, batch, dtype=torch.bool, device=inputs.pixels.device)
    pending: list[tuple[Tensor, Rest]] = []
    # a chunk of its own for the last few would be too small to be compiled
    firsts = range(0, max(batch - LEAST, min(batch, 1)), _CHUNK)
    for start, stop in pairwise((*firsts, batch)):
        rows = slice(start, stop)
        given = None if initial is None else (initial[0][rows], initial[1][rows])
        problem = prepare(inputs.rows(rows))
        doubt[0, rows], doubt[1, rows] = problem.body.thin, start_roughly(problem)
        which, rest = _solve_chunk(problem, method, given, max_iterations, compile, table.columns(rows))
        if rest is not None and len(which):
            which = padded(which) if compile else which
            pending.append((which + start, Rest(*(v[..., which] for v in rest))))
        if pending and (stop == batch or sum(len(which) for which, _ in pending) >= _CHUNK):
            which = torch.cat([which for which, _ in pending])
            rest = Rest(*(torch.cat(parts, -1) for parts in zip(*(rest for _, rest in pending), strict=True)))
            problem, columns = prepare(inputs.rows(which)), Table.empty(len(which), inputs.pixels, compile)
            minima = second_pass(problem, rest, max_iterations, compile)
            _finish(problem, minima, _bad(problem, rest.pose[:, :, None], 0), columns, compile)
            table.replace(which, columns)
            pending = []
    if method == "iterative" and initial is None:
        for which in table.doubtful(*doubt).split(_CHUNK):
            _look_further(inputs, which, table, max_iterations, compile)
    return table.columns(slice(asked)).result()


def _look_further(inputs: Inputs, which: Tensor, table: Table, max_iterations: int, compile: bool) -> None:
    """Third pass of the poses ``which`` (L,), of which ``table`` has one minimum or none."""
    if len(which):
        which = which[(table.integers[1, which] > PnPCode.AMBIGUOUS) | ~firm(*_outline(inputs, which))]
    if len(which) == 0:
        return
    which = padded(which) if compile else which
    problem, columns = prepare(inputs.rows(which)), Table.empty(len(which), inputs.pixels, compile)
    pose, chi2, code = table.minimum(which)
    poses = every_start(problem, _centred(problem, pose))
    minima = third_pass(problem, poses, chi2, max_iterations, compile)
    bad = (*verdicts(problem, minima, code > PnPCode.AMBIGUOUS), *_bad(problem, poses, _LEAST["iterative"]))
    _finish(problem, minima, bad, columns, compile)
    # with nothing to start from, the verdict of the passes before stands
    found = poses[0, 0].isnan().logical_not().any(0).nonzero().squeeze(1)
    table.replace(which[found], Table(columns.floats[:, found], columns.integers[:, found]))


def _outline(inputs: Inputs, which: Tensor) -> tuple[Body, Tensor | None]:
    """The object points of poses (L,), and their weights."""
    if inputs.body is not None:
        return inputs.body, None
    problem = prepare(inputs.rows(which))
    return problem.body, problem.weight


def _centred(problem: Problem, pose: Tensor) -> Tensor:
    """Poses (3, 4, ..., B) of the object's origin about the centroid, in units of the extent."""
    shape = (3, *[1] * (pose.ndim - 3), -1)
    r, t, center = pose[:, :3], pose[:, 3], problem.body.center.view(shape)
    return torch.cat([r, ((t + (r * center).sum(1)) / problem.body.unit)[:, None]], 1)


def _solve_chunk(
    problem: Problem,
    method: Method,
    initial: tuple[Tensor, Tensor] | None,
    max_iterations: int,
    compile: bool,
    table: Table,
) -> tuple[Tensor, Rest | None]:
    """Writes the results of a chunk; returns which poses are left over (L,), and what is known of all."""
    least, none = _LEAST[method], problem.seen.new_zeros(0)
    if method != "iterative":
        found = _CLOSED_FORMS[method](*batch_first(problem.observed, problem.weight))
        closed = as_poses([found])
        cost = costs(problem.final.each(), closed)
        solutions = Found(closed, cost, torch.zeros_like(cost, dtype=torch.int64), cost.isfinite())
        write(problem, choose(problem.final, solutions), _bad(problem, closed, least), table)
        return none, None
    poses: Tensor | None = None
    if initial is not None:
        least = _LEAST_STARTED
        r, t = (v if v.ndim == n else v[:, None] for v, n in zip(initial, (4, 3), strict=True))
        poses = _centred(problem, torch.cat([r.permute(2, 3, 1, 0), t.permute(2, 1, 0)[:, None]], 1))
    elif not planes(problem):
        poses = starts(problem)
    # of several starts that are given, the minimum of each is wanted that may matter beside the best of them
    if max_iterations <= EVALUATIONS or (initial is not None and initial[0].ndim == 4):
        poses = starts(problem) if poses is None else poses
        options, batch = poses.shape[2:]
        every = problem.final.select(torch.arange(batch, device=poses.device).repeat(options))
        cost = costs(problem.final.each(), poses.double()).nan_to_num(nan=torch.inf)
        flat = minimise(
            every,
            upright(poses.double()).flatten(2),
            max_iterations=max_iterations,
            enough=relevant(cost.amin(0)).repeat(options),
            compile=compile,
        )
        ends = (flat.pose, flat.normal[COST], flat.iterations, flat.converged)
        minima = choose(problem.final, Found(*(v.unflatten(-1, (options, batch)) for v in ends)), compile)
        _finish(problem, minima, _bad(problem, poses, least), table, compile)
        return none, None
    rest, unfinished = (compiled(_attempt) if compile else _attempt)(problem, poses, least, table)
    return unfinished.nonzero().squeeze(1), rest


def _attempt(problem: Problem, poses: Tensor | None, least: int, table: Table) -> tuple[Rest, Tensor]:
    """The first pass from poses (3, 4, S, B), or from those of planes; writes its results. Which are left over (B,)?"""
    poses = of_planes(problem) if poses is None else poses.float()
    bad = _bad(problem, poses, least)
    minima, rest, unfinished = first_pass(problem.observed.to(torch.float32), problem.observed, problem.final, poses)
    for flag, _ in bad:  # an answer that will not change
        unfinished = unfinished & ~flag
    write(problem, minima, bad, table, again=unfinished)
    return rest, unfinished


def _finish(problem: Problem, minima: Minima, bad: Bad, table: Table, compile: bool) -> None:
    (compiled(write) if compile else write)(problem, minima, bad, table)


def _bad(problem: Problem, poses: Tensor, least: int) -> Bad:
    """Poses that have no answer and why; of several reasons the last one counts."""
    numbers = (0 * poses.sum((0, 1)) == 0).any(0)
    return (
        (~numbers, PnPCode.DEGENERATE),
        (poses[0, 0].isinf().any(0), PnPCode.BEHIND_CAMERA),
        (problem.body.line, PnPCode.DEGENERATE),
        (~problem.finite, PnPCode.NOT_FINITE),
        (problem.seen < least, PnPCode.TOO_FEW),
    )

"""``torchpose sensitivity``: which error source dominates which axis, over the working distance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from torchpose.cli.common import MOST_SEED, say
from torchpose.cli.options import camera_option, folder_option, target_option
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.analysis.sensitivity import Uncertainty
    from torchpose.analysis.sweep import Sweep, Swept
    from torchpose.camera import Camera
    from torchpose.target import Target

_Sigmas = Annotated[
    list[float] | None,
    typer.Option(help="Standard deviation of a marker centre on each axis; may be repeated. By default 0.2 and 1."),
]
_MOST = 1e6  # of an error, a distance or a noise (convention), in the units of the options
_Distances = Annotated[tuple[float, float], typer.Option(metavar="NEAR FAR", help="Working distances, mm.")]
_NOISE = (
    "Standard deviation of the noise, grey levels of 255: adds the budget of the rings' edges, as estimate claims it."
)
_LEVELS = "Grey levels of print and paper, with --noise."
_FOCAL = "Error of the focal length; by default 0.25, or 0 where the camera file states a covariance."
_CAMERAS = "File of several cameras: what each tells alone, and all together, over the distance; and --second-camera."
_SECOND = "What a second camera like the first tells besides, by the angle between the two; ends the prediction there."
_SIZES = (
    "--focal-error-percent",
    "--principal-point-px",
    "--print-um",
    "--flatness-um",
    "--radius-um",
    "--scale-percent",
)
_DISTORTION = "Standard deviations of the camera's coefficients: 1e-3,1e-3,1e-5,1e-5."


def sensitivity(
    out: Annotated[Path, folder_option("Folder for tables (.csv) and plots (.png).")],
    camera: Annotated[Path | None, camera_option("Camera file; by default the paper's camera.")] = None,
    target: Annotated[str, target_option("Target file, or the name of a built-in target.")] = "quad8",
    distance: _Distances = (12.0, 32.0),
    steps: Annotated[int, typer.Option(min=3, max=1000, help="Number of distances.")] = 11,
    tilt_deg: Annotated[float, typer.Option(help="Tilt of the target about the x axis.")] = 0.0,
    sigma_px: _Sigmas = None,
    focal_error_percent: Annotated[float | None, typer.Option(help=_FOCAL)] = None,
    principal_point_px: Annotated[float, typer.Option(help="Standard deviation of cx and cy.")] = 0.0,
    distortion: Annotated[str, typer.Option(metavar="LIST", help=_DISTORTION)] = "",
    print_um: Annotated[float, typer.Option(help="Standard deviation of a printed centre, on each axis.")] = 0.0,
    flatness_um: Annotated[float, typer.Option(help="Standard deviation of a marker along its normal.")] = 0.0,
    radius_um: Annotated[float, typer.Option(help="Standard deviation of a printed radius.")] = 0.0,
    scale_percent: Annotated[float, typer.Option(help="Standard deviation of the print's scale.")] = 0.0,
    noise: Annotated[float | None, typer.Option(help=_NOISE)] = None,
    blur: Annotated[float, typer.Option(help="Standard deviation of the lens's blur, px, with --noise.")] = 0.7,
    levels: Annotated[tuple[float, float], typer.Option(metavar="DARK LIGHT", help=_LEVELS)] = (30.0, 220.0),
    cameras: Annotated[Path | None, typer.Option(metavar="RIG", help=_CAMERAS)] = None,
    second_camera: Annotated[bool, typer.Option("--second-camera", help=_SECOND)] = False,
    draws: Annotated[int, typer.Option(min=2, max=100000, help="Random draws at every distance.")] = 300,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of the draws.")] = 0,
) -> int:
    """Predict pose errors by source over the working distance, and check the prediction by Monte-Carlo.

    What target file and camera file state of themselves is counted: center_sigma, edge_gain_sigma, centers_covariance,
    and the covariance of the camera's parameters.
    """
    if cameras is not None or second_camera:
        _check({}, [], distance, tilt_deg)
        return _several(cameras, camera, target, _Range(distance, steps, tilt_deg), (noise, blur, levels), out)
    lens = _lens(camera)
    if focal_error_percent is None:
        focal_error_percent = 0.25 if lens.covariance is None else 0.0
    values = (focal_error_percent, principal_point_px, print_um, flatness_um, radius_um, scale_percent)
    sizes = dict(zip(_SIZES, values, strict=True))
    sigmas = list(dict.fromkeys(sigma_px or [0.2, 1.0]))
    _check(sizes, sigmas, distance, tilt_deg)
    import torch

    from torchpose.analysis.sensitivity import Uncertainty
    from torchpose.analysis.sweep import sweep, sweep_rings
    from torchpose.studies.fig04_sensitivity import cases_of
    from torchpose.target import Target

    printed = Target.load(target)
    bent = _coefficients(distortion, len(lens.distortion))
    of_print = (print_um / 1000, flatness_um / 1000, radius_um / 1000, scale_percent / 100)
    size = Uncertainty(0.0, focal_error_percent / 100, principal_point_px, bent, *of_print)
    at, tilt = torch.linspace(*distance, steps, dtype=torch.float64), math.radians(tilt_deg)
    cases = {
        title: sweep(lens, printed, at, case, tilt=tilt, draws=draws, seed=seed)
        for title, case in cases_of(sigmas, size).items()
    }
    _check_view(cases)
    rings: dict[str, Swept] = {}
    if noise is not None:
        edges = replace(size, image=_of_edges(noise, levels, blur))
        rings[f"edges of the rings, noise {noise:g}"] = sweep_rings(lens, printed, at, edges, tilt=tilt)
    return _written(cases, rings, size, lens, printed, out)


def _written(
    cases: dict[str, Sweep],
    rings: dict[str, Swept],
    size: Uncertainty,
    lens: Camera,
    printed: Target,
    out: Path,
) -> int:
    """Writes and shows what was predicted; returns the exit code."""
    from torchpose.studies.fig04_sensitivity import tabulate

    files = tabulate(cases, rings).save(out)
    _show(cases | rings, size)
    for line in (*_unstated(lens, printed), *files):
        say(str(line))
    return 0


class _Range(NamedTuple):
    distance: tuple[float, float]
    steps: int
    tilt_deg: float


def _several(
    cameras: Path | None,
    camera: Path | None,
    target: str,
    places: _Range,
    picture: tuple[float | None, float, tuple[float, float]],
    out: Path,
) -> int:
    """Several cameras by the bound of the grey values; ``picture`` is noise, blur and levels."""
    import torch

    from torchpose.camera import CameraRig
    from torchpose.cli.sensitivity_rig import Setting, noise_of, predict
    from torchpose.target import Target

    if cameras is not None and camera is not None:
        raise ConfigError("sensitivity: --camera: stands beside --cameras; give one of them")
    noise, (dark, light) = noise_of(picture[0]), picture[2]
    _of_edges(noise, picture[2], picture[1])  # checks them
    conditions = {"psf_sigma": picture[1], "dark": dark, "light": light, "noise_sigma": noise}
    at = torch.linspace(*places.distance, places.steps, dtype=torch.float64)
    rig = None if cameras is None else CameraRig.load(cameras)
    first = _lens(camera) if rig is None else rig.cameras[0]
    setting = Setting(at, math.radians(places.tilt_deg), conditions)
    return predict(rig, first, Target.load(target), setting, out)


def _lens(path: Path | None) -> Camera:
    from torchpose.camera import Camera
    from torchpose.studies.fig04_sensitivity import paper_camera

    return Camera.load(path) if path else paper_camera()


def _check(sizes: dict[str, float], sigmas: list[float], distance: tuple[float, float], tilt_deg: float) -> None:
    """Refuses numbers that are no sizes of errors, distances or angles."""
    for option, value in sizes.items():
        if not 0 <= value <= _MOST:
            raise ConfigError(f"sensitivity: {option}: is {value}; give a number from 0 to {_MOST:g}")
    for value in sigmas:
        if not 0 < value <= _MOST:
            raise ConfigError(f"sensitivity: --sigma-px: is {value}; give a number above 0, at most {_MOST:g}")
    if not (0 < distance[0] < distance[1] <= _MOST):
        raise ConfigError(f"sensitivity: --distance: is {distance[0]} {distance[1]}; give NEAR above 0 and FAR beyond")
    if not abs(tilt_deg) < 85:
        raise ConfigError(f"sensitivity: --tilt-deg: is {tilt_deg}; give an angle between -85 and 85")


def _of_edges(noise: float, levels: tuple[float, float], blur: float) -> float:
    """Of `Uncertainty.image`: px of an edge averaged over 1 px, with the noise of rounding to grey levels."""
    from torchpose.analysis.sensitivity import edge_noise

    for option, value in (("--noise", noise), ("--blur", blur)):
        if not 0 < value <= _MOST:
            raise ConfigError(f"sensitivity: {option}: is {value}; give a number above 0, at most {_MOST:g}")
    dark, light = levels
    if not 0 <= dark < light <= 255:
        raise ConfigError(f"sensitivity: --levels: is {dark:g} {light:g}; give 0 <= DARK < LIGHT <= 255")
    return edge_noise(math.sqrt(noise**2 + 1 / 12), light - dark, blur)


def _unstated(camera: Camera, target: Target) -> list[str]:
    """What the budget takes for exact because its file says nothing."""
    keys = []
    if target.covariance is None:
        keys.append(f"target {target.name} (center_sigma, edge_gain_sigma)")
    if camera.covariance is None:
        keys.append("camera (its covariance, which torchpose calibrate writes)")
    return [f"stated by no file, so exact but for the options: {' and '.join(keys)}"] if keys else []


def _coefficients(text: str, count: int) -> tuple[float, ...]:
    if not text:
        return ()
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"sensitivity: --distortion: {text!r} is no list of numbers; write 1e-3,1e-3") from None
    if len(values) != count:
        raise ConfigError(f"sensitivity: --distortion: {len(values)} numbers for {count} coefficients; give {count}")
    if not all(0 <= value < math.inf for value in values):
        raise ConfigError(f"sensitivity: --distortion: is {text}; give standard deviations from 0")
    return values


def _check_view(cases: dict[str, Sweep]) -> None:
    first = next(iter(cases.values()))
    for distance, seen in zip(first.distance.tolist(), first.budget.seen.all(1).tolist(), strict=True):
        if not seen:
            raise ConfigError(
                f"sensitivity: --distance: at {distance:g} mm not all markers are in the frame; give distances "
                "from which the camera sees the whole target"
            )


def _show(cases: Mapping[str, Swept], size: Uncertainty) -> None:
    from torchpose.analysis.evaluation import AXES, SCALE, UNITS
    from torchpose.analysis.sweep import Sweep
    from torchpose.cli.terminal import print_table

    columns = ("distance mm", "source", *(f"{axis} {unit}" for axis, unit in zip(AXES, UNITS, strict=True)))
    for title, case in cases.items():
        rows = []
        for k in (0, len(case.distance) // 2, len(case.distance) - 1):
            lines = {name: case.budget.std(name)[k] for name in case.budget.sources}
            lines["total"] = case.budget.std()[k]
            if isinstance(case, Sweep):
                lines |= {"drawn, rms": case.rms[k], "drawn, largest": case.largest[k]}
            for i, (name, std) in enumerate(lines.items()):
                values = [value if value > 1e-9 else 0.0 for value in (SCALE * std).tolist()]  # below, rounding
                rows.append(("" if i else f"{float(case.distance[k]):g}", name.replace("_", " "), *values))
        console = print_table(f"{title}: standard deviations by source", columns, rows)
    if size.focal_length:
        console.print("focal length: the effect of an error of that very size")

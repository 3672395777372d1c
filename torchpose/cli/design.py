"""``torchpose design``: from camera, working volume and accuracy to a target file, its precision and a print sheet."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchpose.cli.common import say
from torchpose.cli.options import MOST_ANGLE, camera_option, folder_option, target_option
from torchpose.errors import ConfigError

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.camera import Camera, CameraRig
    from torchpose.design import Imaging, Need, Precision, WorkingVolume
    from torchpose.target import Target

_Need = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LATERAL DEPTH", help="Standard deviations needed across and along the optical axis, um."),
]
_TARGET = "Existing target, file or built-in name: its sheet instead of a new design."
_RANGE = "Nearest and farthest distance, mm."
_TILT = "Largest tilt against the optical axis, in any direction, degrees."
_OFFSET = "Largest distance off the optical axis, mm."
_ANGLE = "Standard deviation needed about every axis, degrees."
_MARKERS = "Number of rings: 4, 6, 8, 9, 10 or 12; by default the fewest that do."
_PRINT = (
    "How the target is printed: glass (places off by 1 um, edges by 1), plotter (10, 15), laser (70, 60), or standard "
    "deviations PLACES,GAIN or PLACES,GAIN,FLATNESS in um. By default exactly."
)
_GAIN = "Most dot gain of the print, either way, um: room for it is left between codes; by default that of --print."
_LEVELS = "Grey levels of print and paper."
_APERTURE = "Aperture: counts the blur out of focus and notes the depth of field."
_PAPER = (
    "Also the sheet on office paper: one page, or tiles with marks to join them, each with bars to verify its scale."
)
_TONE = "Tone around the rings: dark rings on light, or the reverse."
_CAMERAS = (
    "File of several cameras instead of --camera: the accuracy is that of one pose from all of them, the volume as the "
    "first one has it."
)
_SECOND = (
    "A second camera like --camera, turned by so many degrees about the vertical through the middle of the volume."
)


def design(
    out: Annotated[Path, folder_option("Folder for target file, print sheet, table and map.")],
    camera: Annotated[str | None, camera_option("Camera file, as for estimate.")] = None,
    cameras: Annotated[Path | None, typer.Option(metavar="RIG", help=_CAMERAS)] = None,
    second_camera: Annotated[float | None, typer.Option(metavar="ANGLE", help=_SECOND)] = None,
    target: Annotated[str | None, target_option(_TARGET)] = None,
    distance: Annotated[float | None, typer.Option(help="Distance of the target, mm.")] = None,
    distance_range: Annotated[tuple[float, float] | None, typer.Option(metavar="NEAR FAR", help=_RANGE)] = None,
    tilt: Annotated[float, typer.Option(help=_TILT)] = 0.0,
    roll: Annotated[float, typer.Option(help="Largest turn about the optical axis, degrees; 180: any.")] = 180.0,
    offset: Annotated[tuple[float, float], typer.Option(metavar="X Y", help=_OFFSET)] = (0.0, 0.0),
    plate: Annotated[str | None, typer.Option(metavar="WxH", help="Width and height of the plate, mm.")] = None,
    accuracy_um: _Need = None,
    accuracy_deg: Annotated[float | None, typer.Option(help=_ANGLE)] = None,
    markers: Annotated[int | None, typer.Option(min=3, max=1000, help=_MARKERS)] = None,
    printing: Annotated[str | None, typer.Option("--print", metavar="CLASS", help=_PRINT)] = None,
    print_gain: Annotated[float | None, typer.Option(metavar="UM", help=_GAIN)] = None,
    blur: Annotated[float, typer.Option(help="Standard deviation of the lens's blur in focus, px.")] = 0.7,
    noise: Annotated[float, typer.Option(help="Standard deviation of the noise, grey levels of 255.")] = 2.0,
    levels: Annotated[tuple[float, float], typer.Option(metavar="DARK LIGHT", help=_LEVELS)] = (30.0, 220.0),
    f_number: Annotated[float | None, typer.Option(help=_APERTURE)] = None,
    focal_length: Annotated[float | None, typer.Option(help="Of the lens, mm; with --f-number.")] = None,
    background: Annotated[str, typer.Option(metavar="light|dark", help=_TONE)] = "light",
    name: Annotated[str | None, typer.Option(help="Name of the target and of the files.")] = None,
    paper: Annotated[str | None, typer.Option(metavar="a4|letter", help=_PAPER)] = None,
) -> int:
    """Choose a target for a camera, a working volume and an accuracy, and draw it at true scale (SVG, PDF).

    Standard deviations are those of the image noise, of the print (--print) and of what the camera file states of
    itself. The target is the one with the fewest rings that does, at the worst point of the volume.
    """
    from torchpose.design import Need, print_of
    from torchpose.report.files import make_folder
    from torchpose.target import Target

    sides = None if plate is None else _sides(plate)
    _check({"--plate": plate, "--accuracy-um": accuracy_um}, target, (name, markers, print_gain))
    existing, scene = None if target is None else Target.load(target), None
    if existing is None or any(x is not None for x in (camera, cameras, second_camera, distance, distance_range)):
        volume = _volume(distance, distance_range, tilt, roll, offset)
        rig = _rig(camera, cameras, second_camera, volume)
        scene = _Scene(rig, volume, _imaging(volume, blur, noise, levels, f_number, focal_length), second_camera)
    made = None if printing is None else print_of(printing)
    need = None if accuracy_um is None else Need(*accuracy_um, *(() if accuracy_deg is None else (accuracy_deg,)))
    make_folder(out, "--out")
    promise: _Promise | None
    written: list[Path] = []
    if existing is None:
        gain = None if print_gain is None else print_gain / 1e3
        choice = {"name": name, "background": background, "markers": markers, "printing": made, "print_gain": gain}
        chosen, promise, written = _new_target(scene, sides, need, out, choice)
    else:
        chosen = existing if made is None else made.stated_by(existing)
        promise = None if scene is None else _Promise.of(scene, chosen)
    written += _sheets(chosen, sides, paper, out)
    if scene is not None and promise is not None:
        written += _tell_precision(chosen, scene, promise, need, out)
    for path in written:
        say(str(path))
    return 0


def _sheets(target: Target, sides: tuple[float, float] | None, paper: str | None, out: Path) -> list[Path]:
    """Writes the print sheet, and that on office paper where it is wanted."""
    from torchpose.design import make_sheet, plate_around, save_tiles

    sheet = make_sheet(target, sides or plate_around(target))
    written = sheet.save(out, target.name)
    return written if paper is None else [*written, save_tiles(sheet, paper, out, target.name)]


def _check(needed: dict[str, object], target: str | None, chosen: tuple[object, ...]) -> None:
    """Refuses a design without what it needs, and choices about a target that is there already."""
    if target is None:
        for option, value in needed.items():
            if value is None:
                raise ConfigError(f"{option}: is missing; a design needs it (--target draws an existing target alone)")
    elif any(value is not None for value in chosen):
        raise ConfigError("--target: is there already; leave --name, --markers and --print-gain out")


@dataclass(frozen=True)
class _Scene:
    rig: CameraRig
    volume: WorkingVolume
    imaging: Imaging
    angle: float | None = None  # to a second camera that is not there yet, degrees

    @property
    def camera(self) -> Camera:
        """The one there is, or the first."""
        return self.rig.cameras[0]


@dataclass(frozen=True, eq=False)
class _Promise:
    """Predicted precision of a target as printed, and once it is measured; None where its file states no print."""

    printed: Precision
    measured: Precision | None

    @classmethod
    def of(cls, scene: _Scene, target: Target) -> _Promise:
        from torchpose.design import measured, predict_volume

        setting = scene.volume, scene.imaging
        printed = predict_volume(scene.rig, target, *setting)
        if target.covariance is None:
            return cls(printed, None)
        return cls(printed, predict_volume(scene.rig, measured(scene.camera, target, *setting), *setting))


def _rig(camera: str | None, cameras: Path | None, second: float | None, volume: WorkingVolume) -> CameraRig:
    """The cameras of the options; one where there is one."""
    from torchpose.analysis import with_second
    from torchpose.camera import Camera, CameraRig

    if cameras is not None:
        for option, given in (("--camera", camera), ("--second-camera", second)):
            if given is not None:
                raise ConfigError(f"{option}: stands beside --cameras; give one of them")
        return CameraRig.load(cameras)
    if camera is None:
        raise ConfigError("--camera: is missing; give the camera file, or --cameras with that of several")
    if second is None:
        return CameraRig.alone(Camera.load(camera))
    if not 0 < abs(second) <= MOST_ANGLE:
        raise ConfigError(f"--second-camera: {second:g} degrees; give an angle up to {MOST_ANGLE:g} that is not 0")
    return with_second(Camera.load(camera), float(volume.middle[1][0, 2]), math.radians(second))


def _volume(
    distance: float | None, limits: tuple[float, float] | None, tilt: float, roll: float, offset: tuple[float, float]
) -> WorkingVolume:
    from torchpose.design import WorkingVolume

    if limits is None:
        if distance is None:
            raise ConfigError("--distance: is missing; give the distance of the target in mm")
        limits = distance, distance
    return WorkingVolume(limits, offset, math.radians(tilt), math.radians(roll), distance)


def _imaging(
    volume: WorkingVolume,
    blur: float,
    noise: float,
    levels: tuple[float, float],
    f_number: float | None,
    focal_length: float | None,
) -> Imaging:
    from torchpose.design import Imaging, best_focus
    from torchpose.sim import Defocus

    lens = None
    if f_number is not None and focal_length is not None:
        lens = Defocus(f_number, focal_length, best_focus(*volume.distance))
    elif f_number is not None or focal_length is not None:
        raise ConfigError("--f-number: goes together with --focal-length; give both or neither")
    return Imaging(blur, noise, *levels, lens=lens)


def _sides(text: str) -> tuple[float, float]:
    number = r"(\d+\.?\d*|\.\d+)"
    match = re.fullmatch(rf"{number}[xX]{number}", text)
    if match is None:
        raise ConfigError(f"--plate: {text!r} is not a size; write width x height in mm, such as 70x50")
    return float(match[1]), float(match[2])


def _new_target(
    scene: _Scene | None, plate: tuple[float, float] | None, need: Need | None, out: Path, choice: dict[str, Any]
) -> tuple[Target, _Promise, list[Path]]:
    """The designed target, its precision and its file; its rings are told."""
    from torchpose.design import design_target

    assert scene  # checked with the options
    assert need
    assert plate
    made = design_target(scene.rig, scene.volume, plate, need, scene.imaging, **choice)
    ratios = ", ".join(f"{ratio:.2f}" for ratio in sorted(made.target.codes.sqrt().tolist()))
    say(
        f"{len(made.target)} rings of {2 * made.radius:g} mm, semi-minor axis at least {made.semi_minor:.0f} px; "
        f"inner/outer {ratios}, neighbours {made.code_gap:.1f} tolerances of reading apart"
    )
    path = out / f"{made.target.name}.yaml"
    made.target.save(path)
    return made.target, _Promise(made.precision, made.measured), [path]


def _tell_precision(target: Target, scene: _Scene, promise: _Promise, need: Need | None, out: Path) -> list[Path]:
    """Tells the predicted precision of a target; paths of its table and map."""
    from torchpose.cli.terminal import print_table
    from torchpose.design import precision_map, predict_volume
    from torchpose.io.writers import write_rows
    from torchpose.report.design import save_plot

    setting, alone = (target, scene.volume, scene.imaging), None
    if len(scene.rig) > 1:
        alone = predict_volume(scene.camera, *setting)
        for line in _seen(scene, target):
            say(line)
    rows = promise.printed.rows(need, promise.measured, alone)
    columns = [column.replace("_", " ") for column in rows[0]]
    print_table(f"{target.name}: predicted standard deviations", columns, [list(row.values()) for row in rows])
    say(_print_told(target, promise, need))
    say(_focus(scene))
    table, picture = out / f"{target.name}_precision.csv", out / f"{target.name}_map.png"
    write_rows(table, rows, {column: str if column in ("axis", "unit") else float for column in rows[0]})
    save_plot(precision_map(scene.rig, *setting), target.name, picture, scene.volume)
    return [table, picture, *(() if scene.angle is None else _angles(scene, target, out))]


def _angles(scene: _Scene, target: Target, out: Path) -> list[Path]:
    """What a second camera tells by its angle, in the middle of the volume: table and plot."""
    from torchpose.cli.sensitivity_rig import Setting, second_camera

    imaging, middle = scene.imaging, scene.volume.middle[1][:, 2]
    seen = {"psf_sigma": float(imaging.blur(scene.camera, middle)), "noise_sigma": imaging.noise}
    setting = Setting(middle, 0.0, seen | {"dark": imaging.dark, "light": imaging.light})
    return second_camera(scene.camera, target, setting).save(out)


def _seen(scene: _Scene, target: Target) -> Iterator[str]:
    """How much of the target each camera but the first has where the volume ends."""
    from torchpose.design import share_that_counts

    for number, name in enumerate(scene.rig.names[1:], 1):
        share = share_that_counts(scene.rig, number, target, scene.volume)
        yield f"{name}: counts with {100 * share:.0f} % of the rings over the borders of the volume"


def _print_told(target: Target, promise: _Promise, need: Need | None) -> str:
    """What the print costs, and what measuring it buys."""
    from torchpose.design import MEASURING_VIEWS, scale_deviation

    if promise.measured is None:
        return "print: counted as exact; give --print glass, plotter, laser or PLACES,GAIN in um"
    verdict = "counted as the target file states it"
    if need is not None:
        enough = float(need.excess(promise.printed.worst)) <= 1
        verdict = "good enough as it comes" if enough else "too coarse as it comes, good enough once it is measured"
    return (
        f"print: {verdict}; worst measured: after torchpose calibrate --measure-target with {MEASURING_VIEWS} views, "
        f"in the scale of the print: {100 * scale_deviation(target):.2g} % of any length, unless --distance tells it"
    )


def _focus(scene: _Scene) -> str:
    """What the aperture does to the depth of field."""
    from torchpose.design import sharp_range

    lens, psf = scene.imaging.lens, scene.imaging.psf_sigma
    if lens is None:
        return "depth of field: not counted; give --f-number and --focal-length"
    near, far = sharp_range(scene.camera, lens, psf)
    ends = zip(scene.imaging.blur_at(scene.camera, scene.volume.distance), scene.volume.distance, strict=True)
    beyond = near > scene.volume.distance[0] or far < scene.volume.distance[1]
    return (
        f"depth of field: focused on {lens.focus_distance:.4g} mm, where the blur is {psf:g} px; {near:.4g} to "
        f"{far:.4g} mm with at most 1.41 times as much; {', '.join(f'{blur:.2f} px at {z:g} mm' for blur, z in ends)}"
        + ("; beyond that range the depth errs by more than predicted" if beyond else "")
    )

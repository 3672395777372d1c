"""``torchpose design``: from camera, working volume and accuracy to a target file, its precision and a print sheet."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.errors import ConfigError

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.camera import Camera
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
_GAIN = "Most dot gain of the print, either way, um: room for it is left between codes (office printers: 60 to 100)."
_LEVELS = "Grey levels of print and paper."
_APERTURE = "Aperture: counts the blur out of focus and notes the depth of field."
_TONE = "Tone around the rings: dark rings on light, or the reverse."


def design(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for target file, print sheet, table and map.")],
    camera: Annotated[str | None, typer.Option(help="Camera file, as for estimate.")] = None,
    target: Annotated[str | None, typer.Option(help=_TARGET)] = None,
    distance: Annotated[float | None, typer.Option(help="Distance of the target, mm.")] = None,
    distance_range: Annotated[tuple[float, float] | None, typer.Option(metavar="NEAR FAR", help=_RANGE)] = None,
    tilt: Annotated[float, typer.Option(help=_TILT)] = 0.0,
    roll: Annotated[float, typer.Option(help="Largest turn about the optical axis, degrees; 180: any.")] = 180.0,
    offset: Annotated[tuple[float, float], typer.Option(metavar="X Y", help=_OFFSET)] = (0.0, 0.0),
    plate: Annotated[str | None, typer.Option(metavar="WxH", help="Width and height of the plate, mm.")] = None,
    accuracy_um: _Need = None,
    accuracy_deg: Annotated[float | None, typer.Option(help=_ANGLE)] = None,
    markers: Annotated[int | None, typer.Option(help=_MARKERS)] = None,
    print_gain: Annotated[float, typer.Option(metavar="UM", help=_GAIN)] = 0.0,
    blur: Annotated[float, typer.Option(help="Standard deviation of the lens's blur in focus, px.")] = 0.7,
    noise: Annotated[float, typer.Option(help="Standard deviation of the noise, grey levels of 255.")] = 2.0,
    levels: Annotated[tuple[float, float], typer.Option(metavar="DARK LIGHT", help=_LEVELS)] = (30.0, 220.0),
    f_number: Annotated[float | None, typer.Option(help=_APERTURE)] = None,
    focal_length: Annotated[float | None, typer.Option(help="Of the lens, mm; with --f-number.")] = None,
    background: Annotated[str, typer.Option(metavar="light|dark", help=_TONE)] = "light",
    name: Annotated[str | None, typer.Option(help="Name of the target and of the files.")] = None,
) -> int:
    """Choose a target for a camera, a working volume and an accuracy, and draw it at true scale (SVG, PDF).

    Standard deviations are those of the image noise with an exactly known camera and print. The target is the one with
    the fewest rings that does, at the worst point of the volume.
    """
    from torchpose.design import Need, make_sheet, plate_around, predict_volume
    from torchpose.report.files import make_folder
    from torchpose.target import Target

    sides = None if plate is None else _sides(plate)
    if target is None:
        for option, value in (("--plate", plate), ("--accuracy-um", accuracy_um)):
            if value is None:
                raise ConfigError(f"{option}: is missing; a design needs it (--target draws an existing target alone)")
    elif name is not None or markers is not None or print_gain != 0:
        raise ConfigError("--target: is there already; leave --name, --markers and --print-gain out")
    existing = None if target is None else Target.load(target)
    scene = None
    if existing is None or camera is not None or distance is not None or distance_range is not None:
        volume = _volume(distance, distance_range, tilt, roll, offset)
        scene = _Scene(_camera(camera), volume, _imaging(volume, blur, noise, levels, f_number, focal_length))
    need = None if accuracy_um is None else Need(*accuracy_um, *(() if accuracy_deg is None else (accuracy_deg,)))
    make_folder(out, "--out")
    if existing is None:
        assert scene is not None
        assert need is not None
        assert sides is not None
        chosen, precision, written = _new_target(scene, sides, need, out, (name, background, markers, print_gain / 1e3))
    else:
        chosen, written = existing, []
        if scene is not None:
            precision = predict_volume(scene.camera, chosen, scene.volume, scene.imaging)
    written += make_sheet(chosen, sides or plate_around(chosen)).save(out, chosen.name)
    if scene is not None:
        written += _tell_precision(chosen, scene, precision, need, out)
    for path in written:
        typer.echo(str(path))
    return 0


@dataclass(frozen=True)
class _Scene:
    camera: Camera
    volume: WorkingVolume
    imaging: Imaging


def _camera(name: str | None) -> Camera:
    from torchpose.camera import Camera

    if name is None:
        raise ConfigError("--camera: is missing; give the camera file")
    return Camera.load(name)


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
    scene: _Scene,
    plate: tuple[float, float],
    need: Need,
    out: Path,
    choice: tuple[str | None, str, int | None, float],
) -> tuple[Target, Precision, list[Path]]:
    """The designed target, its precision and its file; its rings are told."""
    from torchpose.design import design_target

    named = dict(zip(("name", "background", "markers", "print_gain"), choice, strict=True))
    made = design_target(scene.camera, scene.volume, plate, need, scene.imaging, **named)
    ratios = ", ".join(f"{ratio:.2f}" for ratio in sorted(made.target.codes.sqrt().tolist()))
    typer.echo(
        f"{len(made.target)} rings of {2 * made.radius:g} mm, semi-minor axis at least {made.semi_minor:.0f} px; "
        f"inner/outer {ratios}, neighbours {made.code_gap:.1f} tolerances of reading apart"
    )
    path = out / f"{made.target.name}.yaml"
    made.target.save(path)
    return made.target, made.precision, [path]


def _tell_precision(target: Target, scene: _Scene, precision: Precision, need: Need | None, out: Path) -> list[Path]:
    """Tells the predicted precision of a target; paths of its table and map."""
    from torchpose.cli.terminal import print_table
    from torchpose.design import precision_map
    from torchpose.io.writers import write_rows
    from torchpose.report.design import save_plot

    rows = precision.rows(need)
    columns = [column.replace("_", " ") for column in rows[0]]
    print_table(f"{target.name}: predicted standard deviations", columns, [list(row.values()) for row in rows])
    typer.echo(_focus(scene))
    table, picture = out / f"{target.name}_precision.csv", out / f"{target.name}_map.png"
    write_rows(table, rows, {column: str if column in ("axis", "unit") else float for column in rows[0]})
    save_plot(precision_map(scene.camera, target, scene.volume, scene.imaging), target.name, picture)
    return [table, picture]


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

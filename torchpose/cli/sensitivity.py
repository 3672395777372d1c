"""``torchpose sensitivity``: which error source dominates which axis, over the working distance."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.analysis.sensitivity import Uncertainty
    from torchpose.analysis.sweep import Sweep

EPILOG = """
Examples:

`torchpose sensitivity --out out/fig04` (the paper's Fig. 4: 8 mm target, 12 to 32 mm)

`torchpose sensitivity --camera camera.yaml --target quad40 --distance 120 200 --sigma-px 0.01
--focal-error-percent 0.05 --principal-point-px 1 --print-um 5 --tilt-deg 20 --out out/budget`

docs/sensitivity.md explains tables and plots. Exit codes: 0 computed; 2 a usage or configuration error.
"""


def sensitivity(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for tables (.csv) and plots (.png).")],
    camera: Annotated[Path | None, typer.Option(help="Camera file; by default the paper's camera.")] = None,
    target: Annotated[str, typer.Option(help="Target file, or the name of a built-in target.")] = "quad8",
    distance: Annotated[tuple[float, float], typer.Option(metavar="NEAR FAR", help="Working distances, mm.")] = (
        12.0,
        32.0,
    ),
    steps: Annotated[int, typer.Option(min=3, max=1000, help="Number of distances.")] = 11,
    tilt_deg: Annotated[float, typer.Option(help="Tilt of the target about the x axis.")] = 0.0,
    sigma_px: Annotated[
        list[float] | None,
        typer.Option(help="Standard deviation of a marker centre on each axis; may be repeated. By default 0.2 and 1."),
    ] = None,
    focal_error_percent: Annotated[float, typer.Option(help="Error of the focal length.")] = 0.25,
    principal_point_px: Annotated[float, typer.Option(help="Standard deviation of cx and cy.")] = 0.0,
    distortion: Annotated[
        str, typer.Option(metavar="LIST", help="Standard deviations of the camera's coefficients: 1e-3,1e-3,1e-5,1e-5.")
    ] = "",
    print_um: Annotated[float, typer.Option(help="Standard deviation of a printed centre, on each axis.")] = 0.0,
    flatness_um: Annotated[float, typer.Option(help="Standard deviation of a marker along its normal.")] = 0.0,
    radius_um: Annotated[float, typer.Option(help="Standard deviation of a printed radius.")] = 0.0,
    scale_percent: Annotated[float, typer.Option(help="Standard deviation of the print's scale.")] = 0.0,
    draws: Annotated[int, typer.Option(min=2, max=100000, help="Random draws at every distance.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
) -> int:
    """Predict pose errors by source over the working distance, and check the prediction by Monte-Carlo."""
    numbers = {
        "--principal-point-px": principal_point_px,
        "--print-um": print_um,
        "--flatness-um": flatness_um,
        "--radius-um": radius_um,
        "--scale-percent": scale_percent,
        "--focal-error-percent": focal_error_percent,
    }
    sigmas = sigma_px or [0.2, 1.0]
    for option, value in [*numbers.items(), *(("--sigma-px", s) for s in sigmas)]:
        least_open = option == "--sigma-px"
        if not (value > 0 if least_open else value >= 0) or not math.isfinite(value):
            raise ConfigError(f"sensitivity: {option}: is {value}; give a number {'above' if least_open else 'from'} 0")
    if not (0 < distance[0] < distance[1] < math.inf):
        raise ConfigError(f"sensitivity: --distance: is {distance[0]} {distance[1]}; give NEAR above 0 and FAR beyond")
    if not abs(tilt_deg) < 85:
        raise ConfigError(f"sensitivity: --tilt-deg: is {tilt_deg}; give an angle between -85 and 85")

    import torch

    from torchpose.analysis.sensitivity import Uncertainty
    from torchpose.camera import Camera
    from torchpose.studies.fig04_sensitivity import paper_camera, simulate, tabulate
    from torchpose.target import Target

    lens = Camera.load(camera) if camera else paper_camera()
    size = Uncertainty(
        focal_length=focal_error_percent / 100,
        principal_point=principal_point_px,
        distortion=_coefficients(distortion, len(lens.distortion)),
        print_centers=print_um / 1000,
        print_flatness=flatness_um / 1000,
        print_radii=radius_um / 1000,
        print_scale=scale_percent / 100,
    )
    at = torch.linspace(*distance, steps, dtype=torch.float64)
    cases = simulate(
        lens,
        Target.load(target),
        at,
        list(dict.fromkeys(sigmas)),
        size,
        tilt=math.radians(tilt_deg),
        draws=draws,
        seed=seed,
    )
    _check_view(cases)
    result = tabulate(cases)
    files = result.save(out)
    _show(cases, size)
    for path in files:
        typer.echo(str(path))
    return 0


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
    s = next(iter(cases.values()))
    lost = [d for d, seen in zip(s.distance.tolist(), s.budget.seen.all(1).tolist(), strict=True) if not seen]
    if lost:
        raise ConfigError(
            f"sensitivity: --distance: at {lost[0]:g} mm not all markers are in the frame; give distances "
            "from which the camera sees the whole target"
        )


def _show(cases: dict[str, Sweep], size: Uncertainty) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from torchpose.report.sensitivity import AXES, SCALE, UNITS

    console = Console(width=max(Console().width, 100))  # a pipe counts as 80 columns, which would cut the numbers
    for title, s in cases.items():
        table = Table(box=box.SIMPLE_HEAD, title=f"{title}: standard deviations by source")
        for name in ("distance mm", "source", *(f"{a} {u}" for a, u in zip(AXES, UNITS, strict=True))):
            table.add_column(name, justify="left" if name == "source" else "right")
        for k in (0, len(s.distance) // 2, len(s.distance) - 1):
            lines = {name: s.budget.std(name)[k] for name in s.budget.sources}
            lines |= {"total": s.budget.std()[k], "drawn, rms": s.rms[k], "drawn, largest": s.largest[k]}
            for i, (name, std) in enumerate(lines.items()):
                values = [f * v for f, v in zip(SCALE, std.tolist(), strict=True)]
                cells = [f"{v:.3g}" if v > 1e-9 else "0" for v in values]  # below, rounding
                table.add_row("" if i else f"{float(s.distance[k]):g}", name.replace("_", " "), *cells)
        console.print(table)
    if size.focal_length:
        console.print("focal length: the effect of an error of that very size")

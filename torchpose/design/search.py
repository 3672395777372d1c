"""The choice: the fewest rings that reach the accuracy needed at the worst point of the working volume."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpose.camera import Camera, CameraRig
from torchpose.design.layout import ARRANGEMENTS, Limits, Size, assign_codes, largest
from torchpose.design.precision import Need, Precision, on_device, predict_volume
from torchpose.design.predict import Imaging, deviations, edge_covariance
from torchpose.design.printing import PrintClass, measured
from torchpose.design.view import FRAME_MARGIN_PX, in_view, outlines
from torchpose.design.volume import WorkingVolume
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.identify.markers import ratio_tolerance
from torchpose.identify.scene import MOST_GAIN
from torchpose.target import Target

_RADII = 10  # outer radii tried for every number of rings
_MICRON = 1e-2  # mm, to which radii and places are rounded: a target file that people read


@dataclass(frozen=True, eq=False)
class Design:
    """A target and what it promises."""

    target: Target  # it states its print
    plate: Size
    limits: Limits  # of its rings
    precision: Precision  # over the working volume, as printed
    printing: PrintClass | None = None  # None: an exact print
    measured: Precision | None = None  # the same once a camera has measured the print; None of an exact one

    @property
    def radius(self) -> float:
        """Outer radius of all rings, mm."""
        return float(self.target.radii[0, 0])

    @property
    def semi_minor(self) -> float:
        """Semi-minor axis of the outer circles in the worst view, px."""
        return self.radius * self.limits.scale

    @property
    def code_gap(self) -> float:
        """Smallest difference of two inner/outer ratios, over the tolerance of their reading in the worst view."""
        gap = self.target.codes.sqrt().sort().values.diff().min()
        return float(gap) / ratio_tolerance(self.semi_minor)


@dataclass(frozen=True)
class Choice:
    """What may be chosen of a target."""

    name: str | None = None  # by default number of rings and size
    background: str = "light"  # or dark
    markers: int | None = None  # number of rings; by default the fewest that do
    printing: PrintClass | None = None  # what it is printed with; by default exactly
    print_gain: float | None = None  # most dot gain of the print either way, mm; by default that of ``printing``

    def __post_init__(self) -> None:
        if self.markers is not None and self.markers not in ARRANGEMENTS:
            raise ConfigError(
                f"markers: {self.markers}; there are layouts of {', '.join(map(str, ARRANGEMENTS))} rings"
            )
        if self.print_gain is not None and not 0 <= self.print_gain < math.inf:
            raise ConfigError(f"print_gain: {self.print_gain:g} mm; give a length from 0")

    @property
    def made(self) -> PrintClass | None:
        """What the target's file states of its print; None: nothing."""
        if self.print_gain is None:
            return self.printing
        gain = self.print_gain / MOST_GAIN
        if self.printing is not None:
            return replace(self.printing, gain=gain)
        return PrintClass(0.0, gain) if gain else None


@dataclass(frozen=True, eq=False)
class _Task:
    """What a target is searched for."""

    rig: CameraRig
    volume: WorkingVolume
    plate: Size
    need: Need
    imaging: Imaging
    choice: Choice
    limits: Limits

    @property
    def counts(self) -> list[int]:
        """Numbers of rings that are tried, rising."""
        return list(ARRANGEMENTS) if self.choice.markers is None else [self.choice.markers]

    @property
    def camera(self) -> Camera:
        """The one there is, or the first: it sees all of the target all over the volume."""
        return self.rig.cameras[0]

    def precision(self, target: Target) -> Precision:
        return predict_volume(self.rig, target, self.volume, self.imaging)

    def excess(self, precision: Precision) -> float:
        return float(self.need.excess(precision.worst).nan_to_num(nan=math.inf))

    def measured(self, target: Target) -> Target:
        return measured(self.camera, target, self.volume, self.imaging)


@checked
def design_target(
    camera: Camera | CameraRig, volume: WorkingVolume, plate: Size, need: Need, imaging: Imaging, **choice: Any
) -> Design:
    """The target with the fewest rings whose predicted standard deviations meet the need everywhere in the volume.

    For every number of rings the outer radius is the one with the smallest excess over the need: large rings have long
    edges, small ones lie farther out. Radii are compared by `edge_covariance`; what is promised comes from
    `predicted_covariance`. Where the print is too coarse, the target is the one that meets the need once it is
    measured.

    Args:
        camera: or several, whose poses together are to meet the need; the volume is that of the first, which also sets
            what the stages ask of the rings.
        plate: width and height, mm.
        choice: fields of `Choice`: ``name``, ``background``, ``markers``, ``printing``, ``print_gain``.

    Raises:
        ConfigError: the rings are out of view or too small, or the accuracy is out of reach, also of a measured target;
            with the figure that can be reached.
    """
    if not all(0 < side < math.inf for side in plate):
        raise ConfigError(f"plate: {plate[0]:g} x {plate[1]:g} mm; give two positive lengths")
    chosen, rig = Choice(**choice), CameraRig.of(camera)
    camera, made = rig.cameras[0], chosen.made
    gain = 0.0 if made is None else made.most_gain
    limits = Limits.of(camera, volume.least_scale(camera, (plate[0] / 2, plate[1] / 2)), gain)
    task = _Task(rig, volume, plate, need, imaging, chosen, limits)
    found = _fewest(task, lambda target: target)
    if found is None:
        raise _no_room(camera, volume, plate, limits, task.counts[0])
    target, precision = found
    if made is None:
        if task.excess(precision) > 1:
            raise _not_reached(task, target, precision)
        return Design(target, plate, limits, precision)
    later = task.precision(task.measured(target))
    if task.excess(precision) > 1:
        # another layout may be the best one of those that are measured
        again = _fewest(task, task.measured) or (target, later)
        target, later = again
        precision = task.precision(target)
        if task.excess(later) > 1:
            raise _not_reached(task, target, precision, later)
    return Design(target, plate, limits, precision, made, later)


def _fewest(task: _Task, as_used: Callable[[Target], Target]) -> tuple[Target, Precision] | None:
    """Of the best target of each number of rings the first that meets the need, or else the best; None: none has room.

    With its precision as it is used: as printed or as measured.
    """
    best: tuple[float, Target, Precision] | None = None
    for count in task.counts:
        target = _best(task, count, as_used)
        if target is None:
            continue
        precision = task.precision(as_used(target))
        excess = task.excess(precision)
        if best is None or excess < best[0]:
            best = excess, target, precision
        if excess <= 1:
            break
    return None if best is None else best[1:]


def _best(task: _Task, count: int, as_used: Callable[[Target], Target]) -> Target | None:
    """The target of so many rings with the smallest excess over the need; None where none is in view."""
    R, t = on_device(task.volume.extremes(), task.camera)
    some = slice(None, None, 7)  # 7 and the turns of the volume have no common factor: all of them are met

    def excess(target: Target) -> float:
        found = edge_covariance(task.rig, as_used(target), R[some], t[some], task.imaging)
        return float(task.need.excess(deviations(found)).max())

    seen = (one for one in _targets(task, count) if in_view(task.camera, outlines(one), R, t, FRAME_MARGIN_PX))
    return min(seen, key=excess, default=None)


def _targets(task: _Task, count: int) -> Iterator[Target]:
    """Targets of ``count`` rings of all radii that fit, which state their print."""
    limits, plate, made, device = task.limits, task.plate, task.choice.made, task.camera.matrix.device
    least, most = limits.outer / limits.scale, limits.largest_radius(count, plate)
    for radius in torch.linspace(least, most, _RADII, device="cpu").tolist() if most >= least else []:
        radius = math.floor(radius / _MICRON) * _MICRON
        ratios = limits.ratios(count, radius)
        if ratios is None:
            continue
        places = limits.places(count, plate, radius).to(device)
        ordered = assign_codes(places, ratios.to(device))
        centers = torch.nn.functional.pad(places, (0, 1))
        target = Target(
            name=task.choice.name or f"rings{count}_{plate[0]:g}x{plate[1]:g}",
            background=task.choice.background,  # type: ignore[arg-type]  # it checks
            ids=torch.arange(count, device=places.device),
            centers=_rounded(centers),
            normals=centers.new_tensor([0.0, 0.0, 1.0]).repeat(count, 1),
            radii=_rounded(torch.stack([torch.full_like(ordered, radius), radius * ordered], 1)),
        )
        yield target if made is None else made.stated_by(target)


def _rounded(length: Tensor) -> Tensor:
    # by division: 1234 / 100 is the float64 that 12.34 is read as
    return (length / _MICRON).round() / round(1 / _MICRON) + 0.0


def _no_room(camera: Camera, volume: WorkingVolume, plate: Size, limits: Limits, count: int) -> ConfigError:
    """Why no layout of ``count`` rings was found: they are out of view, or too small."""
    R, t = on_device(volume.extremes(), camera)
    corners = t.new_tensor([[x * plate[0], y * plate[1], 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    low = largest(lambda share: in_view(camera, share * corners, R, t, FRAME_MARGIN_PX), 1.0)
    if low < 0.999:
        return ConfigError(
            f"plate: {plate[0]:g} x {plate[1]:g} mm is larger than what is in view everywhere in the working volume, "
            f"about {low * plate[0]:.3g} x {low * plate[1]:.3g} mm; shrink it, keep farther away, or narrow offset, "
            "tilt or roll"
        )
    radius = limits.largest_radius(count, plate)
    enough = next(px for px in range(1, 2000) if limits.ratios(count, px / limits.scale) is not None)
    return ConfigError(
        f"plate: {plate[0]:g} x {plate[1]:g} mm has room for {count} rings of {2 * radius:.3g} mm, whose "
        f"semi-minor axis is {radius * limits.scale:.3g} px in the farthest, most tilted view; {count} codes "
        f"need {enough} px: enlarge the plate, come nearer, tilt less or take fewer markers"
    )


def _not_reached(task: _Task, best: Target, found: Precision, later: Precision | None = None) -> ConfigError:
    """What the best target reaches, as printed and measured."""
    need, made = task.need, task.choice.made
    angles = f" and {need.angle_deg:g} degrees" if math.isfinite(need.angle_deg) else ""
    has, printed = _figures(found), ""
    if made is not None and later is not None:
        printed = f" with a print of {made.told}, not even once it is measured (calibrate --measure-target)"
        has += f" as printed and {_figures(later)} as measured"
    return ConfigError(
        f"accuracy: {need.lateral_um:g} um lateral, {need.depth_um:g} um depth{angles} cannot be reached{printed}: the "
        f"best layout ({len(best)} rings of {2 * float(best.radii[0, 0]):.3g} mm) has {has} at its worst; enlarge the "
        "plate, come nearer, narrow the volume, or take less noise or more pixels a mm"
    )


def _figures(precision: Precision) -> str:
    worst = precision.worst
    lateral, depth, angle = float(worst[:2].max()), float(worst[2]), float(worst[3:].max()) / 1e3
    return f"{lateral:.3g} um, {depth:.3g} um and {angle:.2g} degrees"

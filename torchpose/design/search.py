"""The choice: the fewest rings that reach the accuracy needed at the worst point of the working volume."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.design.layout import ARRANGEMENTS, Limits, Size, assign_codes, largest
from torchpose.design.precision import FRAME_MARGIN_PX, Need, Precision, on_device, predict_volume
from torchpose.design.predict import Imaging, deviations, edge_covariance, in_view, outlines
from torchpose.design.volume import WorkingVolume
from torchpose.errors import ConfigError
from torchpose.identify.markers import ratio_tolerance
from torchpose.identify.scene import MOST_GAIN
from torchpose.target import Target

_RADII = 10  # outer radii tried for every number of rings
_MICRON = 1e-2  # mm, to which radii and places are rounded: a target file that people read


@dataclass(frozen=True, eq=False)
class Design:
    """A target and what it promises."""

    target: Target
    plate: Size
    limits: Limits  # of its rings
    precision: Precision  # over the working volume

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
    print_gain: float = 0.0  # most dot gain of the print either way, mm: room for it is left between codes


def design_target(
    camera: Camera, volume: WorkingVolume, plate: Size, need: Need, imaging: Imaging, **choice: Any
) -> Design:
    """The target with the fewest rings whose predicted standard deviations meet the need everywhere in the volume.

    For every number of rings the outer radius is the one with the smallest excess over the need: large rings have long
    edges, small ones lie farther out. Radii are compared by `edge_covariance`; what is promised comes from
    `predicted_covariance`.

    Args:
        plate: width and height, mm.
        choice: fields of `Choice`: ``name``, ``background``, ``markers``, ``print_gain``.

    Raises:
        ConfigError: the rings are out of view or too small, or the accuracy is out of reach; with the figure that can
            be reached.
    """
    if not all(0 < side < math.inf for side in plate):
        raise ConfigError(f"plate: {plate[0]:g} x {plate[1]:g} mm; give two positive lengths")
    chosen = Choice(**choice)
    markers, background = chosen.markers, chosen.background
    if markers is not None and markers not in ARRANGEMENTS:
        raise ConfigError(f"markers: {markers}; there are layouts of {', '.join(map(str, ARRANGEMENTS))} rings")
    if not 0 <= chosen.print_gain < math.inf:
        raise ConfigError(f"print_gain: {chosen.print_gain:g} mm; give a length from 0")
    limits = Limits.of(camera, volume.least_scale(camera, (plate[0] / 2, plate[1] / 2)), chosen.print_gain)
    best: tuple[float, Design] | None = None
    counts = list(ARRANGEMENTS) if markers is None else [markers]
    for count in counts:
        target = _best(camera, volume, need, imaging, _targets(limits, count, plate, camera.matrix.device))
        if target is None:
            continue
        name = chosen.name or f"rings{count}_{plate[0]:g}x{plate[1]:g}"
        target = replace(_stating(target, chosen.print_gain), name=name, background=background)  # type: ignore[arg-type]  # it checks
        precision = predict_volume(camera, target, volume, imaging)
        excess = float(need.excess(precision.worst).nan_to_num(nan=math.inf))
        if best is None or excess < best[0]:
            best = excess, Design(target, plate, limits, precision)
        if excess <= 1:
            break
    if best is None:
        raise _no_room(camera, volume, plate, limits, counts[0])
    if best[0] > 1:
        raise _not_reached(best[1], need)
    return best[1]


def _best(
    camera: Camera, volume: WorkingVolume, need: Need, imaging: Imaging, targets: Iterable[Target]
) -> Target | None:
    """The target with the smallest excess over the need; None where none is in view."""
    R, t = on_device(volume.extremes(), camera)
    some = slice(None, None, 7)  # 7 and the turns of the volume have no common factor: all of them are met

    def excess(target: Target) -> float:
        return float(need.excess(deviations(edge_covariance(camera, target, R[some], t[some], imaging))).max())

    seen = (one for one in targets if in_view(camera, outlines(one), R, t, FRAME_MARGIN_PX))
    return min(seen, key=excess, default=None)


def _targets(limits: Limits, count: int, plate: Size, device: torch.device) -> Iterator[Target]:
    """Targets of ``count`` rings of all radii that fit."""
    least, most = limits.outer / limits.scale, limits.largest_radius(count, plate)
    for radius in torch.linspace(least, most, _RADII, device="cpu").tolist() if most >= least else []:
        radius = math.floor(radius / _MICRON) * _MICRON
        ratios = limits.ratios(count, radius)
        if ratios is None:
            continue
        places = limits.places(count, plate, radius).to(device)
        ordered = assign_codes(places, ratios.to(device))
        centers = torch.nn.functional.pad(places, (0, 1))
        yield Target(
            name="rings",
            background="light",
            ids=torch.arange(count, device=places.device),
            centers=_rounded(centers),
            normals=centers.new_tensor([0.0, 0.0, 1.0]).repeat(count, 1),
            radii=_rounded(torch.stack([torch.full_like(ordered, radius), radius * ordered], 1)),
        )


def _stating(target: Target, gain: float) -> Target:
    """The target with the standard deviation of its edge gain, so that codes are read up to ``gain`` mm."""
    if gain == 0:
        return target
    covariance = target.centers.new_zeros(3 * len(target) + 1, 3 * len(target) + 1)
    covariance[-1, -1] = (gain / MOST_GAIN) ** 2
    return replace(target, covariance=covariance)


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


def _not_reached(best: Design, need: Need) -> ConfigError:
    worst = best.precision.worst
    lateral, depth, angle = float(worst[:2].max()), float(worst[2]), float(worst[3:].max()) / 1e3
    angles = f" and {need.angle_deg:g} degrees" if math.isfinite(need.angle_deg) else ""
    return ConfigError(
        f"accuracy: {need.lateral_um:g} um lateral, {need.depth_um:g} um depth{angles} cannot be reached: the best "
        f"layout ({len(best.target)} rings of {2 * best.radius:.3g} mm) has {lateral:.3g} um, "
        f"{depth:.3g} um and {angle:.2g} degrees at its worst; enlarge the plate, come nearer, narrow the volume, or "
        "take less noise or more pixels a mm"
    )

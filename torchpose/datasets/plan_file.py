"""What a plan file of a simulated data set may hold: every field with its range."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from torchpose.config import shown
from torchpose.config.kinds import MOST_LENGTH, Degrees, Length, Number, Seed, Word
from torchpose.sim.prints import Warp

MOST_FRAMES = 100_000  # of a plan (convention): two terabytes of 20 megapixels
MOST_CLUTTER = 10_000  # discs in a frame (convention)
MOST_DPI = 20_000  # cells an inch (convention): a photoplotter has a third of it
_MOST_ARGUMENT = 4096  # of a fault (convention): a frame of that side still fits into memory
_MOST_ARGUMENT_LENGTH = 100  # entries of a list (convention)

Vector = Annotated[list[Length], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Length], Field(min_length=2, max_length=2)]


def _range(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [value, value]
    if not isinstance(value, list) or len(value) != 2 or not all(isinstance(v, int | float) for v in value):
        raise ValueError(f"is {shown(value)}; give a number or [low, high]")
    if value[0] > value[1]:
        raise ValueError(f"has the limits {value[0]:g} > {value[1]:g}; swap them")
    return value


Range = Annotated[list[Number], BeforeValidator(_range)]
"""[low, high], from which every frame draws its own value; a plain number stands for both."""


def _within(low: float, high: float, fix: str, *, above: bool = False) -> AfterValidator:
    """Ranges within limits: from ``low``, or above it, to ``high``; all limits are conventions, beyond any camera."""

    def check(value: list[float]) -> list[float]:
        if value[0] < low or (above and value[0] == low):
            raise ValueError(f"is {value[0]:g}; {fix}")
        if value[1] > high:
            raise ValueError(f"is {value[1]:g}; {fix}, at most {high:g}")
        return value

    return AfterValidator(check)


Place = Annotated[Range, _within(-MOST_LENGTH, MOST_LENGTH, "give mm")]
Turn = Annotated[Range, _within(-3600.0, 3600.0, "give degrees")]
Blur = Annotated[Range, _within(0.0, 100.0, "the blur must be above 0 px, such as 0.3 for a sharp lens", above=True)]
Move = Annotated[Range, _within(0.0, 1e4, "give the length of the move during the exposure, 0 or more")]
Ratio = Annotated[Range, _within(1.0, 100.0, "give the larger standard deviation over the smaller, 1 or more")]
Share = Annotated[Range, _within(0.0, 1.0, "give a share of the mean, 0 or more, such as 0.02")]
Grey = Annotated[Range, _within(0.0, 255.0, "give grey levels of 0..255, 0 or more")]
Level = Annotated[Range, _within(0.0, 1000.0, "give a grey level of 0..255; brighter ones are clipped")]
Extent = Annotated[Range, _within(0.0, 1000.0, "give px, 0 or more")]
Height = Annotated[Range, _within(0.0, 1000.0, "give half of the plate's height in mm, 0 or more")]
Scale = Annotated[Range, _within(-0.5, 0.5, "give the relative error of lengths, such as 0.001")]
Gain = Annotated[Range, _within(-10.0, 10.0, "give mm by which edges of dark areas move outwards")]
Noise = Annotated[Range, _within(0.0, 255.0, "give the standard deviation in grey levels, 0 or more")]


def _positive(high: float) -> Any:
    return Field(gt=0, le=high, allow_inf_nan=False)


def _up_to(high: float, low: float = 0.0) -> Any:
    return Field(ge=low, le=high, allow_inf_nan=False)


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Grid(_Section):
    """All combinations of pitch, yaw and roll with every position: R = Rz(roll) Ry(yaw) Rx(pitch)."""

    distance: Length
    angles_deg: Annotated[list[Degrees], Field(min_length=1)]
    positions: Annotated[list[Vector], Field(min_length=1)] = [[0.0, 0.0, 0.0]]

    @model_validator(mode="after")
    def _few_enough(self) -> Grid:
        _check_count(len(self.angles_deg) ** 3 * len(self.positions))
        return self


class Random(_Section):
    """A low-discrepancy (Halton) cover of position, tilt (any direction) and roll."""

    count: Annotated[int, Field(ge=1, le=MOST_FRAMES)]
    x: Place
    y: Place
    z: Place
    tilt_deg: Turn = [0.0, 45.0]
    roll_deg: Turn = [-180.0, 180.0]


class Axes(_Section):
    """Moves along and turns about one camera axis at a time, from one start."""

    start: Vector
    rotation_deg: Vector = [0.0, 0.0, 0.0]
    translations: list[Length] = []
    turns_deg: list[Degrees] = []

    @model_validator(mode="after")
    def _moves(self) -> Axes:
        if not self.translations and not self.turns_deg:
            raise ValueError("moves nothing; give translations or turns_deg")
        _check_count(3 * (len(self.translations) + len(self.turns_deg)))
        return self


class Poses(_Section):
    """One of the ways to say where the target is; ``file`` names a truth file."""

    grid: Grid | None = None
    random: Random | None = None
    axes: Axes | None = None
    file: Word | None = None

    @model_validator(mode="after")
    def _one(self) -> Poses:
        if len(self.model_fields_set) != 1:
            raise ValueError(f"holds {len(self.model_fields_set)} kinds; give one of grid, random, axes and file")
        return self


class Lens(_Section):
    """See `torchpose.sim.Defocus`."""

    f_number: Annotated[float, _positive(1e4)]
    focal_length: Annotated[float, _positive(MOST_LENGTH)]
    focus_distance: Annotated[float, _positive(MOST_LENGTH)]


class Light(_Section):
    """See `torchpose.sim.Lighting`."""

    gradient: Pair = [0.0, 0.0]
    point: Vector | None = None
    vignetting: Annotated[float, _up_to(1e3)] = 0.0


class Imaging(_Section):
    """Conditions of the picture, before the sensor."""

    psf_sigma: Blur = [0.7, 0.7]
    psf_ratio: Ratio = [1.0, 1.0]
    psf_deg: Turn = [0.0, 180.0]
    smear_px: Extent = [0.0, 0.0]
    smear_deg: Turn = [0.0, 180.0]
    disc_px: Extent = [0.0, 0.0]
    dark: Level = [30.0, 30.0]
    light: Level = [220.0, 220.0]
    surround: Level = [90.0, 90.0]
    plate: Pair | None = None
    background: Word | None = None
    motion_mm: Move = [0.0, 0.0]
    motion_deg: Move = [0.0, 0.0]
    clutter: Annotated[int, Field(ge=0, le=MOST_CLUTTER)] = 0
    covered: Annotated[float, _up_to(1.0)] = 0.0
    defocus: Lens | None = None
    lighting: Light | None = None
    coma_px: Extent = [0.0, 0.0]
    coma_deg: Turn = [0.0, 360.0]
    haze_px: Extent = [0.0, 0.0]
    haze_length: Annotated[float, _up_to(1e5, 1.5)] = 40.0
    ghost: Grey = [0.0, 0.0]
    speckle: Share = [0.0, 0.0]
    speckle_px: Annotated[float, _up_to(1e4, 1.5)] = 3.0
    flicker: Share = [0.0, 0.0]
    flicker_px: Annotated[float, _positive(1e6)] = 90.0

    @field_validator("plate")
    @classmethod
    def _plate(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and min(value) <= 0:
            raise ValueError("has a side that is not above 0; give its width and height in mm")
        return value

    @model_validator(mode="after")
    def _one_disc(self) -> Imaging:
        if self.defocus is not None and self.disc_px[1] > 0:
            raise ValueError("has both defocus and disc_px; give one of them")
        return self

    @model_validator(mode="after")
    def _behind(self) -> Imaging:
        if self.background is not None and self.plate is None:
            raise ValueError("has a background and no plate, which would hide it; add plate: [width, height]")
        return self


def _three(value: Any) -> Any:
    return [value] * 3 if isinstance(value, int | float) and not isinstance(value, bool) else value


class Paper(_Section):
    """See `torchpose.sim.Texture`."""

    share: Annotated[float, _up_to(1.0)]
    length: Annotated[float, _positive(1e4)]


class Print(_Section):
    """How the print differs from the target file, see `torchpose.sim.PrintErrors`."""

    each: Literal["set", "frame"] = "set"
    seed: Seed | None = None
    center_sigma: Annotated[list[Annotated[float, _up_to(100.0)]], BeforeValidator(_three)] = [0.0, 0.0, 0.0]
    gain: Gain = [0.0, 0.0]
    scale: Scale = [0.0, 0.0]
    warp: Height = [0.0, 0.0]
    warp_shape: Warp = "twist"
    warp_deg: Turn = [0.0, 180.0]
    texture: Paper | None = None
    dpi: Annotated[float, Field(ge=1, le=MOST_DPI)] | None = None

    @field_validator("center_sigma")
    @classmethod
    def _axes(cls, value: list[float]) -> list[float]:
        if len(value) != 3:
            raise ValueError(f"has {len(value)} entries; give a number or [x, y, z] in mm")
        return value


class Sensor(_Section):
    """Noise after EMVA 1288 and the stored depth; patterns as `torchpose.sim.SensorPattern`."""

    noise: Noise = [1.0, 1.0]
    full_well: Annotated[float, _positive(1e9)] | None = None
    bits: Literal[8, 10, 12, 16] = 8
    gamma: Annotated[float, Field(ge=0.1, le=10)] | Literal["srgb"] = 1.0
    prnu: Annotated[float, _up_to(1.0)] = 0.0
    column_noise: Annotated[float, _up_to(255.0)] = 0.0
    line_jitter: Annotated[float, _up_to(1000.0)] = 0.0
    seed: Seed | None = None


class Processing(_Section):
    """See `torchpose.sim.Processing`."""

    bayer: bool = False
    denoise: Annotated[float, _up_to(255.0)] = 0.0
    sharpen: Annotated[float, _up_to(100.0)] = 0.0
    sharpen_px: Annotated[float, _positive(16.0)] = 1.5  # px (convention): a wider one is no sharpening
    jpeg: Annotated[int, Field(ge=1, le=100)] | None = None


def _check_count(frames: int) -> None:
    if frames > MOST_FRAMES:
        raise ValueError(f"has {frames} frames; give at most {MOST_FRAMES}, the rest in another plan")


def _small(value: Any) -> bool:
    """Whether the arguments of a fault are such as fit into a moment and some megabytes."""
    if isinstance(value, list):
        return len(value) <= _MOST_ARGUMENT_LENGTH and all(map(_small, value))
    if isinstance(value, int | float):
        return abs(value) <= _MOST_ARGUMENT
    return isinstance(value, str | None)


class PlanFile(_Section):
    """A plan file, see docs/simulation.md; ``camera`` or, with poses in the first of them, ``cameras``."""

    camera: Word | None = None
    cameras: Word | None = None
    target: Word
    seed: Seed = 0
    poses: Poses
    print: Print | None = None
    imaging: Imaging = Imaging()
    sensor: Sensor = Sensor()
    processing: Processing = Processing()
    faults: dict[str, dict[str, Any]] = {}
    depth_range: Pair | None = None
    out_of_view: Literal["error", "mark"] = "error"
    bounds: bool = True

    @model_validator(mode="after")
    def _one_of(self) -> PlanFile:
        if bool(self.camera) == bool(self.cameras):
            raise ValueError("names no camera, or both kinds; give camera, or cameras (a rig)")
        return self

    @field_validator("faults")
    @classmethod
    def _modest(cls, value: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for name, arguments in value.items():
            for key, argument in arguments.items():
                if not _small(argument):
                    limit = f"numbers up to {_MOST_ARGUMENT:g}, in short lists"
                    raise ValueError(f"has {name}.{key} = {shown(argument)}; give {limit}")
        return value

"""What the numbers of a frame mean for someone at the rig: a level for each, and a sentence that says what to turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Literal

from torchpose.io.rows import Row
from torchpose.live.measures import CLIPPED_SOME, PictureMeasures, RingMeasures, usable_blurs

Level = Literal["good", "fair", "bad", "none"]

# what is good and what is bad of each quantity (conventions, between what docs/precision.md measures and what is lost)
_SHARP_PX, _SOFT_PX = 1.1, 2.0  # blur: the information of an edge goes with 1 / blur
_UNEVEN = 1.6  # of the sharpest ring's blur, above a third of a pixel of difference
_BRIGHT, _DIM = 0.5, 0.25  # light side of the rings, shares of full scale
_CLIPPED_MUCH = 0.05  # share of the pixels around the rings
_CONTRAST, _LITTLE_CONTRAST = 0.35, 0.15  # of full scale
_TILTED, _STEEP = 50.0, 65.0  # degrees
_LARGE_PX, _SMALL_PX = 30.0, 16.0  # outer diameter
_DARK_PICTURE, _FLAT_PICTURE = 0.12, 0.08  # shares of full scale: of its lightest parts, and from dark to light
_WHITE_PICTURE = 0.25  # share of clipped pixels with which nothing may be left of a target
_BLURRED_PICTURE = 2.0  # px of the reduced picture, of its sharpest edges: measured up to about three there


@dataclass(frozen=True)
class Advice:
    """One line of what to turn: a quantity with its value and unit, how good it is, and what to do.

    Attributes:
        at: where the value stands on a scale of 0 to 1.
        zone: where it is good there.
    """

    key: str
    name: str
    value: str
    unit: str
    level: Level
    text: str
    at: float | None = None
    zone: tuple[float, float] = (0.0, 0.0)


_STATUS = {
    "ok": ("good", "Pose found."),
    "ambiguous": ("fair", "Two poses explain the frame about equally well; the better one is shown."),
    "no_target": ("bad", "No marker of the target is found."),
    "too_few_markers": ("bad", "Fewer than three markers are found."),
    "rejected": ("bad", "Markers are found, but no pose explains them."),
    "unreadable": ("bad", "The frame could not be read."),
    "wrong_size": ("bad", "The frame has not the size of the camera file."),
}
_ELSE = "Bring the target into view, uncover it, or check that it is the one of the target file."
_REASONS = {
    "residual": "The centres do not fit the target: a mix-up, damage, or another camera or target file.",
    "ring_shape": "The rings' shapes contradict the pose: motion blur, or a mix-up.",
    "degenerate": "The markers seen lie on one line, or the view is edge-on.",
    "not_converged": "The fit did not settle.",
    "behind_camera": "The only solution lies behind the camera.",
    "two_solutions": "Tilt the target a little, or come nearer.",
    "mirrored": "The target is seen mirrored: turn the camera's mirroring off.",
}


def status_of(row: Row, picture: PictureMeasures | None, missing: Sequence[int]) -> tuple[Level, str, str]:
    """Level of a row's status, what it means, and what to do about it.

    Args:
        row: of the frame.
        picture: of the frame; None where there is none.
        missing: ids of the target's markers that were not found.
    """
    level, meaning = _STATUS[row["status"]]
    hint = _REASONS.get(row["reason"] or "", "")
    if row["status"] in ("no_target", "too_few_markers") and picture is not None:
        some = f"{_markers(missing)} not found: covered, or out of the picture."
        hint = _why_nothing(picture) or (some if row["status"] == "too_few_markers" else _ELSE)
    elif row["status"] in ("ok", "ambiguous") and missing:
        level, hint = "fair", f"{_markers(missing)} not found: covered, or out of the picture."
    return _level(level), meaning, hint


def _level(word: str) -> Level:
    levels: dict[str, Level] = {"good": "good", "fair": "fair", "bad": "bad"}
    return levels[word]


def _markers(missing: Sequence[int]) -> str:
    names = ", ".join(str(number) for number in missing[:4])
    more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
    return f"Marker {names} is" if len(missing) == 1 else f"Markers {names}{more} are"


def _why_nothing(picture: PictureMeasures) -> str:
    """The likeliest reason that a picture itself shows; nothing where it is as it should be."""
    if picture.clipped > _WHITE_PICTURE:
        return f"{100 * picture.clipped:.0f} % of the picture is clipped: shorten the exposure or close the aperture."
    if picture.high < _DARK_PICTURE:
        return "The picture is dark: lengthen the exposure, open the aperture or add light."
    if picture.high - picture.low < _FLAT_PICTURE:
        return "Nothing stands out: bring the target into view; look for a cap, fog or stray light."
    if picture.blur is not None and picture.blur > _BLURRED_PICTURE * picture.scale:
        return "Nothing in the picture is sharp: turn the focus."
    return ""


def advise(
    rings: Sequence[RingMeasures], picture: PictureMeasures | None, tilt_deg: float | None, sharpest: float | None
) -> list[Advice]:
    """What to turn, one line a quantity.

    Args:
        rings: of the markers found.
        picture: of the whole frame.
        tilt_deg: of the target against the line of sight.
        sharpest: least blur seen so far, px.
    """
    lines = [
        _focus(rings, picture, sharpest),
        _exposure(rings, picture),
        _contrast(rings, picture),
        _size(rings),
        _tilt(tilt_deg),
    ]
    return [_on_scale(line) for line in lines]


# of each quantity: the ends of its scale, the ends of where it is good, and whether the scale is logarithmic
_SCALES = {
    "focus": (0.0, 4.0, 0.0, _SHARP_PX, False),
    "exposure": (0.0, 100.0, 100 * _BRIGHT, 95.0, False),
    "contrast": (0.0, 100.0, 100 * _CONTRAST, 100.0, False),
    "size": (8.0, 512.0, _LARGE_PX, 512.0, True),
    "tilt": (0.0, 90.0, 0.0, _TILTED, False),
}


def _on_scale(line: Advice) -> Advice:
    low, high, start, end, by_ratio = _SCALES[line.key]

    def place(value: float) -> float:
        if by_ratio:
            return math.log(max(value, low) / low) / math.log(high / low)
        return (value - low) / (high - low)

    number = line.value.removeprefix("> ")
    at = min(1.0, max(0.0, place(float(number)))) if number else None
    return replace(line, at=at, zone=(place(start), min(1.0, place(end))))


def _focus(rings: Sequence[RingMeasures], picture: PictureMeasures | None, sharpest: float | None) -> Advice:
    blurs = [ring.blur for ring in rings if ring.blur is not None]
    if not blurs:
        if picture is None or picture.blur is None or picture.blur <= _BLURRED_PICTURE * picture.scale:
            return Advice("focus", "Blur", "", "px", "none", "No ring to measure it on.")
        return Advice("focus", "Blur", f"> {picture.blur:.0f}", "px", "bad", "Nothing is sharp: turn the focus.")
    blur, least, most = median(blurs), min(blurs), max(blurs)
    best = "" if sharpest is None else f" Sharpest so far {sharpest:.2f} px."
    level: Level = "good" if blur <= _SHARP_PX else "fair" if blur <= _SOFT_PX else "bad"
    text = "Sharp." if level == "good" else "Turn the focus until this is least."
    if len(usable_blurs(rings)) < len(blurs):
        return Advice("focus", "Blur", f"{blur:.2f}", "px", level, "Less than it is: the light side is clipped.")
    if most > _UNEVEN * least and most - least > 1 / 3:
        level = "fair" if level == "good" else level
        text = f"Uneven, {least:.2f} to {most:.2f} px: the target leaves the depth of field."
    return Advice("focus", "Blur", f"{blur:.2f}", "px", level, text + best)


def _exposure(rings: Sequence[RingMeasures], picture: PictureMeasures | None) -> Advice:
    lights = [ring.light for ring in rings if ring.light is not None]
    clipped = max((ring.clipped for ring in rings), default=0.0)
    if not lights:
        if picture is None:
            return Advice("exposure", "Light side", "", "%", "none", "No picture to measure it on.")
        value, share = f"{100 * picture.high:.0f}", f"{100 * picture.clipped:.1f} % of the picture is clipped"
        if picture.clipped > _CLIPPED_MUCH:
            return Advice("exposure", "Light side", value, "%", "bad", f"Over-exposed, {share}: shorten the exposure.")
        if picture.high < _DARK_PICTURE:
            return Advice("exposure", "Light side", value, "%", "bad", "Dark: lengthen the exposure or add light.")
        return Advice("exposure", "Light side", value, "%", "none", f"Of the whole picture; {share}.")
    light = median(lights)
    value, share = f"{100 * light:.0f}", f"{100 * clipped:.1f} % clipped at the rings"
    if clipped > CLIPPED_SOME:
        level: Level = "bad" if clipped > _CLIPPED_MUCH else "fair"
        return Advice("exposure", "Light side", value, "%", level, f"Over-exposed, {share}: shorten the exposure.")
    if light < _BRIGHT:
        level = "bad" if light < _DIM else "fair"
        return Advice("exposure", "Light side", value, "%", level, "Dark: lengthen the exposure or add light.")
    return Advice("exposure", "Light side", value, "%", "good", f"{share}.")


def _contrast(rings: Sequence[RingMeasures], picture: PictureMeasures | None) -> Advice:
    steps = [ring.light - ring.dark for ring in rings if ring.light is not None and ring.dark is not None]
    if not steps:
        return Advice("contrast", "Contrast", "", "%", "none", "No ring to measure it on.")
    step = min(steps)
    level: Level = "good" if step >= _CONTRAST else "fair" if step >= _LITTLE_CONTRAST else "bad"
    noise = "" if picture is None else f" Noise {100 * picture.noise:.2f} %."
    text = "Ample." if level == "good" else "More light, less stray light, a darker print."
    return Advice("contrast", "Contrast", f"{100 * step:.0f}", "%", level, text + noise)


def _size(rings: Sequence[RingMeasures]) -> Advice:
    if not rings:
        return Advice("size", "Ring diameter", "", "px", "none", "No ring to measure it on.")
    size = min(ring.outer_px for ring in rings)
    level: Level = "good" if size >= _LARGE_PX else "fair" if size >= _SMALL_PX else "bad"
    inner = min((ring.inner_px for ring in rings if ring.inner_px is not None), default=None)
    holes = "" if inner is None else f" Inner circle {inner:.0f} px."
    text = "Large enough." if level == "good" else "Come nearer, or take a longer lens or larger rings."
    return Advice("size", "Ring diameter", f"{size:.0f}", "px", level, text + holes)


def _tilt(tilt_deg: float | None) -> Advice:
    if tilt_deg is None:
        return Advice("tilt", "Tilt", "", "°", "none", "No pose to tell it by.")
    level: Level = "good" if tilt_deg <= _TILTED else "fair" if tilt_deg <= _STEEP else "bad"
    text = "To the line of sight." if level == "good" else "Steep: turn the target towards the camera."
    return Advice("tilt", "Tilt", f"{tilt_deg:.1f}", "°", level, text)


def accuracy_level(stated_um: float | None, wanted_um: float | None) -> Level:
    """How good a standard deviation is, beside the one that is wanted."""
    if stated_um is None or wanted_um is None:
        return "none"
    return "good" if stated_um <= wanted_um else "fair" if stated_um <= 2 * wanted_um else "bad"

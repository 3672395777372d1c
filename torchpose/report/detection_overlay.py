"""Pictures of what the detector saw: ellipses, polygons and segments, and with an explanation what it rejected."""

import math

import cv2
import numpy as np

from torchpose.io.rows import Row
from torchpose.report.overlay import Colour, draw_ellipse, draw_polyline, draw_text, eight_bit

_DARK, _LIGHT, _LINE, _REJECTED = (255, 200, 0), (255, 0, 220), (60, 200, 60), (60, 60, 230)


def draw_shapes(frame: np.ndarray, rows: list[Row]) -> np.ndarray:
    """Picture (H, W, 3) uint8, blue-green-red, of a frame (H, W) with the shapes of its rows.

    Ellipses that are dark inside are cyan, light ones magenta; those with a circle inside carry its ratio. Polygons and
    segments are green, rejected ellipses red with the reason.
    """
    picture = cv2.cvtColor(eight_bit(frame), cv2.COLOR_GRAY2BGR)
    unit = max(picture.shape[:2]) / 1000
    notes: list[tuple[str, tuple[float, float], Colour]] = []
    width = max(1, round(unit))  # that large frames still show it when they are shrunk to a screen
    for row in rows:
        if row["kind"] != "ellipse":
            points = np.array([float(v) for v in row["vertices"].split()]).reshape(-1, 2)
            draw_polyline(picture, points, _LINE, width)
            continue
        accepted = row["verdict"] == "accepted"
        if row["verdict"] == "duplicate":  # the better one is drawn
            continue
        colour: Colour = (_DARK if row["polarity"] > 0 else _LIGHT) if accepted else _REJECTED
        params = [row[c] for c in ("cx", "cy", "a", "b", "theta")]
        if max(map(abs, params[:4])) > 10 * max(picture.shape[:2]):  # beyond OpenCV's fixed point
            continue
        draw_ellipse(picture, params, colour, width)
        note = "" if accepted else row["verdict"].replace("_", " ")
        if accepted and row["ring_ratio"] is not None:
            note = f"{row['ring_ratio']:.2f}"
        if note:
            across = math.hypot(params[2] * math.cos(params[4]), params[3] * math.sin(params[4]))
            notes.append((note, (params[0] + across, params[1]), colour))
    places = _apart([place for _, place, _ in notes], 90 * unit, 16 * unit)
    for (note, _, colour), place in zip(notes, places, strict=True):
        draw_text(picture, note, place, 0.4 * unit, colour)
    return picture


def _apart(places: list[tuple[float, float]], wide: float, high: float) -> list[tuple[float, float]]:
    """The places of notes, each moved down until it is as far as that from those before it."""
    found: list[tuple[float, float]] = []
    for x, y in places:
        near = sorted(other for at, other in found if abs(at - x) < wide)
        for other in near:
            y = other + high if abs(other - y) < high else y
        found.append((x, y))
    return found

"""What the page is told: plain objects made of snapshots. No path of the machine is among them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from torchpose.io.rows import POSE_SCHEMA, Row
from torchpose.live.advice import Level, accuracy_level, advise, status_of
from torchpose.live.engine import Accuracy, Point, Sight, Snapshot
from torchpose.live.recording import RecordingState

_CELLS = [name for name, kind in POSE_SCHEMA.items() if kind is not list] + ["quaternion"]
FAULTS = {
    "internal": "The program has a fault; the line is in its terminal.",
    "source": "The source cannot be read; the line is in the terminal.",
    "not_found": "The camera is not found.",
    "not_opened": "The camera cannot be opened; another program may have it.",
    "refused_setting": "The camera refuses a setting of the rig file.",
    "not_ready": "The camera takes no trigger.",
    "time_out": "The camera gives no image in time.",
    "failed_buffer": "The camera's images arrive incomplete.",
    "camera_removed": "The camera has been disconnected.",
    "camera_driver_error": "The camera's driver reports an error.",
    "disk_full": "The disk is full.",
    "not_writable": "The folder cannot be written.",
    "full": "It has as many frames as one recording may have.",
}
"""What the words of faults mean; lines with paths are for the terminal alone."""


def fault_text(word: str | None) -> str | None:
    """What a page says of a fault."""
    return None if word is None else FAULTS.get(word, "It failed; the line is in the terminal.")


def ordered(row: Row) -> Row:
    """The row as it stands in a line of JSON lines."""
    return {column: row[column] for column in POSE_SCHEMA}


def row_of(snapshot: Snapshot, now: float) -> Row | None:
    """The latest row as in JSON lines, its age in s, and what keeps newer ones away; None before the first."""
    sight = snapshot.sight
    if sight is None:
        return None
    return ordered(sight.row) | {"age_s": round(max(0.0, now - sight.shot.taken_s), 3), "fault": snapshot.fault}


def history_of(points: list[Point]) -> bytes:
    """All points of the strips."""
    return json.dumps({"points": points}, allow_nan=False).encode()


def frame_of(snapshot: Snapshot, point: Point | None, recording: RecordingState, wanted_um: float | None) -> Row:
    """Everything that a page shows of a snapshot, but its picture."""
    sight = snapshot.sight
    state: Row = {
        "version": snapshot.version,
        "number": snapshot.number,
        "rate": snapshot.rate,
        "passed_over": snapshot.passed_over,
        "fault": fault_text(snapshot.fault),
        "recording": asdict(recording) | {"fault": fault_text(recording.fault)},
        "seen": None,
    }
    if sight is not None:
        state["seen"] = _seen(sight, snapshot, wanted_um) | {"point": point}
    return state


def _seen(sight: Sight, snapshot: Snapshot, wanted_um: float | None) -> Row:
    level, meaning, hint = status_of(sight.row, sight.picture, sight.missing)
    blurs = {ring.marker: ring.blur for ring in sight.rings}
    lines = advise(sight.rings, sight.picture, sight.tilt_deg, snapshot.sharpest)
    if level == "good" and (wrong := next((line for line in lines if line.level == "bad"), None)):
        level, hint = "fair", f"{wrong.name} {wrong.value} {wrong.unit}: {wrong.text}"
    return {
        "taken_s": sight.shot.taken_s,
        "ready_s": snapshot.ready_s,
        "picture": sight.shot.image is not None,
        "row": {name: sight.row[name] for name in _CELLS},
        "status": {"level": level, "meaning": meaning, "hint": hint},
        "outlines": [outline | {"blur": blurs.get(outline["id"])} for outline in sight.outlines],
        "axes": sight.axes,
        "turn": [asdict(line) for line in lines],
        "rings": [asdict(ring) for ring in sight.rings],
        "whole": None if sight.picture is None else asdict(sight.picture),
        "accuracy": _accuracy(sight.accuracy, wanted_um),
    }


def _accuracy(accuracy: Accuracy | None, wanted_um: float | None) -> dict[str, Any]:
    if accuracy is None:
        return {"wanted_um": wanted_um, "level": "none", "text": "No pose to judge."}
    level = accuracy_level(accuracy.stated_um, wanted_um)
    return asdict(accuracy) | {"wanted_um": wanted_um, "level": level, "text": _verdict(accuracy, wanted_um, level)}


def _verdict(accuracy: Accuracy, wanted_um: float | None, level: Level) -> str:
    """What can be done about it."""
    axis = accuracy.axis.upper()
    if wanted_um is None:
        return f"Worst along {axis}. Give --wanted-um to compare."
    if level == "good":
        return "Better than wanted on every axis."
    if accuracy.reachable_um is not None and accuracy.reachable_um <= wanted_um:
        return f"Focus and light can reach it along {axis}."
    return f"Focus and light alone do not reach it along {axis}: come nearer, or take larger or more rings."

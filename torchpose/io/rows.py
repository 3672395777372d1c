"""Rows of the result tables: plain dictionaries of column to value, None where there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchpose.geometry import rotations
from torchpose.results import Detections, Poses, Reason, Status

Row = dict[str, Any]
Schema = dict[str, type]
"""Column name to str, int or float (a cell) or list (numbers or objects that only JSON lines and Parquet hold)."""

_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_STD = ("sx", "sy", "sz", "srx", "sry", "srz")

POSE_SCHEMA: Schema = {
    "frame": str,
    "target": str,
    "status": str,
    **dict.fromkeys((*_POSE, *_STD, "rms_px"), float),
    "markers": int,
    "reason": str,
    "covariance": list,
    "quaternion": list,
    "solutions": list,
}
"""Columns of a row: t in mm, rotation vector r in rad, standard deviations s* of t and of the rotation about the camera
axes; covariance 6x6 (t, then rotation), quaternion w, x, y, z, and the one or two solutions, the row's own first."""

BASE_SCHEMA: Schema = {
    **dict.fromkeys(tuple(f"base_{c}" for c in (*_POSE, *_STD)), float),
    "base_covariance": list,
}
"""Further columns with a hand-eye calibration: the same pose in the robot base."""

DETECTION_SCHEMA: Schema = {
    "frame": str,
    "target": str,
    "marker": int,
    **dict.fromkeys(
        ("u", "v", "su", "sv", "outer_a", "outer_b", "outer_theta", "inner_a", "inner_b", "inner_theta"), float
    ),
}
"""One row a marker: compensated centre with standard deviation, semi-axes and direction of both ellipses (px, rad)."""


def pose_rows(poses: Poses, frames: Sequence[str], targets: Sequence[str]) -> list[Row]:
    """Rows of `POSE_SCHEMA` in the order of the poses.

    Args:
        poses: N poses. frames: name of each frame of the batch. targets: name of each target.
    """
    poses = poses.cpu()
    own = _solutions(poses.R, poses.t, poses.rms, poses.chi2)
    other = _solutions(poses.R_alt, poses.t_alt, poses.rms_alt, poses.chi2_alt)
    rows = []
    for frame, target, status, reason, markers, pose, cells, first, second in zip(
        poses.frame.tolist(),
        poses.target.tolist(),
        poses.status.tolist(),
        poses.reason.tolist(),
        poses.markers.tolist(),
        own,
        _pose_cells(poses, ""),
        own,
        other,
        strict=True,
    ):
        rows.append(
            {
                "frame": frames[frame],
                "target": targets[target],
                "status": Status(status).name.lower(),
                **cells,
                "rms_px": None if pose is None else pose["rms_px"],
                "markers": markers,
                "reason": Reason(reason).name.lower() if reason else None,
                "quaternion": None if pose is None else pose["quaternion"],
                "solutions": None if first is None else [first, *([second] if second else [])],
            }
        )
    return rows


def base_cells(poses: Poses) -> list[Row]:
    """Cells of `BASE_SCHEMA` for poses that are given in the robot base already (`Poses.seen_from`)."""
    return list(_pose_cells(poses.cpu(), "base_"))


def fault_row(frame: str, target: str, status: Status, reason: str) -> Row:
    """The row of a target in a frame that could not be read or used."""
    row: Row = dict.fromkeys(POSE_SCHEMA)
    return row | {"frame": frame, "target": target, "status": status.name.lower(), "markers": 0, "reason": reason}


def detection_rows(detections: Detections, frames: Sequence[str], targets: Sequence[str]) -> list[Row]:
    """Rows of `DETECTION_SCHEMA`, frame by frame, target by target, in the order of the marker ids."""
    found = detections.cpu()
    std = found.center_cov.diagonal(dim1=-2, dim2=-1).sqrt()
    rows = sorted(
        zip(
            found.frame.tolist(),
            found.target.tolist(),
            found.marker.tolist(),
            found.center.tolist(),
            std.tolist(),
            found.outer[:, 2:].tolist(),
            found.inner[:, 2:].tolist(),
            strict=True,
        )
    )
    columns = list(DETECTION_SCHEMA)[3:]
    return [
        {"frame": frames[frame], "target": targets[target], "marker": marker}
        | dict(zip(columns, map(_finite, (*center, *sigma, *outer, *inner)), strict=True))
        for frame, target, marker, center, sigma, outer, inner in rows
    ]


def _pose_cells(poses: Poses, prefix: str) -> list[Row]:
    """Pose, standard deviations and covariance of each pose as cells."""
    columns = [prefix + c for c in (*_POSE, *_STD)]
    values = zip(poses.t.tolist(), poses.rotation_vector.tolist(), poses.std.tolist(), strict=True)
    return [
        dict(zip(columns, map(_finite, (*t, *r, *s)), strict=True)) | {f"{prefix}covariance": _matrix(covariance)}
        for (t, r, s), covariance in zip(values, poses.covariance.tolist(), strict=True)
    ]


def _solutions(rotation: Tensor, translation: Tensor, rms: Tensor, chi2: Tensor) -> list[Row | None]:
    """Each pose as an object of `solutions`, None where there is none."""
    columns = zip(
        translation.tolist(),
        rotations.log(rotation).tolist(),
        rotations.quaternion(rotation).tolist(),
        rms.tolist(),
        chi2.tolist(),
        strict=True,
    )
    return [
        {"translation": t, "rotation": r, "quaternion": q, "rms_px": _finite(e), "chi2": _finite(c)}
        if all(map(math.isfinite, (*t, *r)))
        else None
        for t, r, q, e, c in columns
    ]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _matrix(values: list[list[float]]) -> list[list[float]] | None:
    return values if all(math.isfinite(v) for row in values for v in row) else None

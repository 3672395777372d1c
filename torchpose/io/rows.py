"""Rows of the result tables: plain dictionaries of column to value, None where there is none."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.results import Detections, Misfit, Poses, Reason, Status

Row = dict[str, Any]
Schema = dict[str, type]
"""Column name to str, int or float (a cell) or list (numbers or objects that only JSON lines and Parquet hold)."""

POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
STD = ("sx", "sy", "sz", "srx", "sry", "srz")
_NOISE = ("nx", "ny", "nz", "nrx", "nry", "nrz")

POSE_SCHEMA: Schema = {
    "frame": str,
    "target": str,
    "status": str,
    **dict.fromkeys((*POSE, *STD, "rms_px"), float),
    "markers": int,
    **dict.fromkeys(_NOISE, float),
    "reason": str,
    "instance": int,
    "copies": int,
    "misfit": str,
    "chi2": float,
    "dof": int,
    "covariance": list,
    "noise_covariance": list,
    "systematic": list,
    "place": list,
    "quaternion": list,
    "solutions": list,
}
"""Columns of a row.

t in mm, rotation vector r in rad, standard deviations s* of t and of the rotation about the camera axes, of everything,
and n* of the noise of the frame alone; instance counts the copies of a target in its frame from the left, copies says
how many it shows, if any; misfit is `Misfit` where the residuals show any, chi2 and dof what they amount to (see
`Poses.residual_chi2`); covariance and noise_covariance 6x6 (t, then rotation), systematic and place as in `Poses`,
quaternion w, x, y, z, and the one or two solutions, the row's own first.
"""

BASE_SCHEMA: Schema = {
    **dict.fromkeys(tuple(f"base_{c}" for c in (*POSE, *STD)), float),
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
    "instance": int,
}
"""One row a marker: compensated centre with standard deviation, semi-axes and direction of both ellipses (px, rad)."""

NEWER: Row = {"instance": 0} | dict.fromkeys(
    ("copies", "misfit", "chi2", "dof", *_NOISE, "noise_covariance", "systematic", "place")
)
"""Cells of rows that were written before a frame could have several copies of a target, or two covariances."""


def pose_rows(poses: Poses, frames: Sequence[str], targets: Sequence[str]) -> list[Row]:
    """Rows of `POSE_SCHEMA` in the order of the poses.

    Args:
        poses: N poses.
        frames: name of each frame of the batch.
        targets: name of each target.
    """
    poses = poses.cpu()
    own = _solutions(poses.R, poses.t, poses.rms, poses.chi2)
    other = _solutions(poses.R_alt, poses.t_alt, poses.rms_alt, poses.chi2_alt)
    rest = table(
        frame=[frames[frame] for frame in poses.frame.tolist()],
        target=[targets[target] for target in poses.target.tolist()],
        status=[Status(status).name.lower() for status in poses.status.tolist()],
        rms_px=[pose and pose["rms_px"] for pose in own],
        markers=poses.markers.tolist(),
        reason=[Reason(reason).name.lower() if reason else None for reason in poses.reason.tolist()],
        instance=poses.instance.tolist(),
        copies=[count or None for count in poses.copies.tolist()],
        misfit=[Misfit(misfit).name.lower() if misfit else None for misfit in poses.misfit.tolist()],
        chi2=[finite(chi2) for chi2 in poses.residual_chi2.tolist()],
        dof=[freedom or None for freedom in poses.freedom.tolist()],
        **_noise_cells(poses),
        quaternion=[pose and pose["quaternion"] for pose in own],
        solutions=[a and [a, *([b] if b else [])] for a, b in zip(own, other, strict=True)],
    )
    return [row | cells for row, cells in zip(rest, _pose_cells(poses, ""), strict=True)]


def base_cells(poses: Poses) -> list[Row]:
    """Cells of `BASE_SCHEMA` for poses that are given in the robot base already (`Poses.seen_from`)."""
    return list(_pose_cells(poses.cpu(), "base_"))


def fault_row(frame: str, target: str, status: Status, reason: str | None) -> Row:
    """The row of a target in a frame that could not be read or used."""
    row: Row = dict.fromkeys(POSE_SCHEMA)
    known = {"frame": frame, "target": target, "status": status.name.lower(), "markers": 0, "reason": reason}
    return row | known | {"instance": 0}


def detection_rows(detections: Detections, frames: Sequence[str], targets: Sequence[str]) -> list[Row]:
    """Rows of `DETECTION_SCHEMA`, by frame, target and instance, in the order of the marker ids."""
    found = detections.cpu()
    std = found.center_cov.diagonal(dim1=-2, dim2=-1).sqrt()
    numbers = torch.cat([found.center, std, found.outer[:, 2:], found.inner[:, 2:]], 1)
    keys = torch.stack([found.frame, found.target, found.instance, found.marker], 1).tolist()
    return [
        dict(
            zip(DETECTION_SCHEMA, (frames[frame], targets[target], marker, *map(finite, cells), instance), strict=True)
        )
        for (frame, target, instance, marker), cells in sorted(zip(keys, numbers.tolist(), strict=True))
    ]


def table(**columns: Sequence[Any]) -> list[Row]:
    """Rows of columns of the same length."""
    return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]


def finite(value: float) -> float | None:
    """The number as a cell."""
    return value if math.isfinite(value) else None


def _pose_cells(poses: Poses, prefix: str) -> list[Row]:
    """Pose, standard deviations and covariance of each pose as cells."""
    numbers = torch.cat([poses.t, poses.rotation_vector, poses.std], 1)
    columns = {f"{prefix}{name}": column for name, column in zip((*POSE, *STD), _columns(numbers), strict=True)}
    whole = poses.covariance.isfinite().flatten(1).all(1).tolist()
    covariance = [c if ok else None for c, ok in zip(poses.covariance.tolist(), whole, strict=True)]
    return table(**columns, **{f"{prefix}covariance": covariance})


def _noise_cells(poses: Poses) -> dict[str, list[Any]]:
    """Columns of the parts of the covariance."""
    there = poses.noise.isfinite().flatten(1).all(1).tolist()
    lists = {"noise_covariance": poses.noise.tolist(), "systematic": poses.systematic.tolist()}
    parts = {name: [v if ok else None for v, ok in zip(values, there, strict=True)] for name, values in lists.items()}
    places = [[None if p[0] != p[0] else p for p in of_row] for of_row in poses.place.tolist()]
    parts["place"] = [p if ok else None for p, ok in zip(places, there, strict=True)]
    return dict(zip(_NOISE, _columns(poses.noise_std), strict=True)) | parts


def _columns(numbers: Tensor) -> list[list[float | None]]:
    return [[finite(value) for value in column] for column in numbers.T.tolist()]


def _solutions(rotation: Tensor, translation: Tensor, rms: Tensor, chi2: Tensor) -> list[Row | None]:
    """Each pose as an object of `solutions`, None where there is none."""
    vector = rotations.log(rotation)
    there = torch.cat([translation, vector], 1).isfinite().all(1).tolist()
    error, distance = _columns(torch.stack([rms, chi2], 1))
    rows = table(
        translation=translation.tolist(),
        rotation=vector.tolist(),
        quaternion=rotations.quaternion(rotation).tolist(),
        rms_px=error,
        chi2=distance,
    )
    return [row if ok else None for row, ok in zip(rows, there, strict=True)]

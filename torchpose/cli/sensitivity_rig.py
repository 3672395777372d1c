"""``torchpose sensitivity --cameras`` and ``--second-camera``: what several cameras tell together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli.common import say
from torchpose.cli.options import MOST_ANGLE
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera import Camera, CameraRig
    from torchpose.io.rows import Row
    from torchpose.studies.study import StudyResult
    from torchpose.target import Target

_STEP = 5.0  # degrees between the cameras (convention)
_NOISE = 2.0  # grey levels (convention): where --noise is not given
_CLEAR = 1.05  # an angle is as good as the best one where its depth error is within 5 % of it (convention)


@dataclass(frozen=True)
class Setting:
    """Working distances (D,), mm, tilt in rad, and conditions of `pose_crlb`."""

    distance: Tensor
    tilt: float
    conditions: dict[str, Any]

    def poses(self) -> tuple[Tensor, Tensor]:
        """On the axis of the first camera."""
        import torch

        from torchpose.geometry import rotations

        t = torch.nn.functional.pad(self.distance[:, None], (2, 0))
        return rotations.exp(t.new_tensor([self.tilt, 0, 0])).expand(len(t), 3, 3), t


def noise_of(noise: float | None) -> float:
    """Of the option, or what stands for it."""
    return _NOISE if noise is None else noise


def predict(rig: CameraRig | None, camera: Camera, target: Target, setting: Setting, out: Path) -> int:
    """Predicts, writes tables and plots, and shows them; returns the exit code."""
    from torchpose.studies.study import StudyResult

    result = StudyResult()
    if rig is not None:
        _together(result, rig, target, setting)
    second = second_camera(camera, target, setting)
    for path in (*result.save(out), *second.save(out)):
        say(str(path))
    return 0


def _cells(covariance: Tensor) -> dict[str, float]:
    """Standard deviations, um and mdeg; NaN where nothing is told."""
    from torchpose.analysis.evaluation import AXES, SCALE, UNITS

    values = (SCALE * covariance.diagonal().sqrt()).tolist()
    return {f"{axis} {unit}": value for axis, unit, value in zip(AXES, UNITS, values, strict=True)}


def _together(result: StudyResult, rig: CameraRig, target: Target, setting: Setting) -> None:
    """Each camera alone, in the axes of the first, and all together, over the distance."""
    import torch

    from torchpose.analysis import rig_crlb
    from torchpose.camera import CameraRig
    from torchpose.report.placing import plot_distances
    from torchpose.studies.study import Picture, Table

    R, t = setting.poses()
    bounds = {"all": rig_crlb(rig, target, R, t, **setting.conditions)}
    for number, name in enumerate(rig.names):
        alone = CameraRig.alone(rig.cameras[number])
        own = rig_crlb(alone, target, *rig.seen_by(number, R, t), **setting.conditions)
        turn = torch.block_diag(rig.R[number], rig.R[number]).mT
        bounds[name] = turn @ own @ turn.mT
    rows: list[Row] = [
        {"distance mm": distance, "cameras": name, **_cells(bound[k])}
        for k, distance in enumerate(setting.distance.tolist())
        for name, bound in bounds.items()
    ]
    if not bool(bounds["all"].isfinite().all((1, 2)).any()):
        raise ConfigError("sensitivity: --distance: the cameras see the target nowhere on the axis of the first one")
    result.tables.append(Table("cameras", "Cameras alone and together", rows))
    figure = plot_distances(setting.distance, bounds)
    result.pictures.append(Picture("cameras", "Cameras alone and together", figure))
    _print("cameras alone and together: standard deviations in the axes of the first", rows, len(bounds))


def second_camera(camera: Camera, target: Target, setting: Setting) -> StudyResult:
    """A second camera like the first, at angles from the first, at the middle distance; shows what it tells."""
    import torch

    from torchpose.analysis import pose_crlb, second_camera_crlb
    from torchpose.report.placing import plot_angles
    from torchpose.studies.study import Picture, StudyResult, Table

    R, t = (values[len(values) // 2] for values in setting.poses())
    degrees = torch.arange(_STEP, MOST_ANGLE + 1, _STEP, dtype=torch.float64)
    alone = pose_crlb(camera, target, R[None], t[None], **setting.conditions)
    if not bool(alone.isfinite().all()):
        raise ConfigError(
            f"sensitivity: --distance: at {float(t[2]):g} mm the first camera does not see the target; give others"
        )
    bound = second_camera_crlb(camera, target, R, t, degrees.deg2rad(), **setting.conditions)
    rows: list[Row] = [{"angle deg": 0.0, "cameras": 1, **_cells(alone[0])}]
    rows += [
        {"angle deg": angle, "cameras": 2, **_cells(own)} for angle, own in zip(degrees.tolist(), bound, strict=True)
    ]
    result, title = StudyResult(), "A second camera at an angle"
    result.tables.append(Table("second_camera", title, rows))
    picture = plot_angles(degrees, bound, alone[0], float(t[2]))
    result.pictures.append(Picture("second_camera", title, picture))
    _print(f"a second camera like the first, target at {float(t[2]):g} mm: standard deviations", rows, 1)
    depth = bound[:, 2, 2].sqrt()
    enough = degrees[depth <= _CLEAR * depth[depth.isfinite()].min()]
    first, best = float(alone[0, 2, 2].sqrt()), float(depth[depth.isfinite()].min())
    say(
        f"depth error {1e3 * first:.3g} um alone, {1e3 * best:.3g} um with a second camera at {float(enough[0]):g} to "
        f"{float(enough[-1]):g} degrees: {first / best:.3g} times less; two at one place would make it "
        f"{math.sqrt(2):.3g} times less"
    )
    return result


def _print(title: str, rows: list[Row], block: int) -> None:
    from torchpose.cli.terminal import print_table

    blocks = len(rows) // block
    shown = range(blocks) if block == 1 else sorted({0, blocks // 2, blocks - 1})
    print_table(title, list(rows[0]), [tuple(row.values()) for k in shown for row in rows[k * block : (k + 1) * block]])

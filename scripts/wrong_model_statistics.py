"""What becomes of rows whose camera, target, motion, optics, sensor or transport is not as the files say.

    python scripts/wrong_model_statistics.py --frames 60 --markdown
    python scripts/wrong_model_statistics.py --case focal-0.1 line-lost --frames 24

Simulated 2-megapixel frames of quad40 as in precision_statistics.py: tilt to 40 degrees, noise 2, files that state no
uncertainty. A line a case: rows `ok`, their RMS error and claimed deviation across and along the axis, the share of
them whose error exceeds 5 of its claimed standard deviations in any of the six coordinates, the median of chi-squared
over its freedom, the commonest misfit, and what the summary of the run says of all frames together. ``evidence``:
`frame` where a single frame can show the fault, `run` where only all frames together can, `none` where the geometry
hides it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
import torch
from precision_statistics import BATCH, F64, TARGET, Case, camera_of, photographed, picture, printed_anew, tilted
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_errors
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import Pose
from torchpose.io.misfits import Misfits
from torchpose.io.rows import pose_rows
from torchpose.sim import PrintErrors, Processing, SensorPattern
from torchpose.sim.disturbances import lines_moved

_MANY = 5.0  # claimed standard deviations: what no row may be off where the frame shows why
Cameras = Callable[[tp.Camera], tp.Camera]
Targets = Callable[[tp.Target], tp.Target]
Pictures = Callable[[Tensor], Tensor]


def _same(what: Any) -> Any:
    return what


@dataclass(frozen=True)
class WrongModel:
    """What differs between the frames and the files.

    Attributes:
        kind: of the fault.
        evidence: who can see it.
        camera: the camera file, from the true camera.
        target: what is on the plate in truth, from the target of the file.
        light: the noise-free picture (B, H, W), changed.
        file: the frames as they arrive, changed.
        case: all else.
    """

    kind: Literal["none", "camera", "target", "motion", "optics", "sensor", "transport"]
    evidence: Literal["frame", "run", "none"] = "frame"
    camera: Cameras = _same
    target: Targets = _same
    light: Pictures = _same
    file: Pictures = _same
    twist: tuple[float, ...] | None = None  # mm and rad during the exposure
    case: Case = field(default_factory=lambda: Case(tilted(40)))


def lens(matrix: Tensor | None = None, distortion: tuple[float, ...] | None = None) -> Cameras:
    """A file whose matrix is off by ``matrix`` (3, 3), and its distortion by that much."""

    def filed(camera: tp.Camera) -> tp.Camera:
        off = camera.matrix if matrix is None else camera.matrix + matrix
        bent = camera.distortion if distortion is None else camera.distortion + torch.tensor(distortion, dtype=F64)
        return replace(camera, matrix=off, distortion=bent)

    return filed


def matrix_off(fx: float = 0.0, fy: float = 0.0, cx: float = 0.0, cy: float = 0.0) -> Cameras:
    return lens(torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 0]], dtype=F64))


def placed(moved: dict[int, tuple[float, float, float]]) -> Targets:
    """Markers beside their places, mm."""

    def printed(target: tp.Target) -> tp.Target:
        centers = target.centers.clone()
        for marker, by in moved.items():
            centers[marker] += torch.tensor(by, dtype=F64)
        return replace(target, centers=centers)

    return printed


def stretched(x: float, y: float) -> Targets:
    """All places by these factors along x and y; rings grow by their mean."""
    by = torch.tensor([x, y, 1.0], dtype=F64)
    return lambda target: replace(target, centers=target.centers * by, radii=target.radii * (x + y) / 2)


def sized(factors: dict[int, tuple[float, float]]) -> Targets:
    """Outer and inner radii of markers by these factors."""

    def printed(target: tp.Target) -> tp.Target:
        radii = target.radii.clone()
        for marker, by in factors.items():
            radii[marker] *= torch.tensor(by, dtype=F64)
        return replace(target, radii=radii)

    return printed


def turned(degrees: float) -> Targets:
    """The whole plate turned about its normal: the ids are then of other places, if it is by a quarter."""
    turn = rotations.exp(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=F64))
    return lambda target: replace(target, centers=target.centers @ turn.T)


def swapped(a: int, b: int) -> Targets:
    """Two markers in each other's places."""

    def printed(target: tp.Target) -> tp.Target:
        centers = target.centers.clone()
        centers[[a, b]] = centers[[b, a]]
        return replace(target, centers=centers)

    return printed


def rows_moved(offset: Callable[[int], np.ndarray]) -> Pictures:
    """Every row displaced along u by its offset in px."""

    def read(light: Tensor) -> Tensor:
        by = torch.from_numpy(offset(light.shape[1])).to(light)
        return lines_moved(light, by.expand(light.shape[:2]))

    return read


def rows_lost(first: int, count: int) -> Pictures:
    """Rows that never came: what follows moves up."""
    return lambda frames: torch.cat([frames[:, :first], frames[:, first + count :], frames[:, -count:]], 1)


def half_size(frames: Tensor) -> Tensor:
    """Binned by 2 and enlarged again by repetition."""
    small = torch.nn.functional.avg_pool2d(frames[:, None].float(), 2)
    return torch.nn.functional.interpolate(small, scale_factor=2, mode="nearest")[:, 0].round().to(frames.dtype)


def shifted_block(frames: Tensor) -> Tensor:
    """From the middle on every row 8 px further right, as after a damaged block."""
    middle = frames.shape[1] // 2
    return torch.cat([frames[:, :middle], frames[:, middle:].roll(8, dims=2)], 1)


def blank_rows(frames: Tensor) -> Tensor:
    """A packet of 40 rows black."""
    out = frames.clone()
    out[:, 500:540] = 0
    return out


def doubled(light: Tensor) -> Tensor:
    """Two exposures of a plate that was knocked by 3 px between them."""
    return 0.5 * light + 0.5 * light.roll((1, 3), dims=(1, 2))


def skewed(light: Tensor) -> Tensor:
    """Sheared by 1 mrad without a turn: pixels that are not square."""
    size = (light.shape[2], light.shape[1])
    by = np.array([[1.0, 5e-4, -5e-4 * size[1] / 2], [5e-4, 1.0, -5e-4 * size[0] / 2]])
    moved = [cv2.warpAffine(f.numpy(), by, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) for f in light]
    return torch.from_numpy(np.stack(moved))


def half_pixel(light: Tensor) -> Tensor:
    """Half a pixel further right and down, as some demosaicing leaves it."""
    rolled = torch.nn.functional.pad(light[:, None], (1, 0, 1, 0), mode="replicate")
    return torch.nn.functional.avg_pool2d(rolled, 2, stride=1)[:, 0]


def _with(**options: Any) -> Case:
    return Case(tilted(40), **options)


MODELS = {
    "as-filed": WrongModel("none"),
    # camera files
    "focal-0.1%": WrongModel("camera", "run", matrix_off(fx=1.111, fy=1.111)),
    "focal-1%": WrongModel("camera", "run", matrix_off(fx=11.11, fy=11.11)),
    "aspect-0.1%": WrongModel("camera", camera=matrix_off(fy=1.111)),
    "aspect-1%": WrongModel("camera", camera=matrix_off(fy=11.11)),
    "principal-3px": WrongModel("camera", "run", matrix_off(cx=3.0, cy=-2.0)),
    "principal-10px": WrongModel("camera", "run", matrix_off(cx=10.0)),
    "k1-0.002": WrongModel("camera", camera=lens(distortion=(0.002, 0.0, 0.0, 0.0))),
    "k1-0.02": WrongModel("camera", camera=lens(distortion=(0.02, 0.0, 0.0, 0.0))),
    "tangential": WrongModel("camera", camera=lens(distortion=(0.0, 0.0, 0.001, 0.0))),
    "no-distortion": WrongModel("camera", camera=lens(distortion=(0.1, 0.0, 0.0, 0.0)), case=_with(k1=-0.1)),
    "shear": WrongModel("camera", light=skewed),
    # target files
    "places-10um": WrongModel("target", case=_with(errors=PrintErrors(center_sigma=0.010))),
    "places-50um": WrongModel("target", case=_with(errors=PrintErrors(center_sigma=0.050))),
    "one-marker-50um": WrongModel("target", target=placed({2: (0.03, -0.04, 0.0)})),
    "one-marker-1mm": WrongModel("target", target=placed({2: (0.6, -0.8, 0.0)})),
    "twist-100um": WrongModel("target", case=_with(errors=PrintErrors(warp=0.1))),
    "stretch-0.1%": WrongModel("target", target=stretched(0.9995, 1.0005)),
    "scale-0.2%": WrongModel("target", "none", target=stretched(1.002, 1.002)),
    "gain-30um": WrongModel("target", case=_with(errors=PrintErrors(gain=0.030))),
    "sizes-2%": WrongModel("target", target=sized(dict.fromkeys(range(4), (1.02, 1.02)))),
    "one-size-5%": WrongModel("target", target=sized({1: (1.05, 1.05)})),
    "outer-2%": WrongModel("target", target=sized(dict.fromkeys(range(4), (1.02, 1.0)))),
    "ids-turned": WrongModel("target", "none", target=turned(90.0)),
    "ids-swapped": WrongModel("target", target=swapped(0, 1)),
    # the part moves
    "rolling-2px": WrongModel("motion", "none", light=rows_moved(lambda rows: np.linspace(-1, 1, rows))),
    "vibration": WrongModel("motion", light=rows_moved(lambda rows: np.sin(np.arange(rows) / 40.0))),
    "moving": WrongModel("motion", twist=(0.6, 0.3, 0.0, 0.0, 0.0, 0.0)),
    "turning": WrongModel("motion", twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.03)),
    "knocked": WrongModel("motion", "none", light=doubled),
    # optics
    "coma": WrongModel("optics", "none", case=_with(disturbances={"coma_px": 2.0, "coma_deg": 30.0})),
    "haze": WrongModel("optics", case=_with(disturbances={"haze_px": 0.1})),
    "ghost": WrongModel("optics", case=_with(disturbances={"ghost": 15.0})),
    "speckle": WrongModel("optics", case=_with(disturbances={"speckle": 0.05})),
    # sensors
    "gamma-as-linear": WrongModel("sensor", case=_with(gamma=2.2)),
    "line-jitter": WrongModel("sensor", case=_with(pattern=SensorPattern(line_jitter=0.1))),
    "columns": WrongModel("sensor", case=_with(pattern=SensorPattern(column_noise=2.0))),
    "flicker": WrongModel("sensor", case=_with(disturbances={"flicker": 0.05})),
    "sharpened": WrongModel("sensor", case=_with(processing=Processing(sharpen=1.0))),
    "half-pixel": WrongModel("sensor", "none", light=half_pixel),
    # transport
    "line-lost": WrongModel("transport", file=rows_lost(600, 1)),
    "lines-lost-16": WrongModel("transport", file=rows_lost(600, 16)),
    "odd-lines-1px": WrongModel("transport", light=rows_moved(lambda rows: np.arange(rows) % 2 - 0.5)),
    "shifted-3px": WrongModel("transport", "run", file=lambda frames: frames.roll(3, dims=2)),
    "block-shifted": WrongModel("transport", file=shifted_block),
    "packet-lost": WrongModel("transport", file=blank_rows),
    "mirrored": WrongModel("transport", file=lambda frames: frames.flip(2)),
    "binned": WrongModel("transport", file=half_size),
}


def run(model: WrongModel, frames: int, seed: int, method: Any = "photometric") -> dict[str, Any]:
    """The line of a case."""
    g = torch.Generator().manual_seed(seed)
    case, camera = model.case, camera_of(model.case.k1)
    r, t = case.poses(frames, g)
    prints = printed_anew(case, 1, g)  # one print, as a user has one
    drawn = model.target(TARGET) if prints is None else prints.repeated(frames)
    estimator = tp.PoseEstimator(model.camera(camera), TARGET, method=method)
    misfits, errors, claimed, spread, rows = Misfits(), [], [], [], []
    for a in range(0, frames, BATCH):
        s = slice(a, min(a + BATCH, frames))
        what = drawn if isinstance(drawn, tp.Target) else drawn[s]
        clean = model.light(picture(case, camera, what, r[s], t[s], twist=model.twist))
        noisy = model.file(photographed(case, clean, seed, torch.arange(a, s.stop)))
        poses = estimator(noisy)
        e = pose_errors(poses, Pose(r[s], t[s]))
        errors.append(torch.cat([e.translation, e.rotation], -1))
        claimed.append(poses.std)
        spread.append(poses.residual_chi2 / poses.freedom)
        rows += pose_rows(poses, [str(k) for k in range(a, s.stop)], [TARGET.name])
        for row in rows[a:]:
            misfits.add(row)
    error, sigma, over = torch.cat(errors), torch.cat(claimed), torch.cat(spread)
    ok = torch.tensor([row["status"] == "ok" for row in rows])
    beyond = ((error / sigma).abs().amax(-1) > _MANY)[ok]
    seen = Counter(row["misfit"] or row["reason"] or row["status"] for row in rows)

    def rms(x: Tensor) -> float:
        return 1e3 * math.sqrt(x[ok].square().sum(-1).mean()) if bool(ok.any()) else math.nan

    return {
        "ok": int(ok.sum()),
        "lateral_um": rms(error[:, :2]),
        "depth_um": rms(error[:, 2:3]),
        "claimed_lateral_um": rms(sigma[:, :2]),
        "claimed_depth_um": rms(sigma[:, 2:3]),
        "beyond": float(beyond.double().mean()) if bool(ok.any()) else 0.0,
        "chi2": float(over[ok].median()) if bool(ok.any()) else math.nan,
        "rows_say": ", ".join(f"{what} {count}" for what, count in seen.most_common(3)),
        "summary": misfits.lines(TARGET.name, TARGET.ids.tolist()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=list(MODELS), choices=MODELS, metavar="CASE")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--method", default="photometric")
    parser.add_argument("--markdown", action="store_true", help="a table")
    options = parser.parse_args()
    if options.markdown:
        print("| case | evidence | ok | lateral / depth, um | claimed | beyond 5 s* | chi2 / dof | rows say |")
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.case:
        model = MODELS[name]
        line = run(model, options.frames, options.seed, options.method)
        print(
            f"| {name} | {model.evidence} | {line['ok']} | {line['lateral_um']:.3g} / {line['depth_um']:.3g} | "
            f"{line['claimed_lateral_um']:.3g} / {line['claimed_depth_um']:.3g} | {100 * line['beyond']:.0f} % | "
            f"{line['chi2']:.2g} | {line['rows_say']} |",
            flush=True,
        )
        for said in line["summary"]:
            print(said, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()

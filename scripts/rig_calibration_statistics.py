"""Rigs calibrated against known truth: errors of the cameras' places, and whether their covariance is right.

    python scripts/rig_calibration_statistics.py --sets 100 --markdown

Every set: cameras on an arc around the target, 170 mm away, each with a lens of its own (k1 k2 p1 p2), all of them
unknown; a plate of 5 x 4 points 12 mm apart, 0.05 px of noise on every point. A camera sees the plate where it is
turned away from it by less than 50 degrees and all of it is in the frame; so of three and six cameras those at the ends
never see it at one moment. Columns: RMS error of all places over what is claimed (translation, rotation), mean NEES of
the places over its freedom with the deviation of that mean, and the same errors over the same claims of two others on
the same pixels: a chain of cv2.stereoCalibrate, pair by pair along the arc, and cv2.calibrateMultiview (OpenCV 5), both
begun with the intrinsics that cv2.calibrateCamera gives from all views of each.

    python scripts/rig_calibration_statistics.py --rendered --cameras 3 --sets 10 --moments 40

Frames of the built-in target quad40 instead (blur 0.7 px, noise 2, 8 bit) and all of `torchpose calibrate` but the
files; nothing of OpenCV's.

    python scripts/rig_calibration_statistics.py --robot tool --cameras 2 3 --sets 60 --markdown

No camera sees the plate at a moment of another one: moments are shared out in turns, and the poses of a robot tie the
cameras together, whose noise is 0.05 mm and 0.1 mrad along and about every axis (`--robot base`: the cameras stand
still, and the plate is on the tool). `robot mm` and `robot rad`: the noise found over the true one. `--known`: lenses
are known. Nothing of OpenCV's here either.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

import torchpose as tp
from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.hand_eye import Mount
from torchpose.calibration.rig_session import OneCamera, RobotPoses, calibrate_cameras
from torchpose.calibration.several import Located, RigCalibration, calibrate_rig
from torchpose.camera import LINEAR
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
RIGS = {2: 40.0, 3: 60.0, 6: 30.0}  # cameras, and degrees between neighbours
AWAY, SIGMA, TURNED = 170.0, 0.05, 50.0  # mm, px, degrees
BORDER = 10.0  # px
LENS = "brown4"
NOISE = 2.0  # grey levels, of rendered frames
ROBOT = (0.05, 1e-4)  # mm, rad
LEAST = 4  # moments of a pair for cv2.stereoCalibrate
METRE = 1000.0  # mm
STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


class Drawn(NamedTuple):
    """A rig, the points of the plate (M, 3), and poses of N moments in the first camera."""

    rig: tp.CameraRig
    points: Tensor
    R: Tensor
    t: Tensor


def plate() -> Tensor:
    x, y = torch.meshgrid(torch.arange(5, dtype=F64) - 2, torch.arange(4, dtype=F64) - 1.5, indexing="xy")
    return torch.nn.functional.pad(12.0 * torch.stack([x.flatten(), y.flatten()], -1), (0, 1))


def drawn(cameras: int, moments: int, seed: int) -> Drawn:
    """A rig on an arc, and poses around its middle that face it anywhere."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, dtype=F64, generator=g) - 1

    angle = RIGS[cameras] * (torch.arange(cameras, dtype=F64) - (cameras - 1) / 2)
    # cameras look along +z at the middle, from -z; turned about y, and a little about all axes
    around = rotations.exp(_about_y(angle.deg2rad())) @ rotations.exp(0.1 * uniform(cameras, 3))
    origin = torch.tensor([0.0, 0.0, AWAY], dtype=F64) + 5 * uniform(cameras, 3)  # of the middle, in each camera
    turn, shift = around.mT, origin  # X_n = turn X_world + shift
    rig_R, rig_t = rotations.compose(turn, shift, *rotations.inverse(turn[0], shift[0]))
    rig_R[0], rig_t[0] = torch.eye(3, dtype=F64), 0
    lens = torch.tensor([-0.08, 0.03, 2e-4, -1.5e-4], dtype=F64) * (1 + 0.3 * uniform(cameras, 4))
    focal, middle = 1100 + 100 * uniform(cameras), 10 * uniform(cameras, 2)
    made = [
        tp.Camera(912, 608, [[f, 0, 455.5 + c[0]], [0, 1.001 * f, 303.5 + c[1]], [0, 0, 1]], d)
        for f, c, d in zip(focal.tolist(), middle.tolist(), lens, strict=True)
    ]
    reach = math.radians(float(angle[-1]) + 25)
    face = rotations.exp(_about_y(reach * uniform(moments))) @ rotations.exp(0.45 * uniform(moments, 3))
    R, t = rotations.compose(turn[0], shift[0], face, 15 * uniform(moments, 3))
    return Drawn(tp.CameraRig(made, rig_R, rig_t), plate(), R, t)


def _about_y(angle: Tensor) -> Tensor:
    return torch.stack([torch.zeros_like(angle), angle, torch.zeros_like(angle)], -1)


def views_of(scene: Drawn, number: int, seed: int, sigma: float = SIGMA) -> Views:
    """What a camera sees, with noise."""
    camera = scene.rig.cameras[number]
    R, t = scene.rig.seen_by(number, scene.R, scene.t)
    pixels = camera.project(scene.points @ R.mT + t[:, None])
    size = torch.tensor([camera.width, camera.height], dtype=F64)
    inside = ((pixels > BORDER) & (pixels < size - BORDER)).all(-1).all(-1)
    facing = (R[:, :, 2] * t).sum(-1) / t.norm(dim=-1)  # the plate's z is away from who sees it
    seen = (inside & (facing > math.cos(math.radians(TURNED)))).nonzero()[:, 0]
    n, m = len(seen), len(scene.points)
    g = torch.Generator().manual_seed(1000 * seed + number)
    noisy = pixels[seen].flatten(0, 1) + sigma * torch.randn(n * m, 2, dtype=F64, generator=g)
    return Views(
        torch.arange(n).repeat_interleave(m),
        torch.arange(m).repeat(n),
        scene.points.repeat(n, 1),
        noisy,
        SIGMA**2 * torch.eye(2, dtype=F64).expand(n * m, 2, 2),
        tuple(f"{k}.png" for k in seen.tolist()),
    )


def shared_out(views: list[Views]) -> list[Views]:
    """Of each camera its own moments only, in turns."""
    count = len(views)
    return [
        own.of_views(torch.tensor([int(name.removesuffix(".png")) % count == k for name in own.names]))
        for k, own in enumerate(views)
    ]


def robot_poses(scene: Drawn, mount: Mount, seed: int, noise: tuple[float, float] = ROBOT) -> RobotPoses:
    """base_from_tool at every moment, with noise: of cameras on the tool and a plate in the cell, or the reverse."""
    X = rotations.exp(torch.tensor([0.02, -0.03, 1.5], dtype=F64)), torch.tensor([10.0, -60, 40], dtype=F64)
    Z = rotations.exp(torch.tensor([math.pi - 0.1, 0.05, 0.02], dtype=F64)), torch.tensor([450.0, -100, 20], dtype=F64)
    R, t = rotations.compose(*rotations.compose(*Z, *rotations.inverse(scene.R, scene.t)), *rotations.inverse(*X))
    if mount == "base":
        R, t = rotations.inverse(R, t)
    g = torch.Generator().manual_seed(2000 * seed + 1)
    off = torch.tensor(noise, dtype=F64).repeat_interleave(3) * torch.randn(len(t), 6, dtype=F64, generator=g)
    said = torch.cat([t + off[:, :3], rotations.log(rotations.exp(off[:, 3:]) @ R)], -1)
    return {f"{k}.png": tuple(pose) for k, pose in enumerate(said.tolist())}


def located(scene: Drawn, views: list[Views]) -> list[Located]:
    """Every camera calibrated by itself."""
    found = []
    for number, own in enumerate(views):
        alone = calibrate_intrinsics(own, [scene.rig.cameras[number]], lens=LENS)
        found.append(Located(f"cam{number}", alone.camera, alone.views, alone.bundle.R, alone.bundle.t))
    return found


def errors(rig: tp.CameraRig, true: tp.CameraRig) -> Tensor:
    """Of the places (C - 1, 6): true less found, as `CameraRig.covariance` counts them."""
    return torch.cat([true.t - rig.t, rotations.log(true.R @ rig.R.mT)], -1)[1:]


class Seen(NamedTuple):
    """What OpenCV's functions take: points of the plate, pixels of each camera by moment, matrix and distortion."""

    points: np.ndarray
    pixels: list[dict[str, np.ndarray]]
    lenses: list[Any]
    size: tuple[int, int]


def seen_by_opencv(scene: Drawn, views: list[Views]) -> Seen:
    """With the lens of each camera by itself."""
    points = scene.points.numpy().astype(np.float32)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    size = (scene.rig.cameras[0].width, scene.rig.cameras[0].height)
    seen = [
        dict(zip(v.names, v.pixels.unflatten(0, (len(v), -1)).numpy().astype(np.float32), strict=True)) for v in views
    ]
    lenses = []
    for camera, own in zip(scene.rig.cameras, seen, strict=True):
        start = camera.matrix.numpy().copy(), np.zeros(5)
        lenses.append(cv2.calibrateCamera([points] * len(own), [*own.values()], size, *start, flags=flags)[1:3])
    return Seen(points, seen, lenses, size)


def by_chain(scene: Drawn, given: Seen) -> tp.CameraRig | None:
    """Pair by pair along the arc; None where a pair has too few moments in common."""
    R, t = [torch.eye(3, dtype=F64)], [torch.zeros(3, dtype=F64)]
    for k in range(len(given.pixels) - 1):
        both = [name for name in given.pixels[k] if name in given.pixels[k + 1]]
        if len(both) < LEAST:
            return None
        one, two = ([given.pixels[j][name] for name in both] for j in (k, k + 1))
        calibrate: Any = cv2.stereoCalibrate  # whose stub knows no lists of pictures' points
        _, *_, turn, shift, _, _ = calibrate(
            [given.points] * len(both),
            one,
            two,
            *given.lenses[k],
            *given.lenses[k + 1],
            given.size,
            flags=cv2.CALIB_FIX_INTRINSIC,
            criteria=STOP,
        )
        step = rotations.compose(torch.from_numpy(turn), torch.from_numpy(shift)[:, 0], R[-1], t[-1])
        R.append(step[0])
        t.append(step[1])
    return tp.CameraRig(scene.rig.cameras, torch.stack(R), torch.stack(t))


def by_multiview(scene: Drawn, given: Seen) -> tp.CameraRig | None:
    """All at once, in metres, since it takes points for collinear whose distances are large numbers; None where OpenCV
    has no such function, or fails."""
    if not hasattr(cv2, "calibrateMultiview"):
        return None
    names = sorted({name for own in given.pixels for name in own})
    nothing, count = np.full((len(given.points), 2), -1, np.float32), len(given.pixels)
    try:
        calibrate: Any = cv2.calibrateMultiview  # as above
        _, _, _, turns, shifts = calibrate(
            [given.points / METRE] * len(names),
            [[own.get(name, nothing) for name in names] for own in given.pixels],
            [given.size] * count,
            np.array([[name in own for name in names] for own in given.pixels], np.uint8),
            np.full(count, cv2.CALIB_MODEL_PINHOLE, np.uint8),
            [matrix.copy() for matrix, _ in given.lenses],
            [distortion.copy() for _, distortion in given.lenses],
            None,
            None,
            np.full(count, cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS, np.int32),
            cv2.CALIB_USE_INTRINSIC_GUESS,
            STOP,
        )
    except cv2.error:
        return None
    R = [torch.from_numpy(cv2.Rodrigues(np.asarray(turn, float))[0]) for turn in turns[1:]]
    R = [torch.eye(3, dtype=F64), *R]
    t = METRE * torch.stack([torch.from_numpy(np.asarray(shift, float)).flatten() for shift in shifts])
    t[0] = 0
    return tp.CameraRig(scene.rig.cameras, torch.stack(R), t)


class Row(NamedTuple):
    found: RigCalibration
    off: Tensor  # (6 (C - 1),)
    nees: float
    theirs: tuple[Tensor | None, ...] = (None, None)  # of the chain, and of all at once


def drawn_set(cameras: int, moments: int, seed: int, *, compare: bool = True) -> Row:
    scene = drawn(cameras, moments, seed)
    views = [views_of(scene, number, seed) for number in range(cameras)]
    found = calibrate_rig(located(scene, views), lens=LENS)
    off = errors(found.rig, scene.rig).flatten()
    assert found.rig.covariance is not None
    nees = float(off @ torch.linalg.solve(found.rig.covariance, off))
    if not compare:
        return Row(found, off, nees)
    given = seen_by_opencv(scene, views)
    theirs = (by_chain(scene, given), by_multiview(scene, given))
    return Row(found, off, nees, tuple(None if rig is None else errors(rig, scene.rig).flatten() for rig in theirs))


def with_lenses(scene: Drawn, views: list[Views]) -> list[Located]:
    """Every camera as it is."""
    found = []
    for number, own in enumerate(views):
        at = [int(name.removesuffix(".png")) for name in own.names]
        seen = scene.rig.seen_by(number, scene.R[at], scene.t[at])
        found.append(Located(f"cam{number}", scene.rig.cameras[number], own, *seen))
    return found


def tied_set(cameras: int, moments: int, seed: int, *, mount: Mount, known: bool) -> Row:
    scene = drawn(cameras, moments, seed)
    views = shared_out([views_of(scene, number, seed) for number in range(cameras)])
    made, lens = (with_lenses, None) if known else (located, LENS)
    return row_of_set(calibrate_rig(made(scene, views), lens=lens, robot=robot_poses(scene, mount, seed)), scene)


def row_of_set(found: RigCalibration, scene: Drawn) -> Row:
    off = errors(found.rig, scene.rig).flatten()
    assert found.rig.covariance is not None
    return Row(found, off, float(off @ torch.linalg.solve(found.rig.covariance, off)))


def rendered_set(cameras: int, moments: int, seed: int) -> Row:
    """From grey values on; the lenses are looked for from the true ones."""
    scene, target = drawn(cameras, moments, seed), tp.Target.load("quad40")
    several = []
    for number, camera in enumerate(scene.rig.cameras):
        R, t = scene.rig.seen_by(number, scene.R, scene.t)
        facing = ((R[:, :, 2] * t).sum(-1) / t.norm(dim=-1) > math.cos(math.radians(TURNED))).nonzero()[:, 0]
        clean = render(camera, target, R[facing], t[facing], psf_sigma=0.7)
        frames = add_noise(clean, NOISE, seed=1000 * seed + number)
        names = [f"{k}.png" for k in facing.tolist()]
        several.append(OneCamera(f"cam{number}", partial(list, [(names, frames)]), camera, guess=False))
    return row_of_set(calibrate_cameras(several, target, lens=LENS, tone=LINEAR), scene)


def row_of(
    cameras: int, moments: int, sets: int, *, rendered: bool = False, mount: Mount | None = None, known: bool = False
) -> dict[str, Any]:
    made = rendered_set if rendered else drawn_set if mount is None else partial(tied_set, mount=mount, known=known)
    rows = [made(cameras, moments, seed) for seed in range(sets)]
    freedom = 6 * (cameras - 1)
    whitened = []
    for row in rows:
        assert row.found.rig.covariance is not None
        sigma = row.found.rig.covariance.diagonal().sqrt()
        theirs = [torch.full_like(row.off, torch.nan) if off is None else off for off in row.theirs]
        whitened.append(torch.stack([row.off / sigma, *(off / sigma for off in theirs), sigma]).unflatten(1, (-1, 6)))
    mine, chain, multiview, claimed = torch.stack(whitened, 1)  # (S, C - 1, 6) each
    apart = int((rows[0].found.common == 0).sum()) // 2
    nees = torch.tensor([row.nees for row in rows]) / freedom

    def rms(values: Tensor) -> float:
        return float(values.square().nanmean().sqrt())

    fits = [fit for row in rows if (fit := row.found.hand_eye) is not None]
    noise = [[fit.robot_sigma_mm / ROBOT[0], fit.robot_sigma_rad / ROBOT[1]] for fit in fits] or [[math.nan] * 2]
    mm, rad = torch.tensor(noise).mean(0).tolist()
    return {
        "cameras": cameras,
        "pairs apart": apart,
        "sets": sets,
        "claimed um": 1e3 * rms(claimed[..., :3]),
        "claimed mdeg": 1e3 * math.degrees(rms(claimed[..., 3:])),
        "translation / claimed": rms(mine[..., :3]),
        "rotation / claimed": rms(mine[..., 3:]),
        "NEES / freedom": float(nees.mean()),
        "deviation of it": math.sqrt(2 / freedom / sets),
        "chain translation / claimed": rms(chain[..., :3]),
        "chain rotation / claimed": rms(chain[..., 3:]),
        "multiview translation / claimed": rms(multiview[..., :3]),
        "multiview rotation / claimed": rms(multiview[..., 3:]),
        "robot mm": mm,
        "robot rad": rad,
    }


def print_rows(rows: Sequence[Mapping[str, float]], *, markdown: bool) -> None:
    """Prints rows of one set of columns, as a table for the documentation or one a line; without columns of nothing."""
    rows = [{k: v for k, v in row.items() if any(not math.isnan(one[k]) for one in rows)} for row in rows]
    if markdown:
        print("| " + " | ".join(rows[0]) + " |\n|" + " ---: |" * len(rows[0]))
        print("\n".join("| " + " | ".join(f"{value:.3g}" for value in row.values()) + " |" for row in rows))
    else:
        for row in rows:
            print("  ".join(f"{name} {value:.3g}" for name, value in row.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, nargs="+", default=[*RIGS], choices=[*RIGS])
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument("--moments", type=int, default=60)
    parser.add_argument("--rendered", action="store_true", help="from rendered frames")
    parser.add_argument(
        "--robot", choices=["base", "tool"], help="cameras apart, tied by a robot, and what they are on"
    )
    parser.add_argument("--known", action="store_true", help="with --robot: lenses are known")
    parser.add_argument("--markdown", action="store_true", help="a table for the documentation")
    options = parser.parse_args()
    torch.set_num_threads(1)
    how = {"rendered": options.rendered, "mount": options.robot, "known": options.known}
    rows = [row_of(n, options.moments, options.sets, **how) for n in options.cameras]
    print_rows(rows, markdown=options.markdown)


if __name__ == "__main__":
    main()

"""Data sets on disk: frames of a plan with their truth, streamed, resumable, in any batch size the same.

A data set is a folder:

    frames/0000.png ...      8 or 16 bit grey, lossless
    camera.yaml target.yaml  the models of the frames
    truth.csv                one row a frame, see `torchpose.io.truth`
    plan.json                what the frames were made from
    bop/                     the same in the layout of the BOP challenge, where asked for
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.analysis.crlb import pose_crlb
from torchpose.camera import Camera
from torchpose.config import write_text
from torchpose.datasets.plan import Plan, in_depth_range
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.truth import Truth, write_truth
from torchpose.sim import faults_of, with_faults
from torchpose.sim.clutter import random_clutter, random_covers
from torchpose.sim.renderer import Defocus, render
from torchpose.sim.sensor import Lighting, add_noise

Backend = Literal["analytic", "blender"]
Renderer = Callable[[Tensor], Tensor]
"""Noise-free frames (B, H, W) float32 of the frames numbered (B,)."""

BOUND = ("sx", "sy", "sz", "srx", "sry", "srz")
_BATCH_PIXELS = 7_000_000  # larger buffers go back to the system and are cleared anew each time


def plan_truth(plan: Plan) -> Truth:
    """The truth of a plan, without its bounds.

    Columns besides the pose: tilt_deg, psf_sigma, noise_sigma (read noise), dark, light, motion_mm, motion_deg;
    markers_in_view, markers that lie in the frame as a whole; in_depth_range, 0 where the plan's range is left.
    """
    c = plan.conditions
    return Truth(
        frame=plan.names,
        target=[plan.target.name] * len(plan),
        t=plan.t,
        rotation_vector=rotations.log(plan.R),
        extra={
            "tilt_deg": plan.R[:, 2, 2].clamp(-1, 1).acos().rad2deg(),
            "psf_sigma": c["psf_sigma"],
            "noise_sigma": c["noise"],
            "dark": c["dark"],
            "light": c["light"],
            "motion_mm": plan.motion[:, :3].norm(dim=1),
            "motion_deg": plan.motion[:, 3:].norm(dim=1).rad2deg(),
            "markers_in_view": plan.seen.double(),
            "in_depth_range": in_depth_range(plan).double(),
        },
    )


def bounds(plan: Plan, which: Tensor) -> Tensor:
    """(B, 6) Cramer-Rao standard deviations of the frames numbered ``which``; NaN where no pose is determined.

    Of the evenly lit, sharp frame with the noise of its dark parts, see `torchpose.analysis.pose_crlb`: a bound still,
    but one that defocus, motion, shot noise, clutter and covers keep any estimator away from.
    """
    c = {name: column[which] for name, column in plan.conditions.items()}
    sensor = plan.file.sensor
    variance = c["noise"].square() + (0.0 if sensor.full_well is None else 255.0 / sensor.full_well * c["dark"])
    covariance = pose_crlb(
        plan.camera,
        plan.target,
        plan.R[which],
        plan.t[which],
        psf_sigma=c["psf_sigma"],
        dark=c["dark"],
        light=c["light"],
        noise_sigma=variance.sqrt(),
        bits=sensor.bits,
    )
    return covariance.diagonal(dim1=1, dim2=2).sqrt()


def analytic(plan: Plan) -> Renderer:
    """`torchpose.sim.render` under the conditions of a plan."""
    image = plan.file.imaging
    lens = None if image.defocus is None else Defocus(**image.defocus.model_dump())
    light = image.lighting
    lighting = None
    if light is not None:
        lighting = Lighting(
            gradient=(light.gradient[0], light.gradient[1]),
            point=None if light.point is None else (light.point[0], light.point[1], light.point[2]),
            vignetting=light.vignetting,
        )
    plate = None if image.plate is None else (image.plate[0], image.plate[1])

    @torch.inference_mode()
    def frames(which: Tensor) -> Tensor:
        numbers = which.tolist()
        c = {name: column[which] for name, column in plan.conditions.items()}
        moving = bool(plan.motion[which].any())
        seed = plan.file.seed
        return render(
            plan.camera,
            plan.target,
            plan.R[which],
            plan.t[which],
            psf_sigma=c["psf_sigma"],
            dark=c["dark"],
            light=c["light"],
            plate=plate,
            surround=_pictures(plan, numbers) if plan.backgrounds else c["surround"],
            defocus=lens,
            motion=plan.motion[which] if moving else None,
            lighting=lighting,
            clutter=random_clutter(plan.target, image.clutter, seed, numbers) if image.clutter else None,
            covers=random_covers(plan.target, image.covered, seed, numbers) if image.covered else None,
        )

    return frames


def simulated_frames(plan: Plan, renderer: Renderer, which: Tensor) -> Tensor:
    """(B, H, W) uint8 or uint16, frames of the numbers ``which`` (B,) as the plan's sensor delivers them."""
    sensor, clean = plan.file.sensor, renderer(which)
    if plan.file.faults:
        clean = with_faults(clean, faults_of(plan.file.faults), plan.file.seed, index=which)
    return add_noise(
        clean,
        plan.conditions["noise"][which],
        plan.file.seed,
        index=which,
        bits=sensor.bits,
        full_well=sensor.full_well,
        gamma=sensor.gamma,
    )


def write_dataset(
    plan: Plan,
    out: Path,
    *,
    backend: Backend = "analytic",
    resume: bool = False,
    bop: bool = False,
    batch: int | None = None,
    threads: int = 1,
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Writes a data set; memory does not grow with the number of frames.

    Args:
        plan: what to render. out: folder, made where it is missing. backend: who renders.
        resume: keep the frames of an earlier run of the same plan.
        bop: export the BOP layout besides. batch: frames at a time. threads: of encoding.
        progress: called with the number of frames just finished.

    Returns:
        Number of frames rendered now.

    Raises:
        ConfigError: the folder holds another data set, or holds one and ``resume`` is false, or cannot be written.
    """
    origin = _origin(plan, backend)
    folder = out / "frames"
    _check_folder(out, origin, resume)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: --out: cannot be made ({error.strerror}); choose another folder") from None
    write_text(out / "plan.json", json.dumps(origin, indent=2) + "\n")
    plan.camera.save(out / "camera.yaml")
    # without a part: the truth is the pose of the target itself
    replace(plan.target, part_rotation=None, part_translation=None).save(out / "target.yaml")
    names = plan.names
    done = {path.name for path in folder.iterdir()}
    pending = torch.tensor([i for i, name in enumerate(names) if name not in done], dtype=torch.int64)
    progress(len(names) - len(pending))
    if backend == "blender":
        from torchpose.datasets.blender import blender

        renderer, size = blender(plan), 1
    else:
        renderer = analytic(plan)
        size = max(1, min(16, _BATCH_PIXELS // (plan.camera.width * plan.camera.height)))
    with ThreadPoolExecutor(threads, thread_name_prefix="encode") as pool:
        ahead: list[Future[None]] = []
        for which in pending.split(batch or size) if len(pending) else ():
            frames = simulated_frames(plan, renderer, which)
            for task in ahead:
                task.result()
            progress(len(ahead))
            ahead = [
                pool.submit(_write_png, folder / names[i], frame.numpy())
                for i, frame in zip(which.tolist(), frames, strict=True)
            ]
        for task in ahead:
            task.result()
        progress(len(ahead))
    truth = plan_truth(plan)
    if plan.file.bounds:
        std = torch.cat([bounds(plan, which) for which in torch.arange(len(plan)).split(64)])
        truth.extra.update(zip(BOUND, std.unbind(1), strict=True))
    write_truth(out / "truth.csv", truth)
    if bop:
        write_bop(plan.camera, plan.target.name, truth, out)
    return len(pending)


def write_bop(camera: Camera, target: str, truth: Truth, out: Path) -> None:
    """The layout of the BOP challenge in ``out/bop``: camera.json, targets.json and the scene 000000.

    Rotations row by row, translations in mm, OpenCV's camera axes; ``obj_id`` 1 is the target. The frames are hard
    links to those of the data set. BOP has no lens distortion: a camera that has one is written as it is, with the
    coefficients in the key ``distortion`` of camera.json besides.
    """
    scene = out / "bop" / "000000"
    (scene / "gray").mkdir(parents=True, exist_ok=True)
    matrix = camera.matrix.flatten().tolist()
    numbers = {"cx": matrix[2], "cy": matrix[5], "fx": matrix[0], "fy": matrix[4], "depth_scale": 1.0}
    about = numbers | {"width": camera.width, "height": camera.height, "distortion": camera.distortion.tolist()}
    write_text(out / "bop" / "camera.json", json.dumps(about, indent=2) + "\n")
    write_text(out / "bop" / "targets.json", json.dumps({"1": target}) + "\n")
    poses = zip(truth.R.flatten(1).tolist(), truth.t.tolist(), strict=True)
    gt = {str(i): [{"cam_R_m2c": R, "cam_t_m2c": t, "obj_id": 1}] for i, (R, t) in enumerate(poses)}
    write_text(scene / "scene_gt.json", json.dumps(gt, indent=1) + "\n")
    write_text(
        scene / "scene_camera.json",
        json.dumps({str(i): {"cam_K": matrix, "depth_scale": 1.0} for i in range(len(truth))}, indent=1) + "\n",
    )
    for i, name in enumerate(truth.frame):
        link = scene / "gray" / f"{i:06d}.png"
        link.unlink(missing_ok=True)
        os.link(out / "frames" / name, link)


def _write_png(path: Path, frame: np.ndarray) -> None:
    """Writes a frame that is there as a whole or not at all."""
    written, data = cv2.imencode(".png", frame)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        if not written:
            raise OSError(0, "encoding failed")
        temporary.write_bytes(data.tobytes())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ConfigError(
            f"{path}: --out: cannot be written ({error.strerror}); free some space and go on with --resume"
        ) from None


def _check_folder(out: Path, origin: dict[str, object], resume: bool) -> None:
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: --out: is a file; give a folder")
    if not (out / "frames").exists() or not any((out / "frames").iterdir()):
        return
    if not resume:
        raise ConfigError(f"{out}: --out: holds frames; add --resume to go on with them or choose another folder")
    try:
        before = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise ConfigError(f"{out / 'plan.json'}: --resume: missing or damaged; choose another folder") from None
    changed = [name for name in origin if before.get(name) != origin[name]]
    if changed:
        raise ConfigError(
            f"{out}: --resume: the frames there were made with another {' and '.join(changed)}; choose another folder"
        )


def _origin(plan: Plan, backend: Backend) -> dict[str, object]:
    """What the frames depend on, by the names that error messages say."""

    def digest(*values: Tensor) -> str:
        return hashlib.sha256(b"".join(v.contiguous().numpy().tobytes() for v in values)).hexdigest()

    camera, target = plan.camera, plan.target
    return {
        "torchpose version": version("torchpose"),
        "backend": backend,
        "plan": plan.file.model_dump(exclude={"camera", "target", "bounds"}),
        "camera": [camera.width, camera.height, camera.model, digest(camera.matrix, camera.distortion)],
        "target": [target.name, target.background, digest(target.centers, target.normals, target.radii)],
        "poses": digest(plan.R, plan.t),
        "backgrounds": [path.name for path in plan.backgrounds],
    }


def _pictures(plan: Plan, numbers: list[int]) -> Tensor:
    """(B, H, W) float32 background pictures: scaled to cover the frame, cut about the centre."""
    return torch.from_numpy(np.stack([*_scaled(plan, numbers)]))


def _scaled(plan: Plan, numbers: list[int]) -> Iterator[np.ndarray]:
    from torchpose.io.images import UnreadableImageError, decode

    width, height = plan.camera.width, plan.camera.height
    for number in numbers:
        path = plan.backgrounds[number % len(plan.backgrounds)]
        try:
            picture = decode(path)
        except UnreadableImageError as error:
            raise ConfigError(f"{path}: background: cannot be read ({error.reason}); replace the file") from None
        grey: np.ndarray = picture.astype(np.float32) * np.float32(255.0 / np.iinfo(picture.dtype).max)
        scale = max(width / grey.shape[1], height / grey.shape[0])
        size = (max(width, round(grey.shape[1] * scale)), max(height, round(grey.shape[0] * scale)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        left, top = (size[0] - width) // 2, (size[1] - height) // 2
        yield np.ascontiguousarray(grey[top : top + height, left : left + width])

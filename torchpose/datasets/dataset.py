"""Data sets on disk: frames of a plan with their truth, streamed, resumable, in any batch size the same.

A data set is a folder:

    frames/0000.png ...      8 or 16 bit grey, lossless
    camera.yaml target.yaml  the models of the frames
    truth.csv                one row a frame, see `torchpose.io.truth`
    prints.csv print.yaml    where the plan has a print: one row a frame and marker; a target file, of one print for all
    plan.json                what the frames were made from
    bop/                     the same in the layout of the BOP challenge, where asked for
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchpose.analysis.crlb import pose_crlb, rig_crlb
from torchpose.camera import Camera
from torchpose.config import parse_json, write_text
from torchpose.datasets.plan import Plan
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.folders import Folder
from torchpose.io.images import UnreadableImageError, decode
from torchpose.io.processes import Crew
from torchpose.io.rows import Schema
from torchpose.io.storage import Place
from torchpose.io.truth import Truth, read_truth, write_truth
from torchpose.io.writers import write_rows
from torchpose.sim import Processing, SensorPattern, disturbed, faults_of, processed, read_out, with_faults
from torchpose.sim.clutter import random_clutter, random_covers
from torchpose.sim.renderer import Defocus, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.target import Target

Backend = Literal["analytic", "blender"]
Renderer = Callable[[Int[Tensor, " B"]], Float[Tensor, "B H W"]]
"""Noise-free frames, float32, of the frames numbered."""

_ALONE = partial(Crew, count=1)  # all work in this process
BLUR = ("psf_sigma", "psf_ratio", "psf_deg", "smear_px", "smear_deg", "disc_px")
DISTURBANCES = ("coma_px", "coma_deg", "haze_px", "ghost", "speckle", "flicker")
BOUND = ("sx", "sy", "sz", "srx", "sry", "srz")
_BOUNDS_AT_ONCE = 16  # poses, as many as are differentiated at a time
_BATCH_PIXELS = 7_000_000  # larger buffers go back to the system and are cleared anew each time


def plan_truth(plan: Plan) -> Truth:
    """The truth of a plan, without its bounds.

    Columns besides the pose: tilt_deg, psf_sigma, psf_ratio, psf_deg, smear_px, smear_deg, disc_px, see
    `torchpose.datasets.plan.Conditions`; noise_sigma (read noise), dark, light, motion_mm, motion_deg;
    markers_in_view, markers that lie in the frame as a whole; in_depth_range, 0 where the plan's range is left;
    those of `torchpose.sim.Disturbances`; edge_gain, the dot gain of the print.
    """
    taken, prints = plan.conditions, plan.prints
    return Truth(
        frame=plan.names,
        target=[plan.target.name] * len(plan),
        t=plan.t,
        rotation_vector=rotations.log(plan.R),
        extra={
            "tilt_deg": plan.R[:, 2, 2].clamp(-1, 1).acos().rad2deg(),
            **{name: getattr(taken, name) for name in BLUR},
            "noise_sigma": taken.noise,
            "dark": taken.dark,
            "light": taken.light,
            "motion_mm": plan.motion[:, :3].norm(dim=1),
            "motion_deg": plan.motion[:, 3:].norm(dim=1).rad2deg(),
            "markers_in_view": plan.seen.double(),
            "in_depth_range": plan.in_depth_range.double(),
            **{name: getattr(plan.disturbances, name) for name in DISTURBANCES},
            "edge_gain": torch.zeros(len(plan), dtype=torch.float64) if prints is None else prints.gain,
        },
    )


def bounds(plan: Plan, which: Int[Tensor, " B"]) -> Float[Tensor, "B 6"]:
    """Cramer-Rao standard deviations of the frames numbered ``which``; NaN where no pose is determined.

    With several cameras those of the pose from all of them. Of the evenly lit frame at rest, blurred by all but
    ``defocus``, with the noise of its dark parts, see `torchpose.analysis.pose_crlb`: a bound still, but one that
    defocus, motion, shot noise, clutter and covers keep any estimator away from.
    """
    sensor, part = plan.file.sensor, plan[which]
    taken = part.conditions
    variance = taken.noise.square() + (0.0 if sensor.full_well is None else 255.0 / sensor.full_well * taken.dark)
    given = {
        "dark": taken.dark,
        "light": taken.light,
        "noise_sigma": variance.sqrt(),
        "bits": sensor.bits,
        **taken.blur,
    }
    if plan.rig is None:
        covariance = pose_crlb(plan.camera, plan.target, part.R, part.t, **given)
    else:
        covariance = rig_crlb(plan.rig, plan.target, part.R, part.t, **given)
    return covariance.diagonal(dim1=1, dim2=2).sqrt()


def analytic(plan: Plan) -> Renderer:
    """`torchpose.sim.render` under the conditions of a plan."""
    image, seed = plan.file.imaging, plan.file.seed
    lens = None if image.defocus is None else Defocus(**image.defocus.model_dump())
    lighting = None
    if (light := image.lighting) is not None:
        point = None if light.point is None else (light.point[0], light.point[1], light.point[2])
        lighting = Lighting((light.gradient[0], light.gradient[1]), point, light.vignetting)

    @torch.inference_mode()
    def frames(which: Tensor) -> Tensor:
        part, numbers = plan[which], which.tolist()
        return render(
            plan.camera,
            plan.target if part.prints is None else part.prints,
            part.R,
            part.t,
            **part.conditions.blur,
            dark=part.conditions.dark,
            light=part.conditions.light,
            plate=image.plate,
            surround=_pictures(plan, numbers) if plan.backgrounds else part.conditions.surround,
            defocus=lens,
            motion=part.motion if bool(part.motion.any()) else None,
            lighting=lighting,
            clutter=random_clutter(plan.target, image.clutter, seed, numbers) if image.clutter else None,
            texture=part.texture,
            covers=random_covers(plan.target, image.covered, seed, numbers) if image.covered else None,
        )

    return frames


def simulated_frames(plan: Plan, renderer: Renderer, which: Int[Tensor, " B"]) -> Shaped[Tensor, "B H W"]:
    """The frames numbered ``which``, uint8 or uint16, as the plan's sensor delivers them."""
    sensor, seed = plan.file.sensor, plan.file.seed
    frames = disturbed(renderer(which), plan.disturbances[which], which)
    if plan.file.faults:
        frames = with_faults(frames, faults_of(plan.file.faults), seed, index=which)
    own = seed if sensor.seed is None else sensor.seed
    frames = read_out(frames, SensorPattern(sensor.prnu, sensor.column_noise, sensor.line_jitter, own), seed, which)
    noise, steps = plan.conditions.noise[which], Processing(**plan.file.processing.model_dump())
    if not steps.wanted:
        look: dict[str, Any] = {"full_well": sensor.full_well, "bits": sensor.bits, "gamma": sensor.gamma}
        return add_noise(frames, noise, seed, index=which, **look)
    raw = add_noise(frames, noise, seed, index=which, bits=16, full_well=sensor.full_well)
    return processed(raw.float() * (255.0 / 65535), steps, sensor.bits, sensor.gamma)


def write_dataset(
    plan: Plan,
    out: Path | Place,
    *,
    backend: Backend = "analytic",
    resume: bool = False,
    batch: int | None = None,
    crew: Callable[..., Any] = _ALONE,
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Writes a data set; memory does not grow with the number of frames.

    Args:
        plan: what to render.
        out: folder, made where it is missing; on a disk or in a store. ``truth.csv`` is its last file.
        backend: who renders.
        resume: keep the frames of an earlier run of the same plan.
        batch: frames at a time.
        crew: who shares out the work on items: processes, see `Crew`, or what else has their interface.
        progress: called with the number of frames just finished.

    Returns:
        Number of frames rendered now.

    Raises:
        ConfigError: the folder holds another data set, or holds one and ``resume`` is false, or cannot be written.
    """
    folder = Folder(out)
    frames = _prepare(plan, folder, backend, resume)
    done = frames.names()
    pending = torch.tensor([i for i, name in enumerate(plan.names) if name not in done], dtype=torch.int64)
    progress(len(plan) - len(pending))
    size = max(1, min(16, _BATCH_PIXELS // (plan.camera.width * plan.camera.height))) if backend == "analytic" else 1
    batches = torch.split(pending, batch or size) if len(pending) else ()
    stored = isinstance(out, Place)  # then each process has a connection of its own
    renderers = crew if backend == "analytic" else _ALONE  # Blender has threads of its own
    with renderers(partial(_write_frames, plan, backend, frames.absolute()), batches, fresh=stored) as rendered:
        for finished in rendered:
            progress(finished)
    truth = plan_truth(plan)
    if plan.file.bounds:
        with crew(partial(_bounds_of, plan), torch.split(torch.arange(len(plan)), _BOUNDS_AT_ONCE)) as parts:
            std = torch.cat(list(parts))
        truth.extra.update(zip(BOUND, std.unbind(1), strict=True))
    _write_prints(plan, folder)
    folder.save("truth.csv", partial(write_truth, truth=truth))
    return len(pending)


def write_rig_dataset(plan: Plan, out: Path | Place, **options: Any) -> int:
    """Writes a data set of several cameras: one of each in a folder of its name, the rig, and the truth of all.

    ``truth.csv`` has the poses in the first camera, and the joint bounds. Arguments and result as of `write_dataset`.
    """
    rig, folder = plan.rig, Folder(out)
    assert rig is not None
    count = sum(write_dataset(plan.of_camera(k), out / name, **options) for k, name in enumerate(rig.names))
    folder.save("rig.yaml", rig.save)
    folder.save("target.yaml", _alone(plan.target).save)
    truth = plan_truth(plan)
    if plan.file.bounds:
        std = torch.cat([bounds(plan, which) for which in torch.split(torch.arange(len(plan)), 64)])
        truth.extra.update(zip(BOUND, std.unbind(1), strict=True))
    truth = replace(truth, frame=[f"frames/{name}" for name in plan.names])
    folder.save("truth.csv", partial(write_truth, truth=truth))
    return count


def _alone(target: Target) -> Target:
    """Without a part: the truth is the pose of the target itself."""
    return replace(target, part_rotation=None, part_translation=None)


def _write_prints(plan: Plan, folder: Folder) -> None:
    """What was printed, where that differs from the target."""
    if (prints := plan.prints) is None:
        return
    names = ("x", "y", "z", "nx", "ny", "nz", "outer_radius", "inner_radius")
    values = torch.cat([prints.centers, prints.normals, prints.radii], -1).tolist()
    rows: list[dict[str, object]] = [
        {"frame": frame, "id": marker, **dict(zip(names, row, strict=True))}
        for frame, markers in zip(plan.names, values, strict=True)
        for marker, row in zip(plan.target.ids.tolist(), markers, strict=True)
    ]
    schema: Schema = {"frame": str, "id": int} | dict.fromkeys(names, float)
    folder.save("prints.csv", partial(write_rows, rows=rows, schema=schema))
    if plan.file.print is not None and plan.file.print.each == "set":
        folder.save("print.yaml", _alone(prints.as_target()).save)


def write_bop(out: Path) -> None:
    """The layout of the BOP challenge of the data set ``out``, in its folder bop: camera.json and the scene 000000.

    Rotations row by row, translations in mm, OpenCV's camera axes; ``obj_id`` 1 is the target. The frames are hard
    links to those of the data set. BOP has no lens distortion: a camera that has one is written as it is, with the
    coefficients in the key ``distortion`` of camera.json besides.
    """
    camera, truth = Camera.load(out / "camera.yaml"), read_truth(out / "truth.csv")
    scene = out / "bop" / "000000"
    (scene / "gray").mkdir(parents=True, exist_ok=True)
    matrix = camera.matrix.flatten().tolist()
    about = {
        **{"cx": matrix[2], "cy": matrix[5], "fx": matrix[0], "fy": matrix[4], "depth_scale": 1.0},
        **{"width": camera.width, "height": camera.height, "distortion": camera.distortion.tolist()},
    }
    poses = zip(truth.R.flatten(1).tolist(), truth.t.tolist(), strict=True)
    gt = {str(i): [{"cam_R_m2c": R, "cam_t_m2c": t, "obj_id": 1}] for i, (R, t) in enumerate(poses)}
    cameras = {str(i): {"cam_K": matrix, "depth_scale": 1.0} for i in range(len(truth))}
    write_text(scene.parent / "camera.json", json.dumps(about, indent=2) + "\n")
    write_text(scene.parent / "targets.json", json.dumps({"1": truth.target[0]}) + "\n")
    write_text(scene / "scene_gt.json", json.dumps(gt, indent=1) + "\n")
    write_text(scene / "scene_camera.json", json.dumps(cameras, indent=1) + "\n")
    for i, name in enumerate(truth.frame):
        link = scene / "gray" / f"{i:06d}.png"
        link.unlink(missing_ok=True)
        os.link(out / "frames" / name, link)


def _write_frames(plan: Plan, backend: Backend, folder: Folder, batches: Sequence[Tensor]) -> Iterator[int]:
    """Renders and writes the frames of each batch of numbers; how many they are."""
    if backend == "blender":
        from torchpose.datasets.blender import blender

        renderer = blender(plan)
    else:
        renderer = analytic(plan)
    for which in batches:
        for i, frame in zip(which.tolist(), simulated_frames(plan, renderer, which), strict=True):
            folder.write(plan.names[i], cv2.imencode(".png", frame.numpy())[1].tobytes())
        yield len(which)


def _bounds_of(plan: Plan, batches: Sequence[Tensor]) -> Iterator[Tensor]:
    yield from (bounds(plan, which) for which in batches)


def _prepare(plan: Plan, out: Folder, backend: Backend, resume: bool) -> Folder:
    """Writes all but frames and truth into the data set's folder; returns the folder of the frames."""
    origin, frames = _origin(plan, backend), out / "frames"
    if isinstance(out.where, Path) and os.path.exists(out.where) and not os.path.isdir(out.where):
        raise ConfigError(f"{out}: --out: is a file; give a folder")
    frames.make()
    if frames.names():
        _check_origin(out, origin, resume)
    text = json.dumps(origin, indent=2) + "\n"
    out.save("plan.json", partial(write_text, text=text))
    out.save("camera.yaml", plan.camera.save)
    out.save("target.yaml", _alone(plan.target).save)
    return frames


def _check_origin(out: Folder, origin: dict[str, object], resume: bool) -> None:
    """Raises ConfigError unless the frames in a folder are to be gone on with and were made from the same."""
    if not resume:
        raise ConfigError(f"{out}: --out: holds frames; add --resume to go on with them or choose another folder")
    try:
        before = parse_json(out.text("plan.json"))
        changed = [name for name in origin if before.get(name) != origin[name]]
    except (ConfigError, ValueError, AttributeError):
        raise ConfigError(f"{out.where / 'plan.json'}: --resume: missing or damaged; choose another folder") from None
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
        "plan": plan.file.model_dump(exclude={"camera", "cameras", "target", "bounds"}),
        "camera": [camera.width, camera.height, camera.model, digest(camera.matrix, camera.distortion)],
        "target": [target.name, target.background, digest(target.centers, target.normals, target.radii)],
        "poses": digest(plan.R, plan.t),
        "backgrounds": [path.name for path in plan.backgrounds],
    }


def _pictures(plan: Plan, numbers: list[int]) -> Float[Tensor, "B H W"]:
    """Background pictures, float32: scaled to cover the frame, cut about the centre."""
    width, height = plan.camera.width, plan.camera.height

    def scaled(path: Path) -> np.ndarray:
        try:
            picture = decode(path)
        except UnreadableImageError as error:
            raise ConfigError(f"{path}: background: cannot be read ({error.reason}); replace the file") from None
        grey: np.ndarray = picture.astype(np.float32) * np.float32(255.0 / np.iinfo(picture.dtype).max)
        scale = max(width / grey.shape[1], height / grey.shape[0])
        size = (max(width, round(grey.shape[1] * scale)), max(height, round(grey.shape[0] * scale)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        left, top = (size[0] - width) // 2, (size[1] - height) // 2
        return grey[top : top + height, left : left + width]

    return torch.from_numpy(np.stack([scaled(plan.backgrounds[i % len(plan.backgrounds)]) for i in numbers]))

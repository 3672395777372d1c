"""Blender (Cycles on the CPU) as a second, independent renderer of the same plans. Needs the extra ``blender``.

The rings are an analytic shader on a square of true geometry: emission is dark where inner <= distance < outer, so
there is no bitmap and no tessellation of circles. Units are millimetres and the world frame is the target's; only the
camera moves. A bent plate is a mesh whose vertices have its height. The response is linear, the view transform raw, and
nothing but emission is traced. Only the plate's region is rendered, the rest is the surround.

Cycles samples a pixel filter, which stands for the optical blur and the pixel's area together: a Blackman-Harris window
of the same variance as the plan's Gaussian and the unit square. Its name in the settings says half of its support.
"""

import contextlib
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpose.datasets.plan import Plan
from torchpose.errors import ConfigError

SAMPLES = 1024  # paths a pixel on edges; even regions stop at the least number
_LEAST_SAMPLES = 32
_SENSOR_MM = 36.0
_MESH = 96  # squares of a bent plate along each side: flat pieces leave (70 mm / 96)^2 / 8 of its curvature
_MARGIN = 8  # px of surround around the plate that are rendered with it


def blender(plan: Plan, *, samples: int = SAMPLES, threads: int = 0) -> Callable[[Tensor], Tensor]:
    """Noise-free frames (B, H, W) float32 of the frames numbered (B,), rendered by Blender one after the other.

    Args:
        plan: what to render.
        samples: paths a pixel on edges.
        threads: of Blender; 0 for all cores.

    Raises:
        ConfigError: bpy is not installed, or the plan wants what this backend does not model.
    """
    _check(plan)
    try:
        import bpy
    except ImportError:
        raise ConfigError(
            "bpy: --backend blender: is not installed; run pip install 'torchpose[blender]' under Python 3.11"
        ) from None
    scene, levels = _build(bpy, plan, samples, threads)

    def frames(which: Tensor) -> Tensor:
        return torch.stack([_render(bpy, scene, levels, plan, number) for number in which.tolist()])

    return frames


def filter_width(psf_sigma: float) -> float:
    """Cycles' filter width (half of the support, px) of the variance psf_sigma^2 + 1/12."""
    a0, terms = 0.35875, ((1, 0.48829), (2, 0.14128), (3, 0.01168))  # Blackman-Harris on [-1/2, 1/2]
    variance = (a0 / 12 + sum(a * (-1) ** k / (2 * (math.pi * k) ** 2) for k, a in terms)) / a0
    return math.sqrt((psf_sigma**2 + 1 / 12) / variance) / 2


def _check(plan: Plan) -> None:
    image = plan.file.imaging
    unknown = {
        "defocus": image.defocus is not None,
        "lighting": image.lighting is not None,
        "motion_mm": bool(plan.motion.any()),
        "psf_ratio": image.psf_ratio[1] > 1,
        "smear_px": image.smear_px[1] > 0,
        "disc_px": image.disc_px[1] > 0,
        "clutter": image.clutter > 0,
        "covered": image.covered > 0,
        "background": image.background is not None,
    }
    unknown = {f"imaging.{name}": wanted for name, wanted in unknown.items()}
    if (made := plan.file.print) is not None:
        unknown |= {
            "print.each": made.each == "frame",
            "print.center_sigma": made.center_sigma[2] > 0,  # along z: markers off the plate
            "print.texture": made.texture is not None,
            "print.dpi": made.dpi is not None,
        }
    for field in (name for name, wanted in unknown.items() if wanted):
        raise ConfigError(
            f"{plan.path}: {field}: is not modelled by the Blender backend; remove it or use the analytic one"
        )
    if image.plate is None:
        raise ConfigError(f"{plan.path}: imaging.plate: is missing, the Blender backend needs it; add [width, height]")
    if bool(plan.camera.distortion.any()) or plan.camera.model != "brown_conrady":
        raise ConfigError(
            f"{plan.path}: camera: has lens distortion, which the Blender backend does not model; "
            "use the analytic one or a camera without"
        )
    if not plan.target.coplanar or bool((plan.target.centers[:, 2] != 0).any()):
        raise ConfigError(f"{plan.path}: target: is not flat in z = 0; use the analytic backend")


def _build(bpy: Any, plan: Plan, samples: int, threads: int) -> tuple[Any, dict[str, Any]]:
    """The scene, and the sockets of its grey levels."""
    with _stdout_to_stderr():
        bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = plan.camera
    material, levels = _ring_material(bpy, plan)
    mesh = bpy.data.meshes.new("plate")
    mesh.from_pydata(*_plate_mesh(plan))
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("plate", mesh))

    fx, fy, cx, cy = (float(camera.matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = bpy.data.cameras.new("camera")
    _set(lens, type="PERSP", sensor_fit="HORIZONTAL", sensor_width=_SENSOR_MM, clip_start=1.0, clip_end=1e5)
    # pixel centres at integers: the image plane spans -0.5 .. W - 0.5; shifts are in widths, upwards
    _set(
        lens,
        lens=fx * _SENSOR_MM / camera.width,
        shift_x=((camera.width - 1) / 2 - cx) / camera.width,
        shift_y=(cy - (camera.height - 1) / 2) / camera.width * (fx / fy),
    )
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(scene.camera)

    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.cycles.sampling_method = "NONE"
    levels["surround"] = scene.world.node_tree.nodes["Background"].inputs["Color"]

    _set(scene.render, engine="CYCLES", use_border=True, use_crop_to_border=True, use_persistent_data=True)
    _set(scene.render, resolution_x=camera.width, resolution_y=camera.height, resolution_percentage=100)
    _set(scene.render, pixel_aspect_x=max(1.0, fy / fx), pixel_aspect_y=max(1.0, fx / fy), dither_intensity=0.0)
    _set(scene.render, threads_mode="FIXED" if threads else "AUTO", threads=threads or 1)
    _set(scene.render.image_settings, file_format="OPEN_EXR", color_mode="RGB", color_depth="32")
    scene.view_settings.view_transform = "Raw"
    _set(scene.cycles, device="CPU", samples=samples, adaptive_min_samples=min(_LEAST_SAMPLES, samples))
    _set(scene.cycles, use_adaptive_sampling=samples > _LEAST_SAMPLES, adaptive_threshold=1e-4, max_bounces=0)
    _set(scene.cycles, use_denoising=False, use_light_tree=False, pixel_filter_type="BLACKMAN_HARRIS")
    _set(scene.cycles, sample_clamp_direct=0.0, sample_clamp_indirect=0.0)
    return scene, levels


def _plate_mesh(plan: Plan) -> tuple[list[list[float]], list[Any], list[tuple[int, ...]]]:
    """Vertices, no edges and faces of the plate: a rectangle, or squares between vertices of its height."""
    w, h = (side / 2 for side in plan.file.imaging.plate or ())
    cells = 1 if plan.prints is None or not bool(plan.prints.curvature.any()) else _MESH
    x, y = (torch.linspace(-side, side, cells + 1, dtype=torch.float64) for side in (w, h))
    place = torch.cartesian_prod(x, y)
    height = torch.zeros_like(place[:, 0]) if plan.prints is None else plan.prints[:1].height(place)[0]
    vertices = torch.cat([place, height[:, None]], 1).tolist()
    first = [a * (cells + 1) + b for a in range(cells) for b in range(cells)]
    return vertices, [], [(k, k + cells + 1, k + cells + 2, k + 1) for k in first]


def _set(settings: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(settings, name, value)


def _ring_material(bpy: Any, plan: Plan) -> tuple[Any, dict[str, Any]]:
    """Emission of one level in the rings and another around them, and the sockets of both."""
    material = bpy.data.materials.new("rings")
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"
    tree = material.node_tree
    tree.nodes.clear()
    new, link = tree.nodes.new, tree.links.new
    place = new("ShaderNodeTexCoord").outputs["Object"]

    def math_node(operation: str, *operands: Any) -> Any:
        node = new("ShaderNodeMath")
        node.operation = operation
        for socket, value in zip(node.inputs, operands, strict=False):
            if isinstance(value, float):
                socket.default_value = value
            else:
                link(value, socket)
        return node.outputs[0]

    ink: Any = 0.0
    shown = plan.target if plan.prints is None else plan.prints.as_target()
    for center, (outer, inner) in zip(shown.centers.tolist(), shown.printed_radii.tolist(), strict=True):
        distance = new("ShaderNodeVectorMath")
        distance.operation = "DISTANCE"
        link(place, distance.inputs[0])
        distance.inputs[1].default_value = center
        radius = distance.outputs["Value"]
        ring = math_node("SUBTRACT", math_node("LESS_THAN", radius, outer), math_node("LESS_THAN", radius, inner))
        ink = math_node("ADD", ring, ink)
    contrast, paper = new("ShaderNodeValue").outputs[0], new("ShaderNodeValue").outputs[0]
    emission, output = new("ShaderNodeEmission"), new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (1, 1, 1, 1)
    link(math_node("ADD", math_node("MULTIPLY", ink, contrast), paper), emission.inputs["Strength"])
    link(emission.outputs[0], output.inputs["Surface"])
    return material, {"contrast": contrast, "paper": paper}


def _render(bpy: Any, scene: Any, levels: dict[str, Any], plan: Plan, number: int) -> Tensor:
    """One frame (H, W) float32, grey levels 0..255."""
    from mathutils import Matrix

    width, height = plan.camera.width, plan.camera.height
    taken = plan.conditions
    ink, paper, surround = (float(level[number]) / 255 for level in (taken.dark, taken.light, taken.surround))
    if plan.target.background == "dark":
        ink, paper = paper, ink
    levels["contrast"].default_value, levels["paper"].default_value = ink - paper, paper
    levels["surround"].default_value = (surround, surround, surround, 1.0)
    image = torch.full((height, width), 255 * surround)
    R, t = plan.R[number], plan.t[number]
    box = _plate_box(plan, R, t)
    if box is None:
        return image
    u0, v0, u1, v1 = box
    # Blender's camera looks along -z with y upwards; a quaternion has less rounding than Euler angles
    axes = R.T @ torch.diag(R.new_tensor([1.0, -1.0, -1.0]))
    scene.camera.rotation_quaternion = Matrix(axes.tolist()).to_quaternion()
    scene.camera.location = (-R.T @ t).tolist()
    render = scene.render  # the border is in fractions of the frame from the bottom left
    render.border_min_x, render.border_max_x = (u0 + 1e-3) / width, (u1 + 1e-3) / width
    render.border_min_y, render.border_max_y = (height - v1 + 1e-3) / height, (height - v0 + 1e-3) / height
    scene.cycles.filter_width = filter_width(float(taken.psf_sigma[number]))
    scene.cycles.seed = (plan.file.seed + number) % 2**31
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tile.exr"
        render.filepath = str(path)
        with _stdout_to_stderr():
            bpy.ops.render.render(write_still=True)
        tile = bpy.data.images.load(str(path))
        pixels = np.empty(tile.size[0] * tile.size[1] * 4, np.float32)
        tile.pixels.foreach_get(pixels)
        shape = (tile.size[1], tile.size[0])
        bpy.data.images.remove(tile)
    if shape != (v1 - v0, u1 - u0):
        raise RuntimeError(f"Blender rendered {shape} where {(v1 - v0, u1 - u0)} was asked for")
    image[v0:v1, u0:u1] = 255 * torch.from_numpy(pixels.reshape(*shape, 4)[::-1, :, 1].copy())
    return image


def _plate_box(plan: Plan, R: Tensor, t: Tensor) -> tuple[int, int, int, int] | None:
    """First and past-the-last column and row of the plate's region; None where it is not in the frame."""
    w, h = (side / 2 for side in plan.file.imaging.plate or ())
    corners = R.new_tensor([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]])
    pixel = plan.camera.project(corners @ R.T + t)
    if not bool(pixel.isfinite().all()):
        return None
    size = torch.tensor([plan.camera.width, plan.camera.height])
    low = (pixel.amin(0).floor().long() - _MARGIN).clamp(min=0)
    high = (pixel.amax(0).ceil().long() + _MARGIN + 1).minimum(size)
    return None if bool((high <= low).any()) else (int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Blender tells of its progress on the process's stdout, which belongs to the results."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)

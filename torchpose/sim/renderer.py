"""Analytic renderer: grey frames of a flat target, exact under perspective, lens distortion and blur.

What is modelled: the scene is piecewise constant; its image is convolved with an isotropic Gaussian point-spread
function of standard deviation ``psf_sigma`` and with the unit square of the pixel (fill factor 1), both in the raw,
distorted pixel frame; the sensor is linear. Nothing is rounded or clipped before `add_noise`.

Exact to quadrature, see `torchpose.sim.boundary`: outlines, perspective, distortion, Gaussian blur, defocus, motion.
Approximate: where outlines of two layers cross within a blur's width, their blurred coverages are multiplied; light is
multiplied after the blur (`torchpose.sim.sensor.Lighting`). docs/decisions/0003-renderer.md and 0010-imaging-effects.md
have the comparisons with supersampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError, FrameError
from torchpose.geometry import rotations
from torchpose.sim import boundary
from torchpose.sim.boundary import REACH, Boundary, Boxes
from torchpose.sim.sensor import Lighting
from torchpose.sim.shapes import Shapes, rectangle, rings
from torchpose.target import Target

_CHUNK_PIXELS = 1 << 24  # pixels rendered at a time


@dataclass(frozen=True)
class Defocus:
    """A lens that is focused on one distance: every marker and shape is blurred by the disc of its own depth.

    Thin lens: with the aperture A = focal_length / f_number, the image of a point at the depth z is a disc of the
    radius fx A / 2 |1 / z - 1 / focus_distance| px.

    Attributes:
        f_number: aperture number. focal_length: mm. focus_distance: depth of sharpness from the camera's centre, mm.
    """

    f_number: float
    focal_length: float
    focus_distance: float

    def __post_init__(self) -> None:
        for name in ("f_number", "focal_length", "focus_distance"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name}: {getattr(self, name)} is not above 0; give a positive number")

    def radius(self, camera: Camera, depth: Tensor) -> Tensor:
        """Radius (...) of the disc in px at depths (...) in mm; fx stands for both axes."""
        scale = camera.matrix[0, 0].to(depth) * self.focal_length / self.f_number / 2
        return scale * (1 / depth.clamp_min(1e-6) - 1 / self.focus_distance).abs()


def render(
    camera: Camera,
    target: Target | Shapes,
    R: Tensor,
    t: Tensor,
    *,
    psf_sigma: float | Tensor = 0.7,
    dark: float | Tensor = 30.0,
    light: float | Tensor = 220.0,
    plate: tuple[float, float] | None = None,
    surround: float | Tensor = 90.0,
    defocus: Defocus | None = None,
    motion: Tensor | None = None,
    lighting: Lighting | None = None,
    clutter: Shapes | None = None,
    covers: Shapes | None = None,
) -> Tensor:
    """Noise-free frames of a target, grey values 0..255, differentiable in pose, blur and grey levels.

    The target's rings are drawn with ``dark`` on ``light``, or the other way round where ``target.background`` is dark.
    A shape, the plate too, is drawn from either side, and not at all where it reaches behind the camera or beyond the
    radius up to which the distortion model is one-to-one.

    Args:
        camera: the camera; its width and height are those of the frames.
        target: the target, or shapes with levels of their own.
        R, t: (B, 3, 3) and (B, 3), target to camera, mm.
        psf_sigma: Gaussian blur in px, above 0; the pixel's own area comes on top. A number or (B,).
        dark, light: grey levels; numbers or (B,).
        plate: width and height in mm of the plate, centred on the target's origin in its plane z = 0; None: it fills
            the frame.
        surround: grey level around the plate: a number, (B,), or background pictures (B, H, W), which stay as sharp as
            they are.
        defocus: the lens, None for one that is sharp everywhere.
        motion: (B, 6), translation in mm and rotation vector in rad about the camera axes during the exposure, of
            which ``R, t`` is the middle; None for a target at rest. Averaged by Gauss-Legendre quadrature in time.
        lighting: uneven light, None for even light.
        clutter: shapes on and beside the plate, below the rings. covers: shapes over everything.

    Returns:
        (B, H, W) float32.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0, or there are background pictures and no plate.
        FrameError: shapes of R and t, of ``motion`` or of background pictures disagree.
    """
    R, t = check_poses(R, t)
    sigma = check_blur(psf_sigma, t)
    dark_, light_ = per_frame(dark, t), per_frame(light, t)
    inverted = isinstance(target, Target) and target.background == "dark"
    ink, paper = (light_, dark_) if inverted else (dark_, light_)
    if motion is not None and motion.shape != (len(t), 6):
        raise FrameError(f"motion: shape {tuple(motion.shape)} is not (B, 6) of {len(t)} poses")
    ground = _ground(camera, t, paper, surround, plate)
    if len(t) == 0:
        return ground.new_zeros(0, camera.height, camera.width)
    together = max(1, _CHUNK_PIXELS // (camera.width * camera.height))
    out = []
    for a in range(0, len(t), together):
        s = slice(a, a + together)
        count = len(t[s])
        layers: list[tuple[Shapes, Tensor]] = []
        if plate is not None:
            rim = rectangle((0.0, 0.0), *plate).to(t).in_frames(torch.arange(count, device=t.device))
            layers.append((rim, paper[s][rim.frame]))
        if clutter is not None:
            layers.append(_levels(clutter, a, count, t))
        if isinstance(target, Target):
            marks = rings(target).to(t).in_frames(torch.arange(count, device=t.device))
            layers.append((marks, ink[s][marks.frame]))
        else:
            layers.append(_levels(target, a, count, t))
        if covers is not None:
            layers.append(_levels(covers, a, count, t))
        frames = ground[s].float().expand(count, camera.height, camera.width).contiguous()
        twist = None if motion is None else motion[s].to(t)
        for shapes, level in layers:
            boxes, coverage = cover(camera, shapes, R[s], t[s], sigma[s], defocus=defocus, motion=twist)
            frames = _paint(frames, shapes, level, boxes, coverage.float())
        if lighting is not None:
            frames = frames * lighting.gain(camera, R[s], t[s])
        out.append(frames)
    return torch.cat(out) if len(out) > 1 else out[0]


def cover(
    camera: Camera,
    shapes: Shapes,
    R: Tensor,
    t: Tensor,
    sigma: Tensor,
    *,
    defocus: Defocus | None = None,
    motion: Tensor | None = None,
) -> tuple[Boxes, Tensor]:
    """Blurred coverage of each shape in its own window, see `torchpose.sim.boundary.fill`; windows may be empty.

    Args: as in `render`; R, t, ``motion`` in float64, sigma (B,) float64.
    """
    edges = boundary.sample_boundary(camera, shapes, R, t, sigma)
    shape = edges.shape
    pixel, dv = boundary.project(camera, edges, R, t)
    blur = sigma[edges.frame]
    margin = (0.5 + REACH * sigma)[shapes.frame]
    if motion is not None:
        pixel, dv, nodes = _moving(camera, edges, R, t, motion, pixel, sigma)
        blur, shape = blur.repeat(nodes), shape.repeat(nodes)
    half = None
    if defocus is not None:
        center = (R[shapes.frame] @ shapes.center[..., None]).squeeze(-1) + t[shapes.frame]
        radius = defocus.radius(camera, center[:, 2])
        margin = margin + radius
        offset, half_chord, weight = boundary.on_chords(radius[shape], blur)
        half = half_chord.reshape(-1)
        shift = torch.stack([torch.zeros_like(offset), offset], -1)
        pixel, dv = (pixel + shift).reshape(-1, 2), (weight * dv).reshape(-1)
        blur, shape = blur.repeat(len(weight)), shape.repeat(len(weight))
    boxes = boundary.boxes_around(pixel.detach(), shape, margin.detach(), camera.width, camera.height)
    return boxes, boundary.fill(pixel, dv, blur, shape, boxes, half_chord=half)


def _moving(
    camera: Camera, edges: Boundary, R: Tensor, t: Tensor, motion: Tensor, middle: Tensor, sigma: Tensor
) -> tuple[Tensor, Tensor, int]:
    """Samples at the nodes of a quadrature over the exposure: pixels (K N, 2), weighted dv (K N,) and K."""

    def posed(time: Tensor) -> tuple[Tensor, Tensor]:
        turn = rotations.exp(time[:, None, None] * motion[:, 3:])
        return turn @ R, t + time[:, None, None] * motion[:, :3]

    with torch.no_grad():
        ends, _ = _project_each(camera, edges, *posed(motion.new_tensor([-0.5, 0.5])))
        path = (ends - middle).norm(dim=-1) / sigma[edges.frame]
        nodes = boundary.nodes_across(float(path.max()) if path.numel() else 0.0)
    node, weight = boundary.gauss_legendre(nodes, t)
    pixel, dv = _project_each(camera, edges, *posed(node - 0.5))
    return pixel.reshape(-1, 2), (weight[:, None] * dv).reshape(-1), nodes


def _project_each(camera: Camera, edges: Boundary, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (K, N, 2) and dv (K, N) of the samples under K poses of every frame: (K, B, 3, 3), (K, B, 3)."""
    k, b = t.shape[:2]
    pose = (torch.arange(k, device=t.device)[:, None] * b + edges.frame).reshape(-1)
    every = Boundary(pose, edges.shape.repeat(k), edges.point.repeat(k, 1), edges.step.repeat(k, 1))
    pixel, dv = boundary.project(camera, every, R.reshape(-1, 3, 3), t.reshape(-1, 3))
    return pixel.view(k, -1, 2), dv.view(k, -1)


def _paint(frames: Tensor, shapes: Shapes, level: Tensor, boxes: Boxes, coverage: Tensor) -> Tensor:
    """Frames (B, H, W) with one layer of shapes of grey levels (S,) over them."""
    _, height, width = frames.shape
    row, number = boundary.ragged(boxes.size[:, 1])
    first = ((shapes.frame * height + boxes.corner[:, 1])[row] + number) * width + boxes.corner[row, 0]
    flat = frames.view(-1)
    # behind the end of its window a row covers nothing, so those cells may fall on any pixel
    index = first[:, None] + torch.arange(boxes.stride, device=first.device)
    index = index.clamp_(max=flat.numel() - 1).view(-1)
    change = coverage * (level.float()[row, None] - flat.index_select(0, index).view_as(coverage))
    return boundary.accumulate(flat, index, change.view(-1)).view_as(frames)


def _ground(
    camera: Camera, t: Tensor, paper: Tensor, surround: float | Tensor, plate: tuple[float, float] | None
) -> Tensor:
    """(B, 1, 1) or (B, H, W), what lies below all shapes."""
    if isinstance(surround, Tensor) and surround.ndim == 3:
        if plate is None:
            raise ConfigError("surround: background pictures need a plate before them; give its size")
        if surround.shape != (len(t), camera.height, camera.width):
            wanted = (len(t), camera.height, camera.width)
            raise FrameError(f"surround: shape {tuple(surround.shape)} of the pictures is not {wanted}")
        return surround
    return (paper if plate is None else per_frame(surround, t))[:, None, None]


def _levels(shapes: Shapes, first: int, count: int, like: Tensor) -> tuple[Shapes, Tensor]:
    chosen = shapes.to(like).of_frames(first, count)
    return chosen, chosen.level


def per_frame(value: float | Tensor, like: Tensor) -> Tensor:
    """(B,) tensor of a number or a (B,) tensor, of the dtype and device of ``like`` (B, ...)."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape[0])


def check_blur(psf_sigma: float | Tensor, like: Tensor) -> Tensor:
    """(B,) blur in px, after a check of its sign."""
    sigma = per_frame(psf_sigma, like)
    if not bool((sigma > 0).all()):
        raise ConfigError("psf_sigma: the blur must be above 0 px; give for example 0.3 for a very sharp lens")
    return sigma


def check_poses(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """R and t in float64, after a check of their shapes."""
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (R.shape[0], 3):
        raise FrameError(f"R, t: shapes {tuple(R.shape)} and {tuple(t.shape)} are not (B, 3, 3) and (B, 3)")
    return R.double(), t.double()

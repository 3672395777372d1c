"""Analytic renderer: grey frames of a flat target, exact under perspective, lens distortion and blur.

What is modelled: the scene is piecewise constant; its image is convolved with an isotropic Gaussian point-spread
function of standard deviation ``psf_sigma`` and with the unit square of the pixel (fill factor 1), both in the raw,
distorted pixel frame; the sensor is linear. Nothing is rounded or clipped before `add_noise`.

Exact to quadrature, see `torchpose.sim.boundary`: outlines, perspective, distortion, Gaussian blur, defocus, motion.
Approximate: where outlines of two layers cross within a blur's width, their blurred coverages are multiplied; light is
multiplied after the blur (`torchpose.sim.sensor.Lighting`). docs/decisions/0003-renderer.md and 0010-imaging-effects.md
have the comparisons with supersampling.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError, FrameError
from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.quadrature import gauss_legendre
from torchpose.geometry.segments import ragged_arange
from torchpose.sim import boundary
from torchpose.sim.blur import Blur, Level, Pair, blur_of, blurred, start
from torchpose.sim.boundary import Boundary, Boxes
from torchpose.sim.prints import Prints
from torchpose.sim.sensor import Lighting
from torchpose.sim.shapes import Shapes, rectangle, rings
from torchpose.sim.texture import Texture
from torchpose.target import Target

_CHUNK_PIXELS = 1 << 24  # pixels rendered at a time


@dataclass(frozen=True)
class Defocus:
    """A lens that is focused on one distance: every marker and shape is blurred by the disc of its own depth.

    Thin lens: with the aperture A = focal_length / f_number, the image of a point at the depth z is a disc of the
    radius fx A / 2 |1 / z - 1 / focus_distance| px.

    Attributes:
        f_number: aperture number.
        focal_length: mm.
        focus_distance: depth of sharpness from the camera's centre, mm.
    """

    f_number: float
    focal_length: float
    focus_distance: float

    def __post_init__(self) -> None:
        for f in fields(self):
            if not getattr(self, f.name) > 0:
                raise ConfigError(f"{f.name}: {getattr(self, f.name)} is not above 0; give a positive number")

    def radius(self, camera: Camera, depth: Tensor) -> Tensor:
        """Radius (...) of the disc in px at depths (...) in mm; fx stands for both axes."""
        scale = camera.matrix[0, 0].to(depth) * self.focal_length / self.f_number / 2
        return scale * (1 / depth.clamp_min(1e-6) - 1 / self.focus_distance).abs()


@dataclass(frozen=True, eq=False)
class Imaging:
    """Conditions under which B frames are rendered, apart from camera and poses.

    Attributes:
        psf_sigma: Gaussian blur in px, above 0; the pixel's own area comes on top. Or the covariance of an elliptic one
            in px^2, (B, 2, 2), or (2, 2) for all frames.
        smear: (B, 2), or (2,) for all frames, motion in the image by so many px during the exposure, of which the pose
            is the middle: a box along a line, the same everywhere in the frame. None for none.
        disc: radius in px of a disc, the same everywhere in the frame; not together with ``defocus``.
        dark: grey level of the rings, or of what is around them where ``target.background`` is dark.
        light: grey level of the other one.
        plate: width and height in mm of the plate, centred on the target's origin in its plane z = 0; None: it fills
            the frame.
        surround: grey level around the plate, or background pictures (B, H, W), which stay as sharp as they are.
        defocus: the lens, None for one that is sharp everywhere.
        motion: (B, 6), translation in mm and rotation vector in rad about the camera axes during the exposure, of
            which the pose is the middle; None for a target at rest. Averaged by Gauss-Legendre quadrature in time.
        lighting: uneven light, None for even light.
        clutter: shapes on and beside the plate, below the rings.
        covers: shapes over everything.
        texture: of the plate, the clutter and the rings on it; None for an even reflectance.
    """

    psf_sigma: Level = 0.7
    smear: Pair | None = None
    disc: Level = 0.0
    dark: Level = 30.0
    light: Level = 220.0
    plate: Sequence[float] | None = None
    surround: Level = 90.0
    defocus: Defocus | None = None
    motion: Tensor | None = None
    lighting: Lighting | None = None
    clutter: Shapes | None = None
    covers: Shapes | None = None
    texture: Texture | None = None


@checked
def render(
    camera: Camera, target: Target | Prints | Shapes, R: Tensor, t: Tensor, **imaging: Any
) -> Float[Tensor, "B H W"]:
    """Noise-free float32 frames of a target, grey values 0..255, differentiable in pose, blur and grey levels.

    A shape, the plate too, is drawn from either side, and not at all where it reaches behind the camera or beyond the
    radius up to which the distortion model is one-to-one.

    Args:
        camera: the camera; its width and height are those of the frames.
        target: the target, a print of it for every frame, or shapes with levels of their own.
        R: (B, 3, 3), target to camera.
        t: (B, 3), target to camera, mm.
        imaging: fields of `Imaging`: ``psf_sigma``, ``dark``, ``light``, ``plate``, ``surround`` and so on.

    Raises:
        ConfigError: ``psf_sigma`` is not above 0 or no covariance, ``disc`` is below 0 or stands beside ``defocus``, or
            there are background pictures and no plate.
        FrameError: shapes of R and t, of prints, blur, ``motion`` or background pictures disagree.
    """
    R, t = check_poses(R, t)
    scene = Imaging(**imaging)
    blur, motion = blur_of(scene.psf_sigma, scene.smear, scene.disc, t), scene.motion
    if scene.defocus is not None and bool(blur.disc.any()):
        raise ConfigError("disc: a lens has one defocus; give disc or defocus")
    if motion is not None and motion.shape != (len(t), 6):
        raise FrameError(f"motion: shape {tuple(motion.shape)} is not (B, 6) of {len(t)} poses")
    if isinstance(target, Prints) and len(target) != len(t):
        raise FrameError(f"target: {len(target)} prints are not one for each of {len(t)} poses")
    ink, paper = per_frame(scene.dark, t), per_frame(scene.light, t)
    if not isinstance(target, Shapes) and _background_of(target) == "dark":
        ink, paper = paper, ink
    ground = _ground(camera, t, paper, scene)
    if len(t) == 0:
        return ground.new_zeros(0, camera.height, camera.width)
    together = max(1, _CHUNK_PIXELS // (camera.width * camera.height))
    out = []
    for part in (slice(first, first + together) for first in range(0, len(t), together)):
        frames = ground[part].float().expand(len(t[part]), camera.height, camera.width).contiguous()
        twist = None if motion is None else motion[part].to(t)
        for shapes in _layers(target, scene, ink[part], paper[part], part.start):
            if isinstance(shapes, Texture):
                frames = frames * shapes.gain(camera, R[part], t[part], _size(scene.plate))
                continue
            boxes, coverage = cover(camera, shapes, R[part], t[part], blur[part], scene.defocus, twist)
            frames = _paint(frames, shapes, boxes, coverage.float())
        out.append(frames if scene.lighting is None else frames * scene.lighting.gain(camera, R[part], t[part]))
    return torch.cat(out) if len(out) > 1 else out[0]


def _background_of(target: Target | Prints) -> str:
    """Tone around the rings, ``light`` or ``dark``."""
    return (target.target if isinstance(target, Prints) else target).background


def _size(plate: Sequence[float] | None) -> tuple[float, float] | None:
    return None if plate is None else (plate[0], plate[1])


def _layers(
    target: Target | Prints | Shapes, scene: Imaging, ink: Tensor, paper: Tensor, first: int
) -> list[Shapes | Texture]:
    """What is drawn one over the other in the frames from the number ``first`` on, with levels ink and paper (B,)."""

    def alike(shapes: Shapes, level: Tensor) -> Shapes:
        each = shapes.to(level).in_frames(torch.arange(len(level), device=level.device))
        return replace(each, level=level[each.frame])

    def own(shapes: Shapes | None) -> list[Shapes]:
        return [] if shapes is None else [shapes.to(ink).of_frames(first, len(ink))]

    plate = [] if scene.plate is None else [alike(rectangle((0.0, 0.0), scene.plate[0], scene.plate[1]), paper)]
    if isinstance(target, Prints):
        marks = [target.to(ink)[first : first + len(ink)].rings(ink)]
    else:
        marks = [alike(rings(target), ink)] if isinstance(target, Target) else own(target)
    texture = [] if scene.texture is None else [scene.texture[first : first + len(ink)]]
    return [*plate, *own(scene.clutter), *marks, *texture, *own(scene.covers)]


def cover(
    camera: Camera,
    shapes: Shapes,
    R: Float[Tensor, "B 3 3"],
    t: Float[Tensor, "B 3"],
    blur: Blur,
    defocus: Defocus | None = None,
    motion: Float[Tensor, "B 6"] | None = None,
) -> tuple[Boxes, Float[Tensor, "rows stride"]]:
    """Blurred coverage of each shape in its own window, see `torchpose.sim.boundary.fill`; windows may be empty.

    Arguments as in `render` and `Imaging`, in float64.
    """
    radius = blur.disc[shapes.frame]
    if defocus is not None:
        center = (R[shapes.frame] @ shapes.center[..., None]).squeeze(-1) + t[shapes.frame]
        radius = defocus.radius(camera, center[:, 2])
    disc = radius.detach()
    edges = boundary.sample_boundary(camera, shapes, R, t, blur.finest, blur.reach[shapes.frame] + disc)
    if motion is None:
        pixel, dv = (x[None] for x in boundary.project(camera, edges, R, t))
    else:
        pixel, dv = _moving(camera, edges, R, t, motion, blur.finest)
    samples = blurred(start(edges, pixel, dv, blur), blur, radius)
    boxes = boundary.boxes_around(samples.pixel.detach(), samples.shape, blur.margin[shapes.frame] + disc, camera)
    covered = boundary.fill(samples, boxes)
    if blur.cross is not None and torch.is_grad_enabled():
        with torch.no_grad():
            mixed = boundary.fill(samples, boxes, (1, 1))
        covered = covered + blur.cross[shapes.frame].repeat_interleave(boxes.size[:, 1])[:, None] * mixed
    return boxes, covered


def _moving(
    camera: Camera, edges: Boundary, R: Tensor, t: Tensor, motion: Tensor, sigma: Tensor
) -> tuple[Tensor, Tensor]:
    """Samples at the nodes of a quadrature over the exposure: pixels (K, N, 2) and weighted dv (K, N)."""

    def posed(time: Tensor) -> tuple[Tensor, Tensor]:
        turn = rotations.exp(time[:, None, None] * motion[:, 3:])
        return turn @ R, t + time[:, None, None] * motion[:, :3]

    with torch.no_grad():
        before, middle, after = _project_each(camera, edges, *posed(motion.new_tensor([-0.5, 0.0, 0.5])))[0]
        path = torch.maximum((before - middle).norm(dim=-1), (after - middle).norm(dim=-1)) / sigma[edges.frame]
        nodes = boundary.nodes_across(float(path.max()) if path.numel() else 0.0)
    node, weight = gauss_legendre(nodes, t)
    pixel, dv = _project_each(camera, edges, *posed(node - 0.5))
    return pixel, weight[:, None] * dv


def _project_each(camera: Camera, edges: Boundary, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (K, N, 2) and dv (K, N) of the samples under K poses of every frame: (K, B, 3, 3), (K, B, 3)."""
    count, frames = t.shape[:2]
    every = Boundary.cat([replace(edges, frame=edges.frame + k * frames) for k in range(count)])
    pixel, dv = boundary.project(camera, every, R.flatten(0, 1), t.flatten(0, 1))
    return pixel.view(count, -1, 2), dv.view(count, -1)


def _paint(frames: Tensor, shapes: Shapes, boxes: Boxes, coverage: Tensor) -> Tensor:
    """Frames (B, H, W) with one layer of shapes over them."""
    _, height, width = frames.shape
    row, number = ragged_arange(boxes.size[:, 1])
    first = ((shapes.frame * height + boxes.corner[:, 1])[row] + number) * width + boxes.corner[row, 0]
    flat = frames.view(-1)
    # behind the end of its window a row covers nothing, so those cells may fall on any pixel
    index = first[:, None] + torch.arange(boxes.stride, device=first.device)
    index = index.clamp_(max=flat.numel() - 1).view(-1)
    level = shapes.level.float()[row, None]
    change = coverage * (level - flat.index_select(0, index).view_as(coverage))
    return boundary.accumulate(flat, index, change.view(-1)).view_as(frames)


def _ground(camera: Camera, t: Tensor, paper: Tensor, scene: Imaging) -> Tensor:
    """(B, 1, 1) or (B, H, W), what lies below all shapes."""
    surround = scene.surround
    if not isinstance(surround, Tensor) or surround.ndim != 3:
        return (paper if scene.plate is None else per_frame(surround, t))[:, None, None]
    if scene.plate is None:
        raise ConfigError("surround: background pictures need a plate before them; give its size")
    if surround.shape != (wanted := (len(t), camera.height, camera.width)):
        raise FrameError(f"surround: shape {tuple(surround.shape)} of the pictures is not {wanted}")
    return surround


def per_frame(value: Level, like: Tensor) -> Tensor:
    """(B,) tensor of a number or a (B,) tensor, of the dtype and device of ``like`` (B, ...)."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape[0])


def check_poses(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """R and t in float64, after a check of their shapes."""
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (R.shape[0], 3):
        raise FrameError(f"R, t: shapes {tuple(R.shape)} and {tuple(t.shape)} are not (B, 3, 3) and (B, 3)")
    return R.double(), t.double()

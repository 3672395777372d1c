"""Several copies of a target in one frame: a tray of equal parts."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.sim.renderer import render
from torchpose.sim.shapes import Shapes, rectangle, rings
from torchpose.target import Target


def render_tray(
    camera: Camera,
    target: Target,
    R: Float[Tensor, "K 3 3"],
    t: Float[Tensor, "K 3"],
    *,
    plate: tuple[float, float] | None = None,
    covers: Shapes | None = None,
    psf_sigma: float = 0.7,
) -> Float[Tensor, "H W"]:
    """A frame with K copies of a dark target on light plates, or without plates on light ground, in grey levels.

    Args:
        camera: the camera.
        target: what lies there K times.
        R: of the copies, target to camera.
        t: mm, the same.
        plate: width and height of each plate, mm. Plates must not overlap, and none may hide another.
        covers: shapes over everything, in camera coordinates (`shapes.moved`).
        psf_sigma: blur, px.
    """
    marks = Shapes.cat(
        [replace(moved(rings(target), *pose), level=_level(target, 30.0)) for pose in zip(R, t, strict=True)]
    )
    plates = None
    if plate is not None:
        blank = rectangle((0.0, 0.0), *plate, level=220.0)
        plates = Shapes.cat([moved(blank, *pose) for pose in zip(R, t, strict=True)])
    ground = 220.0 if plate is None else 90.0
    eye, here = torch.eye(3, dtype=t.dtype)[None], t.new_zeros(1, 3)
    return render(camera, marks, eye, here, psf_sigma=psf_sigma, light=ground, clutter=plates, covers=covers)[0]


def moved(shapes: Shapes, R: Float[Tensor, "3 3"], t: Float[Tensor, " 3"]) -> Shapes:
    """Shapes of one frame at ``R x + t``."""
    circles, sides = shapes.circles, shapes.sides
    return replace(
        shapes,
        center=shapes.center @ R.T + t,
        circles=replace(circles, center=circles.center @ R.T + t, axes=circles.axes @ R.T, bend=circles.bend @ R.T),
        sides=replace(sides, ends=sides.ends @ R.T + t),
    )


def _level(target: Target, grey: float) -> Tensor:
    return torch.full((len(target),), grey, dtype=torch.float64)

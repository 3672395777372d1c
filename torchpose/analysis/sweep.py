"""Errors over the working distance: the paper's equations, propagation and Monte-Carlo side by side (Fig. 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.analysis import equations
from torchpose.analysis.monte_carlo import simulate_points
from torchpose.analysis.sensitivity import ErrorBudget, Uncertainty, propagate
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.target import Target


@dataclass(frozen=True, eq=False)
class Swept:
    """Predicted errors of a target's pose at D distances on the optical axis."""

    distance: Float[Tensor, " D"]
    budget: ErrorBudget  # by source


@dataclass(frozen=True, eq=False)
class Sweep(Swept):
    """Errors of a target's pose at D distances on the optical axis; mm and rad, x y z and rotations about x y z.

    The focal length is wrong by its whole share in every one of N draws; in the budget, ``focal_length`` is the size of
    the effect of an error of exactly that share.
    """

    errors: Float[Tensor, "N D 6"]  # estimate minus truth
    lateral: Float[Tensor, " D"]  # size of eq. (3) for the distance between neighbouring markers
    depth: Float[Tensor, " D"]  # the same of eq. (2)
    depth_focal: Float[Tensor, " D"]  # the same of eq. (5)

    @property
    def largest(self) -> Float[Tensor, "D 6"]:
        """Largest error of the draws."""
        return self.errors.abs().amax(0)

    @property
    def rms(self) -> Float[Tensor, "D 6"]:
        """Root mean square of the draws."""
        return self.errors.square().mean(0).sqrt()


def sweep(
    camera: Camera,
    target: Target,
    distance: Tensor,
    uncertainty: Uncertainty,
    *,
    tilt: float = 0.0,
    draws: int = 200,
    seed: int = 0,
) -> Sweep:
    """Errors at the distances (D,), mm, the target's middle on the optical axis.

    Args:
        distance: (D,) mm.
        uncertainty: with one number for ``image``. Its ``focal_length`` is taken as an error of that very size, the
            true lens being the longer one.
        tilt: rad, about the x axis.
    """
    distance = distance.double()
    R, t = on_axis(target, distance, tilt)
    longer = camera.matrix.clone()
    longer[[0, 1], [0, 1]] *= 1 + uncertainty.focal_length
    true = replace(camera, matrix=longer)
    exact = replace(uncertainty, focal_length=0.0)
    errors = simulate_points(camera, target, R, t, exact, draws=draws, seed=seed, true_camera=true)
    f, near = float(camera.matrix[0, 0]), float(torch.pdist(target.centers).min())
    assert not isinstance(uncertainty.image, Tensor)
    return Sweep(
        distance=distance,
        budget=propagate(camera, target, R, t, uncertainty),
        errors=errors,
        lateral=uncertainty.image * equations.lateral_per_pixel(f, distance, 1.0),
        depth=uncertainty.image * equations.depth_per_pixel(near, f, distance, 1.0).abs(),
        depth_focal=equations.depth_focal_error(distance, 1.0, 1 + uncertainty.focal_length),
    )


def on_axis(target: Target, distance: Float[Tensor, " D"], tilt: float = 0.0) -> tuple[Tensor, Tensor]:
    """Poses (D, 3, 3), (D, 3) with the target's middle on the optical axis, tilted about x by so many rad."""
    R = rotations.exp(distance.new_tensor([tilt, 0.0, 0.0])).expand(len(distance), 3, 3)
    x, y, _ = (R @ target.centers.mean(0)).unbind(-1)
    return R, torch.stack([-x, -y, distance], -1)


def sweep_rings(
    camera: Camera, target: Target, distance: Tensor, uncertainty: Uncertainty, *, tilt: float = 0.0
) -> Swept:
    """The same as `sweep` of poses fitted to the edges of the rings, predicted alone; ``image`` is of such edges."""
    distance = distance.double()
    return Swept(distance, propagate(camera, target, *on_axis(target, distance, tilt), uncertainty, features="rings"))


def fit(distance: Tensor, value: Tensor, powers: Sequence[int]) -> Tensor:
    """Values (D,) of the least-squares polynomial in the distance with the given powers."""
    columns = torch.stack([(distance / distance.max()) ** power for power in powers], -1)
    return columns @ torch.linalg.lstsq(columns, value[:, None]).solution[:, 0]

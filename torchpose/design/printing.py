"""How a target is made, what its print is then off by, and what is left of that once a camera has measured it."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.analysis.joint import POSE, marker_columns, print_numbers
from torchpose.camera import Camera
from torchpose.design.predict import Imaging, marker_information
from torchpose.design.volume import WorkingVolume
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.identify.scene import MOST_GAIN
from torchpose.target import Target

# of `torchpose calibrate --measure-target`, as docs/calibration.md asks for them: so many views, so far tilted
MEASURING_VIEWS = 28
MEASURING_TILT = math.radians(30)


@dataclass(frozen=True)
class PrintClass:
    """Standard deviations of a print, mm.

    Attributes:
        places: of a marker's centre in the plane, each axis.
        gain: of the edge gain, common to all edges of a print.
        flatness: of a marker along the normal of the plate; the same as ``places`` where not given.

    Raises:
        ConfigError: one of them is negative or not finite.
    """

    places: float
    gain: float
    flatness: float | None = None

    def __post_init__(self) -> None:
        if not all(0 <= value < math.inf for value in (self.places, self.gain, self.flatness or 0.0)):
            raise ConfigError(f"print: {self.told}; give standard deviations from 0")

    @property
    def most_gain(self) -> float:
        """Up to which codes are read, mm."""
        return MOST_GAIN * self.gain

    @property
    def told(self) -> str:
        flat = "" if self.flatness is None else f" ({1e3 * self.flatness:g} um out of flat)"
        return f"places off by {1e3 * self.places:g} um{flat}, edges by {1e3 * self.gain:g} um"

    def stated_by(self, target: Target) -> Target:
        """The target with these deviations in its file."""
        flat = self.places if self.flatness is None else self.flatness
        each = target.centers.new_tensor([self.places, self.places, flat]).repeat(len(target))
        covariance = torch.diag(torch.cat([each, each.new_tensor([self.gain])]).square())
        return replace(target, covariance=covariance, adjustment=None, cross_covariance=None)


# places: the issue of office laser printers off by 50 to 100 um, photo plotters by 10, chrome on glass by 1, as
# photogrammetry has them; gain: of office prints 60 um are ordinary, the other two stand for one or two steps of the
# plotter's raster (conventions all: measure your own print)
PRINTS = {
    "glass": PrintClass(0.001, 0.001),
    "plotter": PrintClass(0.010, 0.015),
    "laser": PrintClass(0.070, 0.060),
}


@checked
def print_of(text: str) -> PrintClass:
    """A print class by its name, or by its numbers ``PLACES,GAIN`` or ``PLACES,GAIN,FLATNESS`` in um.

    Raises:
        ConfigError: neither.
    """
    if text in PRINTS:
        return PRINTS[text]
    try:
        values = [float(word) / 1e3 for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise ConfigError(f"print: {text!r} is none of {', '.join(PRINTS)}, nor PLACES,GAIN in um such as 20,15")
    return PrintClass(*values)


@checked
def measured(camera: Camera, target: Target, volume: WorkingVolume, imaging: Imaging) -> Target:
    """The target as `torchpose calibrate --measure-target` would leave it, with the covariance of places and gain.

    `MEASURING_VIEWS` views from the middle of the volume, tilted in all directions, tell of them what is left when each
    view has a pose of its own, and every ring its turn; what no view tells stays as the file states it. The frame is
    the one that fits the places of the file best, so shift, turn and scale have no part: a millimetre is that of the
    file (`scale_deviation`). The camera is taken as known.
    """
    target = replace(target, adjustment=None, cross_covariance=None)
    z = float(volume.middle[1][0, 2])
    poses = volume.poses(distances=[z], tilts=[MEASURING_TILT], azimuths=MEASURING_VIEWS)
    R, t = (part.to(camera.matrix) for part in poses)
    columns = marker_columns(target, camera, R)
    information = marker_information(camera, target, R, t, imaging)
    matrix = (columns.mT @ information @ columns).sum(1)
    inverse, _ = scaled_inverse(matrix[:, :POSE, :POSE])
    told = matrix[:, POSE:, POSE:] - matrix[:, POSE:, :POSE] @ inverse @ matrix[:, :POSE, POSE:]
    told = 0.5 * (told + told.mT).sum(0)
    told.diagonal().add_(1)  # what the file states
    root = torch.linalg.cholesky(told)
    # as a square, which no rounding makes negative: what is left may be 1e-5 of what the file states
    numbers = print_numbers(target, camera)[0]
    factor = _inner(target.centers) @ torch.cat([numbers[:, :3].flatten(0, 1), numbers[0, 6:]])
    left = torch.linalg.solve_triangular(root, factor.mT, upper=False)
    return replace(target, covariance=left.mT @ left)


@checked
def scale_deviation(target: Target) -> float:
    """Relative standard deviation of the scale in which the places of a print fit those of its file best."""
    assert target.covariance is not None
    arm = (target.centers - target.centers.mean(0)).flatten()
    return float((arm @ target.covariance[:-1, :-1] @ arm).sqrt() / arm.square().sum())


def _inner(places: Float[Tensor, "M 3"]) -> Float[Tensor, "D D"]:
    """Projection of places and edge gain (3 M + 1) onto what shift, turn and scale of the frame do not change."""
    arm = places - places.mean(0)
    eye = torch.eye(3, dtype=places.dtype, device=places.device).expand(len(places), 3, 3)
    frame = torch.cat([eye, -rotations.skew(arm), arm[..., None]], -1).flatten(0, 1)
    axes = torch.nn.functional.pad(torch.linalg.qr(frame).Q, (0, 0, 0, 1))
    return torch.eye(len(axes), dtype=places.dtype, device=places.device) - axes @ axes.mT

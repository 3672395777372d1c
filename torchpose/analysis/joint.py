"""The weights of an estimator that takes what a target file states of its print for further unknowns.

As `torchpose.pose.systematic` does with frames, here for poses of which nothing was measured yet.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.identify import MarkerTable
from torchpose.pose import displaced
from torchpose.target import Target

POSE = 6
# px of an edge averaged over 1 px: noise-free frames are rounded at least, and edges known exactly would leave the
# print without any prior (convention, a hundredth of `sensitivity.edge_noise` at ordinary noise)
_LEAST_NOISE = 1e-4


def print_numbers(target: Target, camera: Camera) -> tuple[Float[Tensor, "M 7 L"], Float[Tensor, "M 7 C"]]:
    """How places (mm), turns (rad, target frame) and edge gain (mm) vary with numbers of unit variance, by the files.

    With L numbers of the print's own, and with the C of a camera that was calibrated together with the target.
    """
    table = MarkerTable.of([target], camera)
    return table.by_print[0].to(target.centers), table.by_camera[0].to(target.centers)


def grown(target: Target) -> Float[Tensor, " 2"]:
    """By which outer and inner radius change with the edge gain: dark areas grow."""
    return target.radii.new_tensor([1.0, -1.0] if target.background == "light" else [-1.0, 1.0])


def marker_columns(target: Target, camera: Camera, R: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B M 7 k"]:
    """How pose (6) and the numbers of the print move each marker, as a pose of its own, and its edges."""
    own = torch.eye(POSE + 1, dtype=R.dtype, device=R.device)[:, :POSE].expand(len(R), len(target), -1, -1)
    return torch.cat([own, displaced(R, target.centers @ R.mT, print_numbers(target, camera)[0])], -1)


def joint_inverse(
    information: Float[Tensor, "B M 7 7"], columns: Float[Tensor, "B M 7 k"], variance: float = 1.0
) -> tuple[Float[Tensor, "B k k"], Bool[Tensor, " B"]]:
    """Inverse of the normal equations of pose and print, times 1 / ``variance``, and whether they determine a pose.

    Args:
        information: what each marker tells of a pose of its own and of its edge gain, at noise of unit variance.
        columns: of `marker_columns`.
        variance: of the noise. It counts beside the prior of the print alone.
    """
    matrix = (columns.mT @ information @ columns).sum(1)
    matrix.diagonal(dim1=-2, dim2=-1)[:, POSE:] += max(variance, _LEAST_NOISE**2)
    return scaled_inverse(matrix)

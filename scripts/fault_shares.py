"""How much of a fault that displaces the picture no residual can show, because the pose follows it.

    python scripts/fault_shares.py --frames 60

The displacements of haze, jittering lines and vibration are known in simulated frames. Along all rims of quad40, as in
wrong_model_statistics.py, they are taken across the edge and weighed by its length, as the fit of grey values does, and
split by least squares. A line a fault, medians of the frames: shares of the sum of squares in the six columns of the
pose, in motions of single markers and gain beside them (which residuals show), and in what is left along the rims; then
the mean square of the pose's part over that of the markers' part, each by its number of unknowns.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import torch
from precision_statistics import F64, HEIGHT, TARGET, WIDTH, camera_of, tilted
from torch import Tensor

from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.sim.fields import keys_of, smooth_field
from torchpose.sim.sensor import normal_deviates

SEED = 1
RIM_POINTS = 192
Field = Callable[[int, Tensor], Tensor]
"""Displacement (..., 2) in px of a frame by its number at pixels (..., 2)."""


def haze(frame: int, pixel: Tensor) -> Tensor:
    """0.1 px RMS, correlated over 40 px."""
    keys = (keys_of(1, SEED, name, torch.tensor([frame])) for name in ("air-u", "air-v"))
    field = torch.cat([smooth_field(key, (HEIGHT, WIDTH), 40.0) for key in keys])
    place = 2 * pixel / torch.tensor([WIDTH - 1, HEIGHT - 1]) - 1
    found = torch.nn.functional.grid_sample(field[None].double(), place.reshape(1, 1, -1, 2), align_corners=True)
    return 0.1 * found[0, :, 0].T.reshape(pixel.shape)


def line_jitter(frame: int, pixel: Tensor) -> Tensor:
    """0.1 px of every line."""
    lines = normal_deviates(keys_of(1, SEED, "lines", torch.tensor([frame])), HEIGHT)[0].double()
    along = 0.1 * lines[pixel[..., 1].round().long().clamp(0, HEIGHT - 1)]
    return torch.stack([along, torch.zeros_like(along)], -1)


def vibration(frame: int, pixel: Tensor) -> Tensor:
    """1 px, a wave of 251 lines."""
    along = (pixel[..., 1] / 40).sin()
    return torch.stack([along, torch.zeros_like(along)], -1)


FIELDS: dict[str, Field] = {"haze": haze, "line-jitter": line_jitter, "vibration": vibration}


def rims(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels (M, 2, P, 2) all along both rims of the markers, the edges' normals there, and, weighed by length, the
    derivatives across the edge by the pose (M, 2, P, 6) and by dot gain (M, 2, P, 1).
    """
    angle = torch.arange(RIM_POINTS, dtype=F64) * (2 * math.pi / RIM_POINTS)
    zero = torch.zeros_like(angle)
    outward = torch.stack([angle.cos(), angle.sin(), zero], -1) @ R.mT
    along = TARGET.radii[..., None, None] * (torch.stack([-angle.sin(), angle.cos(), zero], -1) @ R.mT)
    arm = (TARGET.centers @ R.mT)[:, None, None] + TARGET.radii[..., None, None] * outward
    at = arm + t
    matrix = camera_of(0.0).matrix
    xy = at[..., :2] / at[..., 2:]
    by_point = matrix.diagonal()[:2, None] * image_by_point(xy, at[..., 2])
    tangent = (by_point @ along[..., None])[..., 0]
    length = tangent.norm(dim=-1, keepdim=True)
    normal = torch.stack([tangent[..., 1], -tangent[..., 0]], -1) / length
    grows = outward * torch.tensor([1.0, -1.0], dtype=F64)[:, None, None]
    columns = torch.cat([by_pose(by_point, arm), by_point @ grows[..., None]], -1)
    across = length.sqrt() * (normal[..., None, :] @ columns)[..., 0, :]
    return xy * matrix.diagonal()[:2] + matrix[:2, 2], length.sqrt() * normal, across[..., :6], across[..., 6:]


def basis(columns: Tensor) -> Tensor:
    """An orthonormal basis (N, r) of what columns (N, k) span."""
    u, s, _ = torch.linalg.svd(columns / columns.norm(dim=0), full_matrices=False)
    return u[:, s > 1e-7 * s[0]]


def shares(field: Field, frame: int, R: Tensor, t: Tensor) -> list[float]:
    """Of one frame: pose, motions of markers, the rest; the pose's mean square over the markers'."""
    pixel, normal, pose, gain = rims(R, t)
    moved = (normal * field(frame, pixel)).sum(-1).flatten()
    own = torch.block_diag(*pose.flatten(1, 2))
    by_pose_, all_motions = basis(pose.flatten(0, 2)), basis(torch.cat([own, gain.flatten()[:, None]], -1))
    total, of_pose, of_all = (float(v.square().sum()) for v in (moved, by_pose_.mT @ moved, all_motions.mT @ moved))
    beside = of_all - of_pose
    ratio = (of_pose / by_pose_.shape[1]) / (beside / (all_motions.shape[1] - by_pose_.shape[1]))
    return [of_pose / total, beside / total, 1 - of_all / total, ratio]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    R, t = tilted(40)(options.frames, torch.Generator().manual_seed(SEED))
    print("| case | pose | motions of markers | along the rims | pose over motions, per number |")
    print("| --- | --- | --- | --- | --- |")
    for name, field in FIELDS.items():
        each = torch.tensor([shares(field, k, R[k], t[k]) for k in range(options.frames)], dtype=F64)
        *parts, ratio = each.median(0).values.tolist()
        print(f"| {name} | " + " | ".join(f"{100 * part:.0f} %" for part in parts) + f" | {ratio:.1f} |", flush=True)


if __name__ == "__main__":
    main()

"""Which part of the board a patch of marks is: by its outline, and by where marks are missing although in view."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import conv2d, pad

from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.grids.board import Grid
from torchpose.grids.lattice import Lattice

LEAST_MARKS = 6  # of a patch: 12 numbers for the 8 of a plane's image
_MOST_PLACES = 64  # of a patch on the board that are looked at, those with the most marks first
# the same of the board turned, where only marks that it lacks by design tell: one of these makes two (derived), and one
# stray shape, or one mark not found, a tie
_TURNED = 2
_MARGIN = 3  # marks that the second best place must explain less: one stray shape does not shift a board
_CLEAR = 0.6  # of the lattice's spacing, from the border: a mark beyond may be cut off
_TURNS = torch.tensor([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])


def place_patches(
    found: Lattice, centers: Float[Tensor, "K 2"], grid: Grid, size: tuple[int, int], frames: int
) -> tuple[Int[Tensor, " K"], Bool[Tensor, " B"]]:
    """Number of each mark on the board, -1 where it has none or its patch may be several parts of the board.

    A place of a patch on the board is worth the marks that it explains less those that it should show and does not.
    Of places that a symmetry of the board makes equal the one counts whose rows point most to the right in the frame.
    Also whether that decided, by frame.

    Args:
        found: patches of all frames.
        centers: of its marks, px.
        grid: the board.
        size: width and height of the frames, px.
        frames: how many there are.
    """
    if len(found) == 0:
        return found.mark, torch.zeros(frames, dtype=torch.bool, device=found.mark.device)
    every = _turned(found, frames)
    occupied = _occupied(every, found.frame, frames)
    count, offset = _overlaps(occupied, grid)
    image = _plane_images(found, centers, frames)
    worth = (count - _missing(occupied, every.low, offset, grid, (image, size))).double()
    two = worth.topk(min(2, worth.shape[-1]), dim=-1).values
    best, second = two[..., 0], two[..., -1]  # (B, 4)
    most = best.max(1, keepdim=True).values
    middle = segment_mean(found.at.double(), found.frame, frames)
    equal = best > most - _TURNED
    turn = _rightward(image, middle, grid).masked_fill(~equal, -torch.inf).argmax(1)
    row = torch.arange(frames, device=turn.device)
    other = ~grid.symmetries.to(turn.device)[(torch.arange(4, device=turn.device) - turn[:, None]) % 4]
    rival = torch.maximum(best.masked_fill(~other, -torch.inf).max(1).values, second[row, turn])
    sure = (torch.bincount(found.frame, minlength=frames) >= LEAST_MARKS) & (most[:, 0] - rival >= _MARGIN)
    shift = offset[row, turn, worth[row, turn].argmax(-1)]
    at = every.at[turn[found.frame], torch.arange(len(found), device=turn.device)] + shift[found.frame]
    numbers = pad(grid.map.to(at.device), (1, 1, 1, 1), value=-1)
    limit = torch.tensor(numbers.shape[::-1], device=at.device) - 1
    at = (at + 1).clamp_min(0).minimum(limit)
    return torch.where(sure[found.frame], numbers[at[:, 1], at[:, 0]], -1), equal.sum(1) > 1


class _Turned(NamedTuple):
    """at: places (4, K, 2) of all marks after each quarter turn, from 0 in every frame.

    low: what was taken off, (B, 4, 2).
    """

    at: Tensor
    low: Tensor


def _turned(found: Lattice, frames: int) -> _Turned:
    at = (_TURNS.to(found.at)[:, None] @ found.at[..., None])[..., 0]
    low = at.new_full((frames, 4, 2), 2**31)
    low.scatter_reduce_(0, found.frame[:, None, None].expand(-1, 4, 2), at.transpose(0, 1), "amin")
    return _Turned(at - low[found.frame].transpose(0, 1), low)


def _occupied(every: _Turned, frame: Tensor, frames: int) -> Tensor:
    """Where there is a mark: (B, 4, side, side) bool, second place first."""
    side = int(every.at.amax()) + 1
    occupied = torch.zeros(frames, 4, side, side, dtype=torch.bool, device=frame.device)
    turn = torch.arange(4, device=frame.device)[:, None].expand(-1, len(frame))
    occupied[frame.expand(4, -1), turn, every.at[..., 1], every.at[..., 0]] = True
    return occupied


def _overlaps(occupied: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """The likeliest offsets (B, 4, Q, 2) of patches on the board, and their marks (B, 4, Q) that are on it."""
    side = occupied.shape[-1]
    board = pad((grid.map >= 0).float().to(occupied.device), [side - 1] * 4)
    sums = conv2d(board[None, None], occupied.flatten(0, 1)[:, None].float())[0]
    count, flat = sums.flatten(1).topk(min(_MOST_PLACES, sums[0].numel()), dim=-1)
    offset = torch.stack([flat % sums.shape[-1], flat // sums.shape[-1]], -1) - (side - 1)
    shape = (*occupied.shape[:2], -1)
    return count.round().long().view(shape), offset.view(*shape, 2)


def _missing(
    occupied: Tensor, low: Tensor, offset: Tensor, grid: Grid, seen_by: tuple[Tensor, tuple[int, int]]
) -> Tensor:
    """Marks (B, 4, Q) of the board that patches at these offsets do not have, though the frame should show them.

    ``seen_by``: image (B, 3, 3) of the lattice, and the frames' size.
    """
    image, (width, height) = seen_by
    there = (grid.map.mT >= 0).nonzero()
    at = there.to(offset.device) - offset[..., None, :]  # (B, 4, Q, P, 2), in the turned patch
    side = occupied.shape[-1]
    inside = ((at >= 0) & (at < side)).all(-1)
    held = at.clamp(0, side - 1)
    batch, turns = (torch.arange(n, device=at.device) for n in occupied.shape[:2])
    there = occupied[batch[:, None, None, None], turns[:, None, None], held[..., 1], held[..., 0]] & inside
    back = _TURNS.to(at).mT[:, None, None]  # (4, 1, 1, 2, 2)
    own = (back @ (at + low[:, :, None, None])[..., None])[..., 0].double()
    flat = image[:, None, None, None]
    pixels, depth, spacing = _imaged(flat, own)
    margin = (_CLEAR * spacing)[..., None]
    limit = pixels.new_tensor([width - 1, height - 1])
    in_view = ((pixels > margin) & (pixels < limit - margin)).all(-1) & (depth > 0)
    return (in_view & ~there).sum(-1)


def _imaged(image: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels of places (..., 2), their depths (positive in front), and the lattice's spacing there, px."""
    full = torch.cat([at, torch.ones_like(at[..., :1])], -1)
    mapped = (image @ full[..., None])[..., 0]
    depth = mapped[..., 2]
    pixels = mapped[..., :2] / depth[..., None]
    spacing = (image.det().abs() / depth.abs().pow(3)).sqrt()  # root of the area of the map
    return pixels, depth, spacing


def _plane_images(found: Lattice, centers: Tensor, frames: int) -> Tensor:
    """Homographies (B, 3, 3) from places to pixels, by least squares; the depth is positive at the marks."""

    def scaled(values: Tensor) -> tuple[Tensor, Tensor]:
        middle = segment_mean(values, found.frame, frames)
        size = segment_mean((values - middle[found.frame]).square().sum(-1), found.frame, frames).sqrt().clamp_min(1e-9)
        to = torch.diag_embed(torch.stack([1 / size, 1 / size, torch.ones_like(size)], -1))
        to[:, :2, 2] = -middle / size[:, None]
        return (values - middle[found.frame]) / size[found.frame, None], to

    at, to_at = scaled(found.at.double())
    px, to_px = scaled(centers)
    full = torch.cat([at, torch.ones_like(at[:, :1])], -1)
    none = torch.zeros_like(full)
    rows = torch.stack(
        [torch.cat([full, none, -px[:, :1] * full], -1), torch.cat([none, full, -px[:, 1:] * full], -1)], 1
    )
    normal = segment_sum(rows.mT @ rows, found.frame, frames)
    image = torch.linalg.eigh(normal.nan_to_num(nan=0.0))[1][:, :, 0].unflatten(-1, (3, 3))
    front = segment_sum((image[found.frame, 2] * full).sum(-1), found.frame, frames)
    image = image * torch.where(front < 0, -1.0, 1.0)[:, None, None]
    sound = to_px.isfinite().all(-1).all(-1)[:, None, None]
    eye = torch.eye(3, dtype=image.dtype, device=image.device)
    return torch.where(sound, torch.linalg.inv(torch.where(sound, to_px, eye)) @ image @ to_at.nan_to_num(nan=0.0), eye)


def _rightward(image: Tensor, middle: Tensor, grid: Grid) -> Tensor:
    """How far rows point to the right in the middle (B, 2) of the patches, after each quarter turn: (B, 4)."""
    row = grid.lattice[1] - grid.lattice[0]  # from the first mark to the next
    back = (_TURNS.mT @ row).double().to(image.device)
    ends = torch.stack([middle[:, None] - 0.5 * back, middle[:, None] + 0.5 * back])
    first, last = _imaged(image[:, None], ends)[0]
    return (last - first)[..., 0] / torch.linalg.vector_norm(last - first, dim=-1)

"""Level-line regions: connected pixels of strong gradient whose directions agree, over all frames of a batch at once.

The region growing of ELSDc (Patraucean, Gurdjos, Grompone von Gioi 2017) visits one seed after the other. Here its
criterion, agreement of neighbouring level-line angles, becomes the edge set of a graph over all strong pixels, whose
connected components are found by parallel min-hooking and pointer jumping (Shiloach and Vishkin 1982).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.geometry.segments import segment_sum

_JOIN_COS = 0.8  # neighbours join within 37 degrees: a circle of 3 px turns 19 to 27 degrees from pixel to pixel
_NOISE_SIGMAS = 3.7  # of the gradient: one pure-noise pixel in a thousand stays
_RANGE_FRACTION = 0.01  # of the frame's own range of grey, for frames without noise
_LEAST_LEVEL = 1.5  # grey levels, above the flicker of quantisation
_NOISE_SAMPLES = 10_000
_PART_PIXELS = 6_000_000  # of the frames whose gradients are formed at a time


@dataclass(frozen=True, eq=False)
class Gradient:
    """2 x 2 gradient of (B, h, w) frames, formed where it is asked for; cell (x, y) is centred at (x + 0.5, y + 0.5).

    Attributes:
        frames: (B, h, w) uint8 or float32, contiguous.
        threshold: (B,) float32, magnitude that pure white noise exceeds in one cell of a thousand at most.
    """

    frames: Tensor
    threshold: Tensor

    @property
    def shape(self) -> torch.Size:
        """(B, h, w)."""
        return self.frames.shape

    def at(self, cells: Tensor) -> Tensor:
        """Gradients (..., 2) gx, gy at flat cell indices (...); zero in the last row and column and at NaN pixels."""
        _, height, width = self.shape
        flat = self.frames.view(-1)
        x, y = cells % width, (cells // width) % height
        inside = (x < width - 1) & (y < height - 1)
        first = torch.where(inside, cells, 0)
        right, below = torch.where(inside, cells + 1, 0), torch.where(inside, cells + width, 0)
        diag = flat[torch.where(inside, cells + width + 1, 0)].float() - flat[first].float()
        anti = flat[right].float() - flat[below].float()
        g = torch.stack([0.5 * (diag + anti), 0.5 * (diag - anti)], -1)
        return torch.where(g.isfinite().all(-1, keepdim=True), g, 0.0)


@dataclass(frozen=True, eq=False)
class Regions:
    """Pixels of the regions, flat.

    Attributes:
        cell: (P,) int64, flat index into (B, h, w). region: (P,) int64 in [0, count).
        gradient: (P, 2) float32. frame: (count,) int64, the frame of each region.
    """

    cell: Tensor
    region: Tensor
    gradient: Tensor
    frame: Tensor


def gradient(frames: Tensor) -> Gradient:
    """Gradient and noise threshold of frames (B, h, w), uint8 or float32 in grey levels (0..255 or more).

    The noise is estimated from the median squared gradient of a sample of the cells, which edges hardly touch; pixels
    that are NaN or infinite do not count.
    """
    batch, height, width = frames.shape
    frames = frames.contiguous()
    if frames.numel() == 0 or min(height, width) < 2:
        return Gradient(frames, torch.full((batch,), _LEAST_LEVEL, device=frames.device))
    step = max(1, math.isqrt(height * width // _NOISE_SAMPLES))
    a, b, c, d = (
        frames[:, y : height - 1 + y : step, x : width - 1 + x : step].float() for y in (0, 1) for x in (0, 1)
    )
    # |gradient|^2 is sigma^2 chi^2_2, whose median is 2 ln 2 sigma^2
    power = (0.5 * ((d - a).square() + (b - c).square())).flatten(1).nan_to_num(nan=0.0)
    sigma = (power.median(-1).values / (2 * math.log(2))).sqrt()
    grey = a.flatten(1)
    finite = grey.isfinite()
    low, high = grey.where(finite, torch.inf).amin(-1), grey.where(finite, -torch.inf).amax(-1)
    threshold = torch.maximum(_NOISE_SIGMAS * sigma, _RANGE_FRACTION * (high - low)).clamp_min(_LEAST_LEVEL)
    return Gradient(frames, threshold)


def strong_cells(grad: Gradient) -> Tensor:
    """Flat indices (P,) int64, rising, of the cells whose gradient is above their frame's threshold.

    The dense pass is taken over a few frames at a time: what fits the cache is not fetched twice, and the memory of one
    part serves the next.
    """
    batch, height, width = grad.shape
    if grad.frames.numel() == 0 or min(height, width) < 2:
        return torch.zeros(0, dtype=torch.int64, device=grad.frames.device)
    some = max(1, _PART_PIXELS // (height * width))
    found = []
    for start in range(0, batch, some):
        part = slice(start, start + some)
        found.append(_steep(grad.frames[part], grad.threshold[part]) + start * height * width)
    cell = torch.cat(found)
    strength = torch.linalg.vector_norm(grad.at(cell), dim=-1)
    return cell[strength > grad.threshold[cell // (height * width)]]


def _steep(frames: Tensor, threshold: Tensor) -> Tensor:
    """Flat cells with a diagonal difference above the threshold, among which are all whose gradient is.

    |gradient|^2 is half the sum of the squares of both diagonal differences. On the CPU these go through OpenCV, the
    batch as one tall picture: what the last row of a frame shares with the next is no cell of its gradient.
    """
    batch, height, width = frames.shape
    if frames.device.type == "cpu":
        tall = frames.view(batch * height, width).numpy()
        limit = threshold.numpy()
        if tall.dtype == np.uint8:  # whole levels: above the threshold is above its whole part, and bytes are quick
            limit = limit.clip(0, 255).astype(np.uint8)
        differ = np.zeros_like(tall)
        cv2.absdiff(tall[1:, 1:], tall[:-1, :-1], differ[:-1, :-1])
        cv2.max(differ[:-1, :-1], cv2.absdiff(tall[:-1, 1:], tall[1:, :-1]), differ[:-1, :-1])
        above = differ.reshape(batch, height, width) > limit[:, None, None]
        return torch.from_numpy(np.flatnonzero(above))
    frames = frames.float()
    steep = torch.zeros_like(frames)
    diagonals = (frames[:, 1:, 1:] - frames[:, :-1, :-1]).abs(), (frames[:, :-1, 1:] - frames[:, 1:, :-1]).abs()
    steep[:, :-1, :-1] = torch.maximum(*diagonals)
    return (steep > threshold[:, None, None]).flatten().nonzero()[:, 0]


def level_line_regions(grad: Gradient, cell: Tensor, min_pixels: int, sectors: int = 0, phase: float = 0.0) -> Regions:
    """Connected components of cells with agreeing gradient directions, of at least ``min_pixels``.

    Args:
        cell: (P,) int64, flat indices of the cells to join, rising.
        sectors: 0 joins neighbours whose directions are close to each other, so that whole curves hold together. With
            n sectors neighbours join if their directions fall into the same n-th of the circle: curves break into arcs
            of known turn, and corners part from what they join. phase: fraction of a sector that the first starts at.
    """
    _, height, width = grad.shape
    g = grad.at(cell)
    unit = g / torch.linalg.vector_norm(g, dim=-1, keepdim=True)
    a, b = _neighbours(cell, width)
    if sectors:
        sector = ((torch.atan2(g[:, 1], g[:, 0]) / (2 * math.pi) + 1) * sectors + phase).long() % sectors
        agree = sector[a] == sector[b]
    else:
        agree = (unit[a] * unit[b]).sum(-1) > _JOIN_COS
    label = connected_components(a[agree], b[agree], cell.numel())

    size = torch.bincount(label, minlength=cell.numel())
    large = size >= min_pixels
    number = large.cumsum(0) - 1
    keep = large[label]
    region = number[label[keep]]
    frame = large.nonzero()[:, 0]
    return Regions(cell[keep], region, g[keep], cell[frame] // (height * width))


def _neighbours(cell: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Pairs of positions in ``cell`` (P,), rising, that are neighbours, by 8-connectivity; each once.

    The three neighbours below a cell follow each other in the list, wherever they begin: no table of all cells is
    needed. The last row and column hold no cell, so that an index that wraps around meets none.
    """
    padded = torch.nn.functional.pad(cell, (0, 3), value=torch.iinfo(cell.dtype).max)
    below = torch.searchsorted(cell, cell + (width - 1))
    at = torch.arange(cell.numel(), device=cell.device)
    pairs = [(at, at + 1, 1, 1), *((at, below + k, width - 1, width + 1) for k in range(3))]
    found = []
    for first, second, least, most in pairs:
        step = padded[second] - cell
        index = ((step >= least) & (step <= most)).nonzero()[:, 0]
        found.append(torch.stack([first[index], second[index]]))
    a, b = torch.cat(found, 1)
    return a, b


def connected_components(a: Tensor, b: Tensor, count: int) -> Tensor:
    """Smallest member (count,) int64 of each node's component in the graph with edges (a_i, b_i)."""
    parent = torch.arange(count, device=a.device)
    while a.numel():
        first, second = parent[a], parent[b]
        low = torch.minimum(first, second)
        parent = parent.scatter_reduce(0, first, low, "amin").scatter_reduce_(0, second, low, "amin")
        while not torch.equal(shorter := parent[parent], parent):
            parent = shorter
        apart = (parent[a] != parent[b]).nonzero()[:, 0]  # what is joined stays so
        a, b = a[apart], b[apart]
    return parent


def region_polarity(regions: Regions, center: Tensor, cells_xy: Tensor) -> Tensor:
    """Mean cosine (count,) of the gradient with the way out of ``center`` (count, 2): +1 dark inside, -1 light."""
    count = center.shape[0]
    out = cells_xy - center[regions.region]
    cos = (out * regions.gradient).sum(-1) / (
        torch.linalg.vector_norm(out, dim=-1) * torch.linalg.vector_norm(regions.gradient, dim=-1)
    )
    size = segment_sum(torch.ones_like(cos), regions.region, count)
    return segment_sum(cos.nan_to_num(nan=0.0), regions.region, count) / size

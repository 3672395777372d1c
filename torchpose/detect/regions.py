"""Level-line regions: connected pixels of strong gradient whose directions agree, over all frames of a batch at once.

The region growing of ELSDc (Patraucean, Gurdjos, Grompone von Gioi 2017) visits one seed after the other. Here its
criterion, agreement of neighbouring level-line angles, becomes the edge set of a graph over all strong pixels, whose
connected components are found by parallel min-hooking and pointer jumping (Shiloach and Vishkin 1982).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from torchpose.geometry.constants import finite, numbers
from torchpose.geometry.rows import Rows, replace, shared
from torchpose.geometry.segments import positions, segment_sum

# Gradients agree, with each other or with the normal of a curve, within 37 degrees: a circle of 3 px turns by 19 to 27
# degrees from pixel to pixel (derived). Not 0.8, which whole levels reach exactly, as (3, 4) beside (0, 5): rounding
# would decide.
AGREE_COS = 0.8001
ON_EDGE = 1.5  # cells from a curve: an edge is two to three cells wide (derived: two of the gradient, one of blur)
BESIDE = 2 * ON_EDGE  # cells from a curve: farther off is another edge (derived)
MIN_CELLS = 10  # of a region; the edge of the least circle that is looked for has some 25 (convention)
SECTORS, PHASE = 8, 0.5  # pieces turn by 45 degrees; sectors about axes and diagonals survive mirroring (derived)
MOST_A_FRAME = 200  # arcs and small places, the largest: natural pictures have hundreds of both (convention)
_NOISE_SIGMAS = 3.7  # of the gradient: one pure-noise pixel in a thousand stays
_RANGE_FRACTION = 0.01  # of the frame's own range of grey, for frames without noise
_LEAST_LEVEL = 1.5  # grey levels, above the flicker of quantisation
_NOISE_SAMPLES = 10_000
# cells of frames for each strong one, below which a table of all is quicker than a search (measured: decisions/0056)
_DENSE = 16  # cells of frames for each strong one, below which a table of all is quicker than a search (convention)
_PART_PIXELS = 300_000  # of the frames whose gradients are formed at a time


@dataclass(frozen=True, eq=False)
class Gradient(Rows):
    """2 x 2 gradient of frames, formed where it is asked for; cell (x, y) is centred at (x + 0.5, y + 0.5)."""

    frames: Real[Tensor, "B h w"]  # uint8 or float32, contiguous
    threshold: Float[Tensor, " B"]  # magnitude that pure white noise exceeds in one cell of a thousand at most

    @property
    def shape(self) -> torch.Size:
        """(B, h, w)."""
        return self.frames.shape

    def components(self, cells: Int[Tensor, " P"]) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Gradients gx, gy at flat cells, which are not of the last row or column of a frame; zero at NaN pixels."""
        flat, width = self.frames.view(-1), self.shape[2]
        # index_select of single numbers: advanced indexing, or rows of two, cost several times as much
        a, b, c, d = (flat.index_select(0, cells + step).float() for step in (0, 1, width, width + 1))
        diag, anti = d.sub_(a), b.sub_(c)
        gx, gy = (diag + anti).mul_(0.5), (diag - anti).mul_(0.5)
        if not self.whole:
            bad = ~numbers(gx + gy)
            gx, gy = gx.masked_fill_(bad, 0.0), gy.masked_fill_(bad, 0.0)
        return gx, gy

    @cached_property
    def whole(self) -> bool:
        """Whether every pixel is a number."""
        return not self.frames.is_floating_point() or bool(finite(self.frames, (0, 1, 2)))

    def centers(self, cells: Int[Tensor, " P"]) -> Float[Tensor, "P 2"]:
        """Positions of flat cells in reduced px."""
        return (torch.stack(self.grid(cells)).double() + 0.5).mT

    def frame(self, cells: Int[Tensor, " P"]) -> Int[Tensor, " P"]:
        """The frames of flat cells."""
        return torch.div(cells, self.shape[1] * self.shape[2], rounding_mode="floor")

    def grid(self, cells: Int[Tensor, " P"]) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Columns and rows of flat cells in their frames."""
        _, height, width = self.shape
        row = torch.div(cells, width, rounding_mode="floor")
        return cells - row * width, row % height


@dataclass(frozen=True, eq=False)
class Regions(Rows):
    """Cells of R regions, one region after the other, the cells of each rising."""

    cell: Int[Tensor, " P"]  # flat index into (B, h, w)
    region: Int[Tensor, " P"]
    gradient: Float[Tensor, "P 2"]
    frame: Int[Tensor, " R"] = shared()  # of each region

    def of(self, some: Bool[Tensor, " R"]) -> "Regions":
        """Some of the regions."""
        kept, number = self[positions(some.index_select(0, self.region))], some.cumsum(0) - 1
        return replace(kept, region=number.index_select(0, kept.region), frame=self.frame[some])

    def cells_of(self, some: Bool[Tensor, " R"]) -> Int[Tensor, " Q"]:
        """Their cells alone."""
        return self.cell[positions(some.index_select(0, self.region))]


def gradient(frames: Real[Tensor, "B h w"]) -> Gradient:
    """Gradient and noise threshold of frames, uint8 or float32 in grey levels (0..255 or more).

    The noise is estimated from the median squared gradient of a sample of the cells, which edges hardly touch; pixels
    that are NaN or infinite do not count.
    """
    batch, height, width = frames.shape
    frames = frames.contiguous()
    if frames.numel() == 0 or min(height, width) < 2:
        return Gradient(frames, torch.full((batch,), _LEAST_LEVEL, device=frames.device))
    step = max(1, math.isqrt(height * width // _NOISE_SAMPLES))
    levels = frames.float() if step == 1 else frames
    a, b, c, d = (
        levels[:, y : height - 1 + y : step, x : width - 1 + x : step].float() for y in (0, 1) for x in (0, 1)
    )
    # |gradient|^2 is sigma^2 chi^2_2, whose median is 2 ln 2 sigma^2
    power = (0.5 * ((d - a).square() + (b - c).square())).flatten(1).nan_to_num(nan=0.0)
    sigma = (_lower_median(power) / (2 * math.log(2))).sqrt()
    grey = a.flatten(1)
    low = high = grey
    grad = Gradient(frames, sigma)
    if not grad.whole:
        known = numbers(grey)
        low, high = grey.where(known, torch.inf), grey.where(known, -torch.inf)
    low, high = low.amin(-1), high.amax(-1)
    threshold = torch.maximum(_NOISE_SIGMAS * sigma, _RANGE_FRACTION * (high - low)).clamp_min(_LEAST_LEVEL)
    grad.threshold.copy_(threshold)
    return grad


def _lower_median(rows: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """As `torch.median` of each row, in a tenth of its time on the CPU."""
    if rows.device.type != "cpu":
        return rows.median(-1).values
    middle = (rows.shape[1] - 1) // 2
    return torch.from_numpy(np.partition(rows.numpy(), middle, axis=1)[:, middle].copy())


def strong_cells(grad: Gradient) -> Int[Tensor, " P"]:
    """Flat indices, rising, of the cells whose gradient is above their frame's threshold."""
    _, height, width = grad.shape
    if grad.frames.numel() == 0 or min(height, width) < 2:
        return torch.zeros(0, dtype=torch.int64, device=grad.frames.device)
    cell = _steep(grad.frames, grad.threshold)
    gx, gy = grad.components(cell)
    limit = grad.threshold.square().index_select(0, cell // (height * width))
    return cell.index_select(0, positions(gx.square() + gy.square() > limit))


def _steep(frames: Tensor, threshold: Tensor) -> Tensor:
    """Flat cells with a diagonal difference above the threshold, among which are all whose gradient is.

    |gradient|^2 is half the sum of the squares of both diagonal differences. On the CPU these go through OpenCV, the
    batch as one tall picture, a few rows at a time that stay in the cache. What the last row of a frame shares with the
    next is no cell of its gradient.
    """
    batch, height, width = frames.shape
    if frames.device.type == "cpu":
        tall = frames.view(batch * height, width).numpy()
        limit = threshold.numpy().repeat(height)
        limit[height - 1 :: height] = np.inf
        if tall.dtype == np.uint8:  # whole levels: above the threshold is above its whole part, and bytes are quick
            limit = limit.clip(0, 255).astype(np.uint8)
        rows = min(max(1, _PART_PIXELS // width), len(tall) - 1)
        differ, other = np.empty((2, rows, width - 1), tall.dtype)
        above = np.zeros((rows, width), bool)
        found = []
        for start in range(0, len(tall) - 1, rows):
            upper, lower = tall[start : start + rows], tall[start + 1 : start + 1 + rows]
            upper = upper[: len(lower)]
            one, two = differ[: len(lower)], other[: len(lower)]
            cv2.absdiff(lower[:, 1:], upper[:, :-1], one)
            cv2.absdiff(upper[:, 1:], lower[:, :-1], two)
            cv2.max(one, two, one)
            np.greater(one, limit[start : start + len(lower), None], out=above[: len(lower), :-1])
            found.append(np.flatnonzero(above[: len(lower)]) + start * width)
        return torch.from_numpy(np.concatenate(found))
    frames = frames.float()
    steep = torch.zeros_like(frames)
    diagonals = (frames[:, 1:, 1:] - frames[:, :-1, :-1]).abs(), (frames[:, :-1, 1:] - frames[:, 1:, :-1]).abs()
    steep[:, :-1, :-1] = torch.maximum(*diagonals)
    return (steep > threshold[:, None, None]).flatten().nonzero()[:, 0]


def level_line_regions(
    grad: Gradient, cell: Int[Tensor, " P"], min_pixels: int, sectors: int = 0, phase: float = 0.0
) -> Regions:
    """Connected components of rising flat cells with agreeing gradient directions, of at least ``min_pixels``.

    Without ``sectors`` neighbours join whose directions are close to each other, so that whole curves hold together.
    With n sectors, the first of which starts at a fraction ``phase`` of one, neighbours join if their directions fall
    into the same n-th of the circle: curves break into arcs of known turn, and corners part from what they join.
    """
    _, height, width = grad.shape
    gx, gy = grad.components(cell)
    a, b = _neighbours(cell, width)
    if sectors:
        sector = ((torch.atan2(gy, gx) / (2 * math.pi) + 1) * sectors + phase).long() % sectors
        agree = sector.index_select(0, a) == sector.index_select(0, b)
    else:
        scale = (gx.square() + gy.square()).rsqrt_()
        x, y = gx * scale, gy * scale
        cos = x.index_select(0, a) * x.index_select(0, b) + y.index_select(0, a) * y.index_select(0, b)
        agree = cos > AGREE_COS
    label = _labels(a, b, agree, cell.numel())

    large = torch.bincount(label, minlength=cell.numel()) >= min_pixels
    number = large.cumsum(0) - 1
    keep = positions(large.index_select(0, label))
    region = number.index_select(0, label.index_select(0, keep))
    region, order = _sorted(region)  # what is summed by region lies together
    keep = keep.index_select(0, order)
    first = positions(large)
    gradient = torch.stack([gx.index_select(0, keep), gy.index_select(0, keep)])
    return Regions(cell.index_select(0, keep), region, gradient.mT, cell[first] // (height * width))


def _labels(one: Tensor, other: Tensor, agree: Tensor, count: int) -> Tensor:
    """As `connected_components` of the pairs of `_neighbours` that agree, of runs along rows instead of cells."""
    joined = positions(agree)
    one, other = one.index_select(0, joined), other.index_select(0, joined)
    beside = other - one == 1  # the next cell of the list is the next of the row wherever it is a neighbour
    first = torch.ones(count, dtype=torch.bool, device=one.device).index_fill_(0, other[beside], False)
    run, start = first.cumsum(0) - 1, positions(first)
    apart = positions(~beside)
    one, other = (run.index_select(0, v.index_select(0, apart)) for v in (one, other))
    new = torch.ones_like(one, dtype=torch.bool)
    new[1:] = (one[1:] != one[:-1]) | (other[1:] != other[:-1])
    new = positions(new)
    label = connected_components(one.index_select(0, new), other.index_select(0, new), start.numel())
    return start.index_select(0, label.index_select(0, run))


def _sorted(region: Tensor) -> tuple[Tensor, Tensor]:
    """As a stable sort; NumPy sorts short integers by their digits, in a fraction of the time."""
    if region.device.type == "cpu" and region.numel() and int(region.max()) < 1 << 16:
        order = torch.from_numpy(region.numpy().astype(np.uint16).argsort(kind="stable"))
        return region.index_select(0, order), order
    return region.sort(stable=True)


def _neighbours(cell: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Pairs of positions in ``cell`` (P,), rising, that are neighbours, by 8-connectivity; each once.

    The three neighbours below a cell follow each other in the list, wherever they begin: no table of all cells is
    needed, and one is only made where it would be well filled. The last row and column hold no cell, so that an index
    that wraps around meets none.
    """
    right = positions(cell[1:] - cell[:-1] == 1)
    first, second = [right], [right + 1]
    if cell.numel() and cell.numel() * _DENSE > int(cell[-1]):
        number = torch.full((int(cell[-1]) + width + 2,), -1, dtype=torch.int32, device=cell.device)
        number[cell] = torch.arange(cell.numel(), dtype=torch.int32, device=cell.device)
        for k in range(3):
            beneath = number.index_select(0, cell + (width - 1 + k)).long()
            index = positions(beneath >= 0)
            first.append(index)
            second.append(beneath.index_select(0, index))
        return torch.cat(first), torch.cat(second)
    padded = torch.nn.functional.pad(cell, (0, 3), value=-1)  # meets no cell: what is wanted is never negative
    wanted = cell + (width - 1)
    below = _search(cell, wanted)
    for k in range(3):
        step = padded.index_select(0, below + k) - wanted
        index = positions((step >= 0) & (step <= 2))
        first.append(index)
        second.append(below.index_select(0, index) + k)
    return torch.cat(first), torch.cat(second)


def _search(rising: Tensor, values: Tensor) -> Tensor:
    """torch.searchsorted of values that rise themselves, which NumPy turns to account."""
    if rising.device.type == "cpu":
        return torch.from_numpy(np.searchsorted(rising.numpy(), values.numpy()))
    return torch.searchsorted(rising, values)


def connected_components(one: Int[Tensor, " E"], other: Int[Tensor, " E"], count: int) -> Int[Tensor, " count"]:
    """Smallest member of each node's component in the graph whose edges join ``one`` and ``other``."""
    parent = torch.arange(count, device=one.device)
    while one.numel():
        first, second = parent.index_select(0, one), parent.index_select(0, other)
        low = torch.minimum(first, second)
        parent = parent.scatter_reduce(0, first, low, "amin").scatter_reduce_(0, second, low, "amin")
        while not torch.equal(shorter := parent.index_select(0, parent), parent):
            parent = shorter
        # what is joined stays so
        apart = positions(parent.index_select(0, first) != parent.index_select(0, second))
        one, other = first.index_select(0, apart), second.index_select(0, apart)
    return parent


def region_polarity(
    regions: Regions, center: Float[Tensor, "R 2"], cells_xy: Float[Tensor, "P 2"]
) -> Float[Tensor, " R"]:
    """Mean cosine of the gradient with the way out of each region's centre: +1 dark inside, -1 light."""
    index, count = regions.region, center.shape[0]
    (x, y), (gx, gy) = cells_xy.unbind(-1), regions.gradient.unbind(-1)
    x, y = x - center[:, 0].index_select(0, index), y - center[:, 1].index_select(0, index)
    cos = (x * gx + y * gy) / ((x * x + y * y) * (gx * gx + gy * gy)).sqrt()
    return segment_sum(cos.nan_to_num(nan=0.0), index, count) / torch.bincount(index, minlength=count)

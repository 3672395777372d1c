"""Candidate ellipses of a batch of frames: fits to the level-line regions, validated a contrario."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose import ellipse
from torchpose.detect.reduce import area_reduce, reduction_factor
from torchpose.detect.regions import Gradient, Regions, gradient, level_line_regions, region_polarity
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, segment_sum

_MIN_PIXELS = 10
_MIN_SEMI_MINOR = 2.0  # reduced px
_MIN_ASPECT = 0.12
_MIN_COVER = 0.35  # of the perimeter that its own region follows


@dataclass(frozen=True, eq=False)
class Candidates:
    """Ellipses found in B frames, flat, in full-frame pixels (pixel centre at integer coordinates).

    Attributes:
        frame: (M,) int64. ellipse: (M, 5) float64, cx, cy, a, b, theta.
        polarity: (M,) float64, +1 where the inside is darker than the outside, -1 where lighter.
        log10_nfa: (M,) float64, log10 of the number of false alarms, negative for each candidate.
        cover: (M,) float64, fraction of the perimeter with the gradient of the ellipse.
    """

    frame: Tensor
    ellipse: Tensor
    polarity: Tensor
    log10_nfa: Tensor
    cover: Tensor

    def __len__(self) -> int:
        return self.frame.shape[0]

    def __getitem__(self, index: Tensor) -> Candidates:
        return Candidates(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def find_candidates(frames: Tensor, factor: int | None = None) -> Candidates:
    """Ellipses in grey frames (B, H, W), one pass for the whole batch.

    Args:
        frames: any real dtype, in grey levels: 0..255 for float frames, up to 65535 for uint16. Steps below 1.5 levels
            are taken for quantisation. NaN pixels are ignored.
        factor: integer reduction before the search; by default the smallest that gives at most 1.3 megapixels. The
            smallest semi-minor axis found is 2 reduced pixels.
    """
    factor = reduction_factor(*frames.shape[-2:]) if factor is None else factor
    grad = gradient(area_reduce(frames, factor))
    regions = level_line_regions(grad, _MIN_PIXELS)
    found = validate(grad, *fit_regions(grad, regions))
    full = found.ellipse.clone()
    full[:, :2] = factor * full[:, :2] + 0.5 * (factor - 1)
    full[:, 2:4] *= factor
    return Candidates(found.frame, full, found.polarity, found.log10_nfa, found.cover)


def fit_regions(grad: Gradient, regions: Regions) -> tuple[Tensor, Tensor, Tensor]:
    """Ellipses of those regions that follow one: frame (M,), ellipse (M, 5) in reduced px, polarity (M,)."""
    _, height, width = grad.diag.shape
    inside = regions.cell % (height * width)
    xy = torch.stack([inside % width, inside // width], -1).double() + 0.5
    count = regions.frame.numel()
    magnitude = torch.linalg.vector_norm(regions.gradient, dim=-1).double()
    params = ellipse.fit(xy, regions.region, count, magnitude)
    # once more with the pixels near the ellipse only
    r = ellipse.distance(xy, regions.region, params)
    params = ellipse.fit(xy, regions.region, count, magnitude * (r.abs() < 1.5))
    a, b = params[:, 2], params[:, 3]
    follows = (ellipse.distance(xy, regions.region, params).abs() < 1.5).double()
    length = segment_sum(follows, regions.region, count)
    good = (
        (b >= _MIN_SEMI_MINOR)
        & (b >= _MIN_ASPECT * a)
        & (a <= 0.5 * max(height, width))
        & (length >= _MIN_COVER * conics.perimeter(params))
    )
    polarity = region_polarity(regions, params[:, :2], xy).sign()
    return regions.frame[good], params[good], polarity[good]


def validate(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Candidates:
    """Keeps the ellipses that noise would give less than once (number of false alarms below 1).

    One sample a pixel of perimeter: under the null hypothesis its angle error, divided by pi, is uniform in [0, 1], and
    the sum k of n of them is below its value with probability at most k^n / n!. The number of tests is the number of
    distinguishable ellipses, (h w)^(5/2): five parameters, each with as many values as the frame has pixels on a side.
    """
    _, height, width = grad.diag.shape
    n = conics.perimeter(ellipses).ceil().long()
    which, position = ragged_arange(n)
    angle = position.double() * (2 * torch.pi) / n[which]
    xy = conics.points_on(ellipses[which], angle)
    # the normal of the ellipse through each sample: gradient of |S^-1 (x - c)|
    inverse = torch.linalg.inv(conics.shape_matrix(ellipses))
    normal = (inverse @ inverse)[which] @ (xy - ellipses[which, :2])[..., None]
    normal = normal.squeeze(-1) / torch.linalg.vector_norm(normal, dim=1)
    x, y = (xy - 0.5).round().long().unbind(-1)
    on_frame = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    cell = (frame[which] * height + y.clamp(0, height - 1)) * width + x.clamp(0, width - 1)
    g = grad.at(cell).double()
    cos = (g * normal).sum(-1) * polarity[which] / torch.linalg.vector_norm(g, dim=-1).clamp_min(1e-6)
    error = torch.where(on_frame, cos.clamp(-1, 1).acos() / torch.pi, 0.5)  # 0.5: neither for nor against
    count = ellipses.shape[0]
    k = segment_sum(error, which, count)
    cover = segment_sum((error < 0.125).double(), which, count) / n
    log_tests = 2.5 * math.log10(max(1, height * width))
    size = n.double()
    log10_nfa = log_tests + size * k.clamp_min(1e-12).log10() - torch.lgamma(size + 1) / math.log(10)
    keep = log10_nfa < 0
    return Candidates(frame[keep], ellipses[keep], polarity[keep], log10_nfa[keep], cover[keep])

"""What a refinement looks at, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect.reduce import only_reduced
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.blurred_edge import HOLDS, KINDS
from torchpose.geometry.constants import constant, either
from torchpose.geometry.least_squares import Pose, PosePrior
from torchpose.geometry.robust import LEAST_KEPT as LEAST_KEPT
from torchpose.geometry.rows import Rows, replace, shared
from torchpose.identify import Scene
from torchpose.pose import Found, MarkerNormals
from torchpose.target import Target

QUANTISATION = 1 / 12  # variance of rounding, in grey levels^2, below which no noise estimate falls
_START_BLUR = 0.8  # px, of rows whose rings tell of none


@dataclass(frozen=True, eq=False)
class Look(Rows):
    """How a fit saw its N rows of M markers, in px of the reduced frames; another fit of the same rows begins with it.

    Attributes:
        kind: of the blur, its number in `geometry.blurred_edge.KINDS`.
        blur: as `geometry.blurred_edge.Spread.values`.
        levels: grey levels of the markers, as `refine.photometric.light` has them.
        band: on either side of the edges.
        reduction: of the frames, by block means.
        doubt: what contradicts the model there does so still, since no marker was moved.
    """

    kind: Int[Tensor, " N"]
    blur: Float[Tensor, "N 3"]
    levels: Float[Tensor, "N M 6"]
    band: Float[Tensor, " N"]
    reduction: Int[Tensor, " N"]
    doubt: Bool[Tensor, " N"]


@dataclass(frozen=True, eq=False)
class Sight(Rows):
    """N rows of M markers seen in frames, and where.

    Attributes:
        frame: frame of each row.
        mask: markers seen; what the others hold does not matter.
        rings: fitted ellipses in raw pixels, outer and inner.
        polarity: +1 dark ring on light, -1 light on dark.
        centers: of the markers, target frame, mm.
        normals: the same.
        radii: outer and inner, mm.
        blur: of every marker, px^2, see `geometry.blur`; NaN or None where nothing is known of it.
        frames: grey values, any real dtype.
        camera: with distortion.
        reduction: of the frames, by block means: their rounding counts for less.
        seen: sectors of every ring in which it was seen so far, see `geometry.sectors`; None where nothing is known.
        look: of an earlier fit, with which to begin.
        disc: whether the blur of most rings was seen to be a disc's; None where nothing is known.
    """

    frame: Int[Tensor, " N"]
    mask: Bool[Tensor, "N M"]
    rings: Float[Tensor, "N M 2 5"]
    polarity: Float[Tensor, "N M"]
    centers: Float[Tensor, "N M 3"]
    normals: Float[Tensor, "N M 3"]
    radii: Float[Tensor, "N M 2"]
    frames: Shaped[Tensor, "B H W"] = shared()
    camera: Camera = shared()
    blur: Float[Tensor, "N M 3"] | None = None
    reduction: int = shared(1)
    seen: Bool[Tensor, "N M 48"] | None = None
    look: Look | None = None
    disc: Bool[Tensor, " N"] | None = None

    @classmethod
    def of(cls, frames: Tensor, camera: Camera, target: Target, frame: Tensor, rings: Tensor) -> Self:
        """Rows of one target, all markers seen: frame (N,) of each, fitted ellipses (N, M, 2, 5) in raw pixels."""
        rows = (len(frame), len(target))
        centers, normals, radii = (
            x.expand(rows[0], *x.shape) for x in (target.centers, target.normals, target.printed_radii)
        )
        polarity = rings.new_full(rows, 1.0 if target.background == "light" else -1.0)
        mask = torch.ones(rows, dtype=torch.bool, device=rings.device)
        return cls(frame, mask, rings, polarity, centers, normals, radii, frames, camera)

    @classmethod
    def of_scene(cls, scene: Scene, found: Found, rows: Tensor) -> Self:
        """Rows (N,) of a scene, with the rings that were found of them."""
        evidence = found.evidence[rows]
        which, every = found.identified.ring[rows].clamp_min(0).flatten(), found.rings
        raw = torch.stack([every.outer_raw, every.inner_raw], 1).index_select(0, which)
        # what is left of a clipped edge tells of no blur
        blur = either(every.clipped[:, None], torch.nan, every.blur).index_select(0, which)
        polarity, seen, disc = (
            value.index_select(0, which).view(*evidence.mask.shape, *value.shape[1:])
            for value in (every.polarity, every.seen, every.disc)
        )
        return cls(
            scene.frame[rows],
            evidence.mask,
            raw.view(*evidence.mask.shape, 2, 5),
            polarity,
            evidence.points,
            evidence.normals,
            evidence.radii,
            scene.frames,
            scene.camera,
            blur.view(*evidence.mask.shape, 3),
            seen=seen,
            disc=2 * (disc & evidence.mask).sum(-1) > evidence.mask.sum(-1),
        )

    @property
    def quantisation(self) -> float:
        """Variance of rounding, grey levels^2."""
        return QUANTISATION / self.reduction**2

    @cached_property
    def common_blur(self) -> Float[Tensor, "N 3"]:
        """The median of the known blurs of the markers of every row that are seen."""
        start = constant(_START_BLUR, self.centers, torch.float64)
        if self.blur is None:
            return blurs.isotropic(start.expand(len(self)))
        median = either(self.mask[..., None], self.blur, torch.nan).nanmedian(1).values
        return torch.where(median.isnan(), blurs.isotropic(start), median)

    @property
    def resolved(self) -> Bool[Tensor, " N"]:
        """Whether most of the rings that are seen are larger than their blur, so that a pixel sees one edge of them."""
        if self.blur is None:
            return torch.ones_like(self.mask[:, 0])
        smallest = torch.where(self.radii[..., 1] < 0, self.rings[..., 0, 3], self.rings[..., 1, 3])
        may = self.mask & (self.blur[..., 0] + self.blur[..., 2] > (HOLDS * smallest).square())
        if not bool(may.any()):
            return torch.ones_like(self.mask[:, 0])
        share = either(self.mask, blurs.axes(self.blur)[1].sqrt() / smallest, torch.nan)
        return ~(share.nanquantile(0.5, -1) > HOLDS)

    @property
    def told(self) -> Int[Tensor, " N"]:
        """The kind of blur that the rings tell, its number in `geometry.blurred_edge.KINDS`."""
        known = torch.zeros_like(self.frame) if self.disc is None else self.disc.to(self.frame)
        return known * KINDS.index("disc")

    def displaced(self, by: Float[Tensor, "N M 5"]) -> Self:
        """The same rows with places of their markers beside those they have, as `Poses.place`."""
        grown = (self.polarity * by[..., 3])[..., None] * constant((1.0, -1.0), by) + by[..., 4:]
        return replace(self, centers=self.centers + by[..., :3], radii=self.radii + grown)

    def reduced(self, factor: int) -> Sight:
        """The same rows in frames of which blocks of ``factor`` px make one; only those frames that they need."""
        if factor == 1:
            return self
        frames, frame, _ = only_reduced(self.frames, self.frame, factor)
        return replace(
            self,
            frame=frame,
            rings=conics.rescaled(self.rings, 1 / factor),
            frames=frames,
            camera=self.camera.reduced(factor),
            blur=None if self.blur is None else blurs.reduced(self.blur, factor),
            reduction=self.reduction * factor,
        )


def refined_by_blur(
    refine: Callable[[Sight, Pose, PosePrior | None], Refined],
    sight: Sight,
    start: Pose,
    prior: Tensor | None,
    factor: Int[Tensor, " N"],
) -> Refined:
    """N rows refined in parts, by the kind of their blur and whether they are in doubt, in frames reduced by their
    ``factor``; blurs in px of the frames themselves.

    Args:
        prior: (N, 6, 6), information about the pose where it starts, or (N, 7, 7) with an edge gain of zero.
        factor: for rows without a look.
    """
    known = None if prior is None else PosePrior(prior, start)
    kind, doubt = sight.told, torch.zeros_like(factor)
    if sight.look is not None:
        factor, kind, doubt = sight.look.reduction, sight.look.kind, sight.look.doubt.long()
    each = torch.stack([factor, kind, doubt], -1)
    groups = each.unique(dim=0).tolist() or [[1, 0, 0]]

    def part(by: int, sight: Sight, start: Pose, known: PosePrior | None) -> Refined:
        some = refine(sight.reduced(by), start, known)
        return some if by == 1 else replace(some, spread=blurs.enlarged(some.spread, by))

    if len(groups) == 1:
        return part(groups[0][0], sight, start, known)
    order, parts = [], []
    for one in groups:
        index = (each == each.new_tensor(one)).all(-1).nonzero()[:, 0]
        parts.append(part(one[0], sight[index], start[index], None if known is None else known[index]))
        order.append(index)
    return Refined.cat(parts)[torch.argsort(torch.cat(order))]


@dataclass(frozen=True, eq=False)
class Refined(Rows):
    """Refined poses of N rows.

    Attributes:
        R: target to camera.
        t: mm.
        covariance: as in `results.Poses`.
        spread: blur, px^2, see `geometry.blur`.
        noise: standard deviation of the residuals kept: grey levels (photometric), px (edges).
        kept: share of the pixels, or edge points, kept.
        good: where False the refinement failed and the other fields mean nothing.
        doubt: something in the frame contradicts the model of the rings.
        normals: what each marker tells, at the pose.
        rough: most edges of all rings are displaced by more than noise, and that is counted.
        gain: by which every dark edge lies outwards, mm, where it was an unknown.
        even: degrees of freedom in which edges along the rims scatter as noise does, 0 where by more, if it is known.
        look: where the fit may have seen its rows in several ways.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    spread: Float[Tensor, "N 3"]
    noise: Float[Tensor, " N"]
    kept: Float[Tensor, " N"]
    good: Bool[Tensor, " N"]
    doubt: Bool[Tensor, " N"]
    normals: MarkerNormals
    rough: Bool[Tensor, " N"]
    gain: Float[Tensor, " N"] | None = None
    even: Float[Tensor, " N"] | None = None
    look: Look | None = None

    @property
    def blur(self) -> Float[Tensor, " N"]:
        """px, standard deviation of the point-spread function with the pixel: of the round one of the same area."""
        return blurs.size(self.spread)

"""Stage: a second look for markers that were not found, where the pose of the others puts them.

A cover over a third of a ring, or a blur as wide as the ring, can hide it from a search that does not know where to
look. The markers that were found tell place, size and shape of the others: each predicted circle is measured as any
candidate is, and counts if it has the place and the code of the marker.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.segments import near_pairs
from torchpose.identify.assignments import Codes, Marks
from torchpose.identify.copies import MIN_MARKERS
from torchpose.identify.hypotheses import PLACE_TOLERANCE, SIZE_TOLERANCE
from torchpose.identify.markers import Identified
from torchpose.identify.scene import MarkerTable, Scene
from torchpose.rings import Rings, mapped, measure_predicted


class Views(NamedTuple):
    """Where N rows of M markers may be.

    seen (N, M) bool: the markers that fit. R (N, S, 3, 3), t (N, S, 3): S possible poses, NaN where there are fewer.
    least: markers that must have been seen; 0 where something else tells the poses.
    """

    seen: Tensor
    R: Tensor
    t: Tensor
    least: int = MIN_MARKERS - 1


class _Missing(NamedTuple):
    """P places of markers that are missing: row, number, outer ellipse in ideal pixels, both in raw ones (P, 2, 5)."""

    row: Tensor
    marker: Tensor
    ideal: Tensor
    raw: Tensor

    def where(self, some: Tensor) -> "_Missing":
        index = some.nonzero()[:, 0]
        return _Missing(*(value[index] for value in self))


@checked
def look_again(
    scene: Scene, rings: Rings, identified: Identified, views: Views, blurred: Rings, *, correct: bool = True
) -> tuple[Rings, Identified]:
    """The rings and their markers, with those that were found at the predicted places.

    Args:
        scene: frames, camera and targets.
        rings: found so far.
        identified: the same, of N rows.
        views: of the rows.
        blurred: rings measured so far of which no other look shows more: nothing is looked for where one of them is.
        correct: as for `rings.measure_rings`.
    """
    there = _missing(scene, identified, views)
    there = there.where(~_occupied(scene, there, blurred))
    if there.row.numel() == 0:
        return rings, identified
    polarity = scene.table.polarity[scene.target]
    candidates = Candidates.unscored(scene.frame[there.row], there.raw[:, 0], polarity[there.row])
    found, which = measure_predicted(scene.frames, candidates, there.raw[:, 1], scene.camera, correct=correct)
    row, marker, ideal = there.row[which], there.marker[which], there.ideal[which]
    measured = found.outer.params
    miss = torch.linalg.vector_norm(measured[:, :2] - ideal[:, :2], dim=-1)
    clipping = _clipping(rings, identified.ring, scene)[row]
    codes = Codes.of(found, Marks.of(scene.table, scene.target[row], marker))
    off = codes.under(torch.where(found.clipped, clipping, identified.gain[row]))
    good = (miss < near_place(measured)) & (off < 1)
    # of several poses of a row, the one that was nearest
    slot = row * identified.ring.shape[1] + marker
    nearest = torch.full((identified.ring.numel(),), torch.inf, dtype=miss.dtype, device=miss.device)
    nearest.scatter_reduce_(0, slot[good], miss[good], "amin")
    index = (good & (miss == nearest[slot])).nonzero()[:, 0]
    ring = len(rings) + torch.arange(index.numel(), device=index.device)
    place = torch.stack([row[index], marker[index], ring], -1)
    assigned = identified.ring.index_put((place[:, 0], place[:, 1]), ring)
    more = replace(identified, ring=assigned, proposal=torch.cat([identified.proposal, place]))
    return Rings.cat([rings, found[index]]), more


def _missing(scene: Scene, identified: Identified, views: Views) -> _Missing:
    """The places in the frames where the views put markers that they lack."""
    markers, camera, seen = scene.table[scene.target], scene.camera, views.seen
    rings_of = markers.valid & (markers.radii[..., 1] > 0)  # discs have no codes, and one circle
    wanted = rings_of & ~seen & (seen.sum(-1) >= views.least)[:, None]
    row, option, marker = (wanted[:, None] & views.R.isfinite().all(-1).all(-1)[..., None]).nonzero().unbind(-1)
    if row.numel() == 0:
        nothing = markers.radii.new_zeros(0, 2, 5)
        return _Missing(row, marker, nothing[:, 0], nothing)
    printed = replace(markers, radii=scene.printed_radii(scene.stated_gain(identified.gain)))
    ideal, raw, depth = predicted(printed, camera, views.R[row, option], views.t[row, option], (row, marker))
    outer, limit = raw[:, 0], torch.tensor([camera.width - 1, camera.height - 1], device=row.device)
    # a circle that reaches behind the camera, or a plane seen edge-on, has no ellipse
    in_view = ((outer[:, :2] > 0) & (outer[:, :2] < limit)).all(-1) & (outer[:, 2] < limit.amin()) & (depth > 0)
    return _Missing(row, marker, ideal[:, 0], raw).where(in_view)


def _occupied(scene: Scene, there: _Missing, rings: Rings) -> Tensor:
    """Places (P,) bool at which there is a ring of the right polarity and size."""
    none = torch.zeros_like(there.row, dtype=torch.bool)
    if len(rings) == 0 or there.row.numel() == 0:
        return none
    frame, outer = scene.frame[there.row], rings.outer.params
    i, j = near_pairs(there.ideal[:, :2], outer[:, :2], near_place(there.ideal), (frame, rings.frame))
    size = outer[j, 2] / there.ideal[i, 2]
    alike = (size < SIZE_TOLERANCE) & (size > 1 / SIZE_TOLERANCE)
    alike &= rings.polarity[j] == scene.table.polarity[scene.target][there.row[i]]
    return none.index_fill(0, i[alike], True)


def near_place(ellipse: Tensor) -> Tensor:
    """px, how far from their places rings (K, 5) may be: half of what is allowed for a pose that is guessed."""
    px, of_size, _ = PLACE_TOLERANCE
    return 0.5 * (px + of_size * ellipse[:, 2])


def _clipping(rings: Rings, ring: Tensor, scene: Scene) -> Tensor:
    """By how far clipping has moved the edges of each row's rings (N, M), -1 where not seen: (N,) px, NaN if unknown.

    Args:
        rings: of all frames.
        ring: index into them.
        scene: whose each row is.
    """
    row, marker = (ring >= 0).nonzero().unbind(-1)
    some = rings[ring[row, marker]]
    codes = Codes.of(some, Marks.of(scene.table, scene.target[row], marker))
    each = torch.full(ring.shape, torch.nan, dtype=torch.float64, device=ring.device)
    each = each.index_put((row, marker), torch.where(some.clipped, codes.likely, torch.nan))
    return each.nanmedian(1).values


def predicted(
    markers: MarkerTable, camera: Camera, R: Tensor, t: Tensor, at: tuple[Tensor, Tensor], *, rough: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Ellipses (P, 2, 5) of both circles, ideal and raw pixels, and depths (P,), of markers ``at`` (row, number).

    ``rough``: the raw ones are the ideal ones moved to where the lens has their centres.
    """
    center, k = (R @ markers.centers[at][..., None]).squeeze(-1) + t, camera.matrix
    normal = markers.normals[at][:, None]
    ideal = conics.circle_ellipse(k, R[:, None], center[:, None], normal, markers.radii[at])

    def seen(points: Tensor) -> Tensor:
        return camera.distort((points - k[:2, 2]) / k.diagonal()[:2])

    if not camera.distorts:
        raw = ideal
    elif rough:
        raw = torch.cat([seen(ideal[..., :2]), ideal[..., 2:]], -1)
    else:
        raw = mapped(ideal.flatten(0, 1), seen).view_as(ideal)
    return ideal, raw, center[:, 2]

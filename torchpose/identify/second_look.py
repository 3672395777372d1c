"""Stage: a second look for markers that were not found, where the pose of the others puts them.

A cover over a third of a ring, or a blur as wide as the ring, can hide it from a search that does not know where to
look. The markers that were found tell place, size and shape of the others: each predicted circle is measured as any
candidate is, and counts if it has the place and the code of the marker.
"""

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.identify.assignments import Codes, Marks
from torchpose.identify.copies import MIN_MARKERS
from torchpose.identify.hypotheses import PLACE_TOLERANCE
from torchpose.identify.markers import Identified
from torchpose.identify.scene import MarkerTable, Scene
from torchpose.rings import Rings, mapped, measure_predicted


@checked
def look_again(
    scene: Scene,
    rings: Rings,
    identified: Identified,
    seen: Tensor,
    poses: tuple[Tensor, Tensor],
    *,
    least: int = MIN_MARKERS - 1,
    correct: bool = True,
) -> tuple[Rings, Identified]:
    """The rings and their markers, with those that were found at the predicted places.

    Args:
        scene: frames, camera and targets.
        rings: found so far.
        identified: the same, of N rows.
        seen: (N, M) bool, the markers that fit the poses.
        poses: R (N, S, 3, 3) and t (N, S, 3) of S possible poses of each row; NaN where there are fewer.
        least: markers of a row that must have been seen; 0 where something else tells the pose.
        correct: as for `rings.measure_rings`.
    """
    markers, camera, (R, t) = scene.table[scene.target], scene.camera, poses
    rings_of = markers.valid & (markers.radii[..., 1] > 0)  # discs have no codes, and one circle
    wanted = rings_of & ~seen & (seen.sum(-1) >= least)[:, None]
    row, option, marker = (wanted[:, None] & R.isfinite().all(-1).all(-1)[..., None]).nonzero().unbind(-1)
    if row.numel() == 0:
        return rings, identified
    printed = replace(markers, radii=scene.printed_radii(scene.stated_gain(identified.gain)))
    ideal, raw, depth = _predicted(printed, camera, R[row, option], t[row, option], (row, marker))
    outer, limit = raw[:, 0], torch.tensor([camera.width - 1, camera.height - 1], device=R.device)
    # a circle that reaches behind the camera, or a plane seen edge-on, has no ellipse
    in_view = ((outer[:, :2] > 0) & (outer[:, :2] < limit)).all(-1) & (outer[:, 2] < limit.amin()) & (depth > 0)
    kept = in_view.nonzero()[:, 0]
    if kept.numel() == 0:
        return rings, identified
    candidates = Candidates.unscored(scene.frame[row[kept]], outer[kept], markers.polarity[row[kept]])
    found, which = measure_predicted(scene.frames, candidates, raw[kept, 1], camera, correct=correct)
    row, marker, ideal = row[kept[which]], marker[kept[which]], ideal[kept[which], 0]
    measured = found.outer.params
    miss = torch.linalg.vector_norm(measured[:, :2] - ideal[:, :2], dim=-1)
    clipping = _clipping(rings, identified.ring, scene)[row]
    codes = Codes.of(found, Marks.of(scene.table, scene.target[row], marker))
    off = codes.under(torch.where(found.clipped, clipping, identified.gain[row]))
    px, of_size, _ = PLACE_TOLERANCE  # half of it: a pose is known, not guessed
    good = (miss < 0.5 * (px + of_size * measured[:, 2])) & (off < 1)
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


def _predicted(
    markers: MarkerTable, camera: Camera, R: Tensor, t: Tensor, at: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Ellipses (P, 2, 5) of both circles, ideal and raw pixels, and depths (P,), of markers ``at`` (row, number)."""
    center, k = (R @ markers.centers[at][..., None]).squeeze(-1) + t, camera.matrix
    normal = markers.normals[at][:, None]
    ideal = conics.circle_ellipse(k, R[:, None], center[:, None], normal, markers.radii[at])
    raw = mapped(ideal.flatten(0, 1), lambda points: camera.distort((points - k[:2, 2]) / k.diagonal()[:2]))
    return ideal, raw.view_as(ideal), center[:, 2]

"""Stage: a second look for markers that were not found, where the pose of the others puts them.

A cover over a third of a ring, or a blur as wide as the ring, can hide it from a search that does not know where to
look. The markers that were found tell place, size and shape of the others: each predicted circle is measured as any
candidate is, and counts if it has the place and the code of the marker.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect import Candidates, Verdict
from torchpose.geometry import conics
from torchpose.identify.markers import Identified, MarkerTable, ratio_tolerance
from torchpose.rings import Rings, measure_predicted
from torchpose.rings.measure import mapped

_LEAST_FOUND = 2  # markers whose rings give a pose
_PLACE_TOLERANCE = (1.5, 0.15)  # px, and of the semi-major axis


def look_again(
    frames: Tensor,
    rings: Rings,
    identified: Identified,
    table: MarkerTable,
    camera: Camera,
    seen: Tensor,
    R: Tensor,
    t: Tensor,
    *,
    correct: bool = True,
) -> tuple[Rings, Identified]:
    """The rings and their markers, with those that were found at the predicted places.

    Args:
        frames: (B, H, W) grey. rings, identified: of N rows (frames times targets).
        seen: (N, M) bool, the markers that fit the poses. R, t: (N, S, 3, 3), (N, S, 3), S possible poses of each row;
            NaN where there are fewer. correct: as for `rings.measure_rings`.
    """
    rows = R.shape[0]
    target = torch.arange(rows, device=R.device) % table.ids.shape[0]
    wanted = table.valid[target] & ~seen & (seen.sum(-1) >= _LEAST_FOUND)[:, None]
    row, option, marker = (wanted[:, None] & R.isfinite().all(-1).all(-1)[..., None]).nonzero().unbind(-1)
    of = target[row]
    rotation = R[row, option]
    center = (rotation @ table.centers[of, marker][..., None]).squeeze(-1) + t[row, option]
    normal, radii = table.normals[of, marker], table.radii[of, marker]
    ideal, inner = (conics.circle_ellipse(camera.matrix, rotation, center, normal, r) for r in radii.unbind(-1))
    k = camera.matrix

    def raw(ellipses: Tensor) -> Tensor:
        return mapped(ellipses, lambda points: camera.distort((points - k[:2, 2]) / k.diagonal()[:2]))

    outer = raw(ideal)
    limit = torch.tensor([camera.width - 1, camera.height - 1], device=R.device)
    # a circle that reaches behind the camera, or a plane seen edge-on, has no ellipse
    in_view = ((outer[:, :2] > 0) & (outer[:, :2] < limit)).all(-1) & (outer[:, 2] < limit.amin()) & (center[:, 2] > 0)
    kept = in_view.nonzero()[:, 0]
    if kept.numel() == 0:
        return rings, identified
    frame = row[kept] // table.ids.shape[0]
    unknown = torch.full_like(outer[kept, 0], torch.nan)
    verdict = torch.full_like(frame, int(Verdict.ACCEPTED))
    candidates = Candidates(frame, outer[kept], table.polarity[of[kept]], unknown, unknown, verdict)
    found, which = measure_predicted(frames, candidates, raw(inner[kept]), camera, correct=correct)
    where = kept[which]
    measured = found.outer.params
    miss = torch.linalg.vector_norm(measured[:, :2] - ideal[where, :2], dim=-1)
    off = (found.ratio - radii[where, 1] / radii[where, 0]).abs()
    px, of_size = _PLACE_TOLERANCE
    good = (miss < px + of_size * measured[:, 2]) & (off < ratio_tolerance(measured[:, 3]))
    # of several poses of a row, the one that was nearest
    slot = row[where] * table.ids.shape[1] + marker[where]
    nearest = torch.full((identified.ring.numel(),), torch.inf, dtype=miss.dtype, device=miss.device)
    nearest.scatter_reduce_(0, slot[good], miss[good], "amin")
    index = (good & (miss == nearest[slot])).nonzero()[:, 0]
    ring = len(rings) + torch.arange(index.numel(), device=index.device)
    place = torch.stack([row[where[index]], marker[where[index]], ring], -1)
    assigned = identified.ring.index_put((place[:, 0], place[:, 1]), ring)
    more = replace(identified, ring=assigned, proposal=torch.cat([identified.proposal, place]))
    return Rings.cat([rings, found[index]]), more

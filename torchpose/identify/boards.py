"""Stage: which mark of a frame is which of a board of equal rings or discs, by its place on the grid.

Equal marks have no codes. Their ellipses are ordered by the lattice that they lie on (`torchpose.grids`), and the patch
that results is laid on the board. From there on a mark is a marker as any other.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose import pnp
from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.ellipse import EllipseFit
from torchpose.geometry import blur as blurs
from torchpose.geometry.arguments import checked
from torchpose.geometry.sectors import SECTORS
from torchpose.geometry.segments import marked, near_pairs
from torchpose.grids import LEAST_MARKS, Grid, order_marks, place_patches
from torchpose.identify.hypotheses import SIZE_TOLERANCE
from torchpose.identify.markers import Identified
from torchpose.identify.scene import Scene
from torchpose.rings import Rings
from torchpose.rings.lens import ideal_pixels, mapped

ROUGH = 0.1  # px, of the centres and axes of small ellipses (measured: `scripts/board_statistics.py`)
_UNKNOWN = 1e3  # px, of a circle that was not measured: its ellipse tells nothing
_START_BLUR = 0.8  # px, of marks whose edges nothing has told yet


@checked
def identify_boards(
    scene: Scene, rings: Rings, identified: Identified, candidates: Candidates
) -> tuple[Rings, Identified]:
    """The rows of boards with their marks, and the rings with those that are marks by their place alone.

    Args:
        scene: frames, camera and targets.
        rings: measured in all frames.
        identified: by codes; rows of boards have no ring.
        candidates: ellipses of all frames, of which the discs are taken, and rings that could not be measured.
    """
    for target, grid in enumerate(scene.table.layouts):
        if grid is not None:
            rings, identified = _identified(scene, (rings, candidates), identified, (target, grid))
    return rings, identified


def _identified(
    scene: Scene, seen: tuple[Rings, Candidates], identified: Identified, board: tuple[int, Grid]
) -> tuple[Rings, Identified]:
    """The same for one target."""
    (rings, candidates), (target, grid), table = seen, board, scene.table
    valid = table.valid[target]
    own, outer = rings.polarity == table.polarity[target], table.radii[target, valid, 0].median()
    ratio = float((table.radii[target, valid, 1] / table.radii[target, valid, 0]).median())
    if grid.discs:
        own &= False
    else:
        most = SIZE_TOLERANCE**2  # either circle may be off: gain and blur do that, another shape more
        own &= (rings.ratio < most * ratio) & (rings.ratio > ratio / most)
    number_of = own.nonzero()[:, 0]
    rest = candidates[candidates.polarity == table.polarity[target]]
    rest = rest[~_taken(rest, rings[own])]
    marks = Rings.cat([rings[own], rough_marks(rest, scene.camera, abs(ratio))])
    number_of = torch.cat([number_of, len(rings) + torch.arange(len(rest), device=number_of.device)])
    lattice = order_marks(marks.frame, marks.outer_raw, marks.polarity, grid.spacing / float(outer))
    size, frames = (scene.camera.width, scene.camera.height), len(scene.frames)
    number, turned = place_patches(lattice, marks.outer_raw[lattice.mark, :2], grid, size, frames)
    column = table.ids.new_full((len(grid.points),), -1)
    column[table.ids[target, valid]] = valid.nonzero()[:, 0]
    placed = ((number >= 0) & (column[number] >= 0)).nonzero()[:, 0]
    mark, marker = lattice.mark[placed], column[number[placed]]
    group = marks.frame[mark] * len(table) + target
    row = torch.searchsorted(identified.group, group)
    ring = identified.ring.index_put((row, marker), number_of[mark])
    R, t, posed = _poses(scene, marks.outer.params[mark, :2], (row, marker, target), len(identified))
    where = posed[:, None]
    found = replace(
        identified,
        ring=ring,
        R=torch.where(where[..., None], R, identified.R),
        t=torch.where(where, t, identified.t),
        turnable=identified.turnable | (posed & turned[identified.group // len(table)] & (not grid.upright)),
        proposal=torch.cat([identified.proposal, torch.stack([group, marker, number_of[mark]], -1)]),
    )
    return Rings.cat([rings, marks[int(own.sum()) :]]), found


def _taken(candidates: Candidates, rings: Rings) -> Bool[Tensor, " M"]:
    """Candidates that were measured as rings."""
    reach = 0.5 * candidates.ellipse[:, 3]
    one, ring = near_pairs(candidates.ellipse[:, :2], rings.outer_raw[:, :2], reach, (candidates.frame, rings.frame))
    away = torch.linalg.vector_norm(candidates.ellipse[one, :2] - rings.outer_raw[ring, :2], dim=-1)
    return marked(one[away < reach[one]], len(candidates))


def rough_marks(candidates: Candidates, camera: Camera, ratio: float) -> Rings:
    """Candidates as rings whose outer circle alone was seen.

    Args:
        candidates: of marks.
        camera: to take its distortion off.
        ratio: of their circles, that the inner ellipses are made of; above 1 those of discs, whose inner edge in the
            frame is taken to be their outer one.
    """
    outer = candidates.ellipse
    inner, seen_inner = (
        torch.cat([outer[:, :2], size * outer[:, 2:4], outer[:, 4:]], -1) for size in (ratio, min(ratio, 1.0))
    )
    one = torch.ones_like(outer[:, 0])
    ideal = mapped(torch.cat([outer, inner]), lambda points: ideal_pixels(camera, points))
    eye = torch.eye(5, dtype=outer.dtype, device=outer.device).expand(len(outer), 5, 5)
    first, second = (
        EllipseFit(ellipses, sigma**2 * eye, sigma * one, one)
        for ellipses, sigma in zip((ideal[: len(outer)], ideal[len(outer) :]), (ROUGH, _UNKNOWN), strict=True)
    )
    blur = blurs.isotropic(_START_BLUR * one)
    clipped = torch.zeros_like(candidates.polarity, dtype=torch.bool)
    seen = torch.ones(len(outer), SECTORS, dtype=torch.bool, device=outer.device)
    known = (blur, clipped, seen, torch.zeros_like(clipped))
    return Rings(candidates.frame, candidates.polarity, outer, seen_inner, first, second, *known)


def _poses(
    scene: Scene, center: Float[Tensor, "K 2"], at: tuple[Tensor, Tensor, int], rows: int
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Rough poses of rows by the centres of ellipses, ideal px, of markers ``at`` (row, number, target)."""
    (row, marker, target), k = at, scene.camera.matrix
    xy = (center - k[:2, 2]) / k.diagonal()[:2]
    shape = (rows, scene.table.ids.shape[1])
    seen = torch.zeros(shape, dtype=torch.bool, device=row.device).index_put((row, marker), torch.ones_like(row) > 0)
    flat = center.new_zeros(*shape, 2).index_put((row, marker), xy)
    posed = seen.sum(-1) >= LEAST_MARKS
    R, t = center.new_full((rows, 3, 3), torch.nan), center.new_full((rows, 3), torch.nan)
    some = posed.nonzero()[:, 0]
    if some.numel():
        found = pnp.planar(scene.table.centers[target].expand(len(some), -1, -1), flat[some], mask=seen[some])
        R, t = R.index_copy(0, some, found.R[:, 0]), t.index_copy(0, some, found.t[:, 0])
    return R, t, posed & R.isfinite().all(-1).all(-1)

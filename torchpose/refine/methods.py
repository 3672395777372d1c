"""The methods of `PoseEstimator`: how each locates centres, and the steps that it takes once there are solutions."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.constants import either
from torchpose.geometry.least_squares import Pose
from torchpose.geometry.robust import of_chance
from torchpose.geometry.rows import replace
from torchpose.pose import (
    CENTER_RMS,
    PLACE,
    Evidence,
    OnPrint,
    Setting,
    Solutions,
    center_normals,
    center_rms,
    common_center,
    compensate,
    on_print,
)
from torchpose.refine.centers import refine_centers
from torchpose.refine.decide import decide, decide_on_grey
from torchpose.refine.edges.fit import refine_edges
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.sight import LEAST_KEPT, Refined, Sight
from torchpose.results import Misfit, Reason, Status

# of the pixels, where the pose stays near: of wires over half of every ring 0.27 (measured: `wires 3` of
# `scripts/corruption_statistics.py`)
LEAST_KEPT_NEAR = 0.2
# px, by which a marker may sit beside its place before it is looked at there: edges bend little so far (convention)
BESIDE = 0.03
ROUNDS = 3  # of fits with markers where the last one found them; the second one ends nearly always

Step = Callable[[Solutions, Evidence, Sight], Solutions]
"""From solutions of N rows, what was measured of them, and the rows in their frames, to better solutions."""


@dataclass(frozen=True)
class Recipe:
    """What a method does.

    Attributes:
        correct: free the edges from what blur and curvature do to them.
        locate: centre of a ring from its two ellipses, as `pose.common_center`.
        steps: after the solution from the centres, one after the other.
        on_rims: the poses are fitted to the edges of the rings in the end, not to their centres.
        refine: what fits poses to frames; None where centres are all.
    """

    correct: bool = True
    locate: Callable[..., tuple[Tensor, Tensor]] = common_center
    steps: tuple[Step, ...] = ()
    on_rims: bool = False
    refine: Callable[..., Refined] | None = None


def _on_solved(change: Step) -> Step:
    """The step that changes the rows that have a pose, by what they saw of the markers that it explains."""

    def step(solutions: Solutions, evidence: Evidence, sight: Sight) -> Solutions:
        index = solutions.solved.nonzero()[:, 0]
        if index.numel() == 0:
            return solutions
        if len(index) == len(solutions):
            return change(solutions, replace(evidence, mask=solutions.mask), replace(sight, mask=solutions.mask))
        rows = solutions[index]
        seen, shown = replace(evidence[index], mask=rows.mask), replace(sight[index], mask=rows.mask)
        return solutions.replaced(index, change(rows, seen, shown))

    return step


def on_frames(refine: Callable[..., Refined]) -> Step:
    """The step that refines every pose on the frames themselves where that holds, and on the centres where not.

    Markers that sit beside their places are looked at where they are: what is found of the print moves them, and the
    rows are refined again. Rows whose rings are not resolved have what these tell as wholes, where they agree: a model
    of edges is off by several bounds there (0053).
    """

    def step(rows: Solutions, seen: Evidence, sight: Sight) -> Solutions:
        start, place, filed = _start(rows, seen, sight.camera)
        found, good = rows, torch.zeros_like(rows.status, dtype=torch.bool)
        active, rough = torch.arange(len(rows), device=good.device), good
        for number in range(ROUNDS):
            some = (rows, seen, sight) if number == 0 else (rows[active], seen[active], sight[active])
            some = (*some[:2], some[2].displaced(beyond(place[active], some[1])))
            # what seems to contradict the model may be a marker beside its place
            refined = refine(some[2], start.R[active], start.t[active], thorough=number > 0)
            now, joint, held = _on_print(refined, *some, place[active])
            pixels = seen.matrix[0, 0] / now.t[:, 2]
            beside = (joint.look - place[active]).abs().amax((-1, -2)) * pixels
            look, onwards = joint.look, refined.doubt & (number == 0)
            if number == 0 and refined.look is not None:
                sight = replace(sight, look=replace(refined.look, doubt=refined.doubt & (beside <= BESIDE)))
            if number > 0:
                # markers looked for where they are leave less to noise: if not, they are elsewhere. Where rims scatter,
                # a fit that drops what does claims too little: it decides nothing, and they are looked at once more
                less = torch.logdet(now.noise) < torch.logdet(found.noise[active])
                less &= refined.rough | ~rough[active]
                fresh = refined.rough & (joint.misfit != Misfit.PRINT) & (number == 1)
                moved = (place[active] - filed[active]).abs().amax((-1, -2)) * pixels > BESIDE
                held, onwards = held & (less | fresh), fresh & moved & ~less
                look, rough = look.where(~onwards[:, None, None], filed[active]), rough.index_copy(0, active, fresh)
            better = held.nonzero()[:, 0]
            found, good = found.replaced(active[better], now[better]), good.index_fill(0, active[better], True)
            start, place = start.replaced(active, Pose(now.R, now.t)), place.index_copy(0, active, look)
            # rows in doubt are looked at once more, without what contradicts the model
            active = active[(held & (beside > BESIDE)) | onwards]
            if active.numel() == 0:
                break
        bad = (~good).nonzero()[:, 0]
        if bad.numel():
            found = found.replaced(bad, _by_centers(rows[bad], seen[bad], sight.camera)[0])
        return _as_wholes(found, rows, seen, sight)

    return _on_solved(step)


def _as_wholes(found: Solutions, rows: Solutions, seen: Evidence, sight: Sight) -> Solutions:
    """The rows found, but by the rings as wholes where these are not resolved, and agree with each other."""
    plain = sight.resolved if sight.look is None else sight.resolved | (sight.look.kind > 0)
    index = (~plain).nonzero()[:, 0]
    if index.numel() == 0:
        return found
    whole = _by_centers(rows[index], seen[index], sight.camera)[0]
    agreed = (whole.misfit == 0).nonzero()[:, 0]
    return found.replaced(index[agreed], whole[agreed])


def _start(rows: Solutions, seen: Evidence, camera: Camera) -> tuple[Pose, Tensor, Tensor]:
    """Poses, and places (N, M, 5) of markers beside those of the file, as `OnPrint.look`, by the ellipses; and where
    the file has them."""
    start, place = Pose(rows.R, rows.t), -beyond(rows.t.new_zeros(*seen.mask.shape, PLACE), seen)
    place = torch.cat([place[..., :4], rows.larger[:, None, None].expand_as(place[..., 4:])], -1)
    freedom = (2 * seen.mask.sum(-1) - start.size).clamp_min(1)
    # what noise explains is found on the grey values, if it is there
    amiss = rows.chi2 > freedom * of_chance(freedom)
    if seen.by_target.shape[-1]:  # and not what an uncertain print explains, too
        amiss |= (seen.placed > BESIDE**2).flatten(1).any(-1)
    off = ((rows.rms > BESIDE) & amiss).nonzero()[:, 0]
    if off.numel() == 0:
        return start, place, place
    found, joint = _by_centers(rows[off], seen[off], camera)
    beside = torch.cat([joint.look[..., :3], place[off][..., 3:]], -1)  # centres tell of no gain
    return start.replaced(off, Pose(found.R, found.t)), place.index_copy(0, off, beside), place


def beyond(place: Tensor, seen: Evidence) -> Tensor:
    """Places (N, M, 5) with the gain beyond that of the radii in sight."""
    if seen.gain is None:
        return place
    return torch.cat([place[..., :3], place[..., 3:4] - seen.gain[:, None, None], place[..., 4:]], -1)


def _on_print(
    refined: Refined, rows: Solutions, seen: Evidence, sight: Sight, place: Tensor
) -> tuple[Solutions, OnPrint, Tensor]:
    """Rows refined on frames with markers displaced to ``place``, then on the print; and where that holds (N,) bool."""
    setting = Setting(seen, refined.R, refined.t, sight.camera, True)
    joint = on_print(refined.normals, setting, place, even=refined.even)
    found = _of_joint(rows, seen, Pose(refined.R, refined.t), joint)
    near = found.rms < torch.maximum(rows.rms, torch.full_like(rows.rms, CENTER_RMS))
    kept = (refined.kept > LEAST_KEPT) | (near & (refined.kept > LEAST_KEPT_NEAR))
    return found, joint, refined.good & joint.known & kept


def _by_centers(rows: Solutions, seen: Evidence, camera: Camera) -> tuple[Solutions, OnPrint]:
    """Rows refined on the centres of the ellipses, then on the print."""
    refined = refine_centers(seen, rows.R, rows.t)
    nowhere = rows.t.new_zeros(*seen.mask.shape, PLACE)
    joint = on_print(refined.normals, Setting(seen, refined.R, refined.t, camera, False), nowhere)
    found = _of_joint(rows, seen, Pose(refined.R, refined.t), joint)
    return found.where(joint.known & found.t.isfinite().all(-1), rows), joint


def _of_joint(rows: Solutions, seen: Evidence, pose: Pose, joint: OnPrint) -> Solutions:
    """The rows at the poses of the joint problem, from where its normal equations were formed."""
    pose = pose.moved(joint.step.nan_to_num(nan=0.0))
    better = replace(
        rows,
        R=pose.R,
        t=pose.t,
        covariance=joint.covariance,
        noise=joint.noise,
        systematic=joint.systematic,
        place=either(seen.mask[..., None], joint.place, torch.nan),
        misfit=joint.misfit,
        residual_chi2=joint.chi2,
        freedom=joint.freedom,
        rms=center_rms(seen, pose.R, pose.t),
    )
    return better.marked(joint.known & ~joint.explained & better.ok, Status.REJECTED, Reason.RESIDUAL)


def _on_centers(rows: Solutions, seen: Evidence, sight: Sight) -> Solutions:
    """Refines every pose on the ellipses' own centres, where that holds."""
    return _by_centers(rows, seen, sight.camera)[0]


def _as_they_are(rows: Solutions, seen: Evidence, sight: Sight) -> Solutions:
    """The poses of the compensated centres, with what print and camera do to them."""
    nowhere, setting = rows.t.new_zeros(*seen.mask.shape, PLACE), Setting(seen, rows.R, rows.t, sight.camera, False)
    joint = on_print(center_normals(seen, rows.R, rows.t), setting, nowhere, estimate=False)
    return _of_joint(rows, seen, Pose(rows.R, rows.t), joint).where(joint.known, rows)


METHODS = {
    "photometric": Recipe(
        steps=(decide, decide_on_grey, on_frames(refine_photometric)), on_rims=True, refine=refine_photometric
    ),
    "edges": Recipe(steps=(decide, on_frames(refine_edges)), on_rims=True, refine=refine_edges),
    "centers": Recipe(steps=(decide, _on_solved(_on_centers))),
    "paper": Recipe(correct=False, locate=compensate, steps=(_on_solved(_as_they_are),)),
}
"""By name, as `PoseEstimator` and the command line take it."""

"""Boards of equal marks that look the same after a turn: which way round they are, as far as anything tells.

A regular board tells nothing. One whose marks were measured does: turned, its marks would sit beside their places.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.robust import of_chance
from torchpose.grids import Grid
from torchpose.identify import Scene
from torchpose.pose.outcome import Found
from torchpose.pose.solutions import AMBIGUOUS_CHI2, Solutions
from torchpose.results import Reason, Status

Solve = Callable[[Int[Tensor, " R"], Int[Tensor, "R M"]], Found]
"""Evidence and solutions of some of the rows, with other rings for their markers."""


@checked
def right_way_round(scene: Scene, found: Found, solve: Solve) -> Found:
    """Rows whose boards may be turned, turned where that explains what was seen better; then no more `turnable`.

    Only boards of which the target's file says how well the places of their marks are known can be told.
    """
    for target, grid in enumerate(scene.table.layouts):
        if grid is None or not len(grid.turns) or not bool(scene.table.by_print[target, :, :3].any()):
            continue
        row = found.solvable[(found.identified.turnable & (scene.target == target))[found.solvable]]
        if row.numel():
            found = _turned(scene, found, row, (target, grid), solve)
    return found


def _turned(scene: Scene, found: Found, row: Tensor, board: tuple[int, Grid], solve: Solve) -> Found:
    """The same for rows (R,) of one target."""
    target, grid = board
    ids = scene.table.ids[target, scene.table.valid[target]]
    ring, place = found.identified.ring[row], torch.searchsorted(found.solvable, row)
    rings = [ring, *(_renumbered(ring, ids, numbers) for numbers in grid.turns)]
    ways = [solve(row, other) for other in rings]
    chi2 = torch.stack([_chi2(way, len(row)) for way in ways])
    (best, second), which = chi2.topk(2, dim=0, largest=False)
    freedom = 6 * ((ring >= 0).sum(-1) - 1)  # of every centre two numbers, and four of a ring's shapes
    sure = (second - best > AMBIGUOUS_CHI2) & (best < freedom * of_chance(freedom))
    identified, evidence, solutions = found.identified, found.evidence, found.solutions
    turnable = identified.turnable.index_copy(0, row, identified.turnable[row] & ~sure)
    identified = replace(identified, turnable=turnable)
    for number, way in enumerate(ways):
        some = (sure & (which[0] == number)).nonzero()[:, 0]
        if number == 0 or some.numel() == 0:
            continue
        identified = replace(identified, ring=identified.ring.index_copy(0, row[some], rings[number][some]))
        evidence = evidence.replaced(row[some], way.evidence[some])
        solutions = solutions.replaced(place[some], way.solutions[torch.searchsorted(way.solvable, some)])
    return found._replace(identified=identified, evidence=evidence, solutions=solutions)


def _chi2(way: Found, rows: int) -> Float[Tensor, " R"]:
    """Of every row; infinite where it has no pose that explains it."""
    chi2 = torch.where(way.solutions.status == Status.OK, way.solutions.chi2, torch.inf)
    return chi2.new_full((rows,), torch.inf).index_copy(0, way.solvable, chi2.nan_to_num(nan=torch.inf))


def _renumbered(ring: Int[Tensor, "R M"], ids: Int[Tensor, " m"], numbers: Int[Tensor, " P"]) -> Int[Tensor, "R M"]:
    """Rings by marker where the mark that had a number of the board has that of ``numbers``."""
    of_number = ring.new_full((len(ring), len(numbers)), -1)
    of_number[:, numbers[ids]] = ring[:, : len(ids)]
    turned = torch.full_like(ring, -1)
    turned[:, : len(ids)] = of_number[:, ids]
    return turned


@checked
def still_open(scene: Scene, found: Found) -> Solutions:
    """The solutions with the board turned for the other one where nothing tells which way round it is."""
    solutions, row = found.solutions, found.solvable
    open_ones = found.identified.turnable[row] & (solutions.status == Status.OK)
    for target, grid in enumerate(scene.table.layouts):
        if grid is None:
            continue
        some: Bool[Tensor, " S"] = open_ones & (scene.target[row] == target)
        middle = 0.5 * (grid.points.amin(0) + grid.points.amax(0)).to(solutions.t)
        half = rotations.exp(solutions.t.new_tensor([0.0, 0.0, torch.pi]))
        other = replace(
            solutions,
            R_alt=solutions.R @ half,
            t_alt=solutions.t + (solutions.R @ (middle - half @ middle)[:, None])[..., 0],
            rms_alt=solutions.rms,
            chi2_alt=solutions.chi2,
        )
        solutions = other.where(some, solutions).marked(some, Status.AMBIGUOUS, Reason.TWO_SOLUTIONS)
    return solutions

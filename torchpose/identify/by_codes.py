"""Stage: rings that their codes name without a question: each one marker, and every marker one ring.

Then nothing is to be guessed, and a pose on which all markers agree says that the codes were right. Where it does not,
or where a code is missing, shared or clipped, `identify` asks the geometry of the target.
"""

import torch

from torchpose.geometry.arguments import checked
from torchpose.identify.assignments import Codes, Marks
from torchpose.identify.markers import Identified, likely_gain
from torchpose.identify.scene import Scene
from torchpose.rings import Rings


@checked
def by_codes(scene: Scene, rings: Rings) -> Identified | None:
    """The rings by marker, without a rough pose; None where there is any question in any frame.

    Args:
        scene: a row for every frame and target.
        rings: of all frames.
    """
    table, rows = scene.table, len(scene.frame)
    every = table.valid & table.coded[:, None]
    if len(rings) == 0 or len(rings) != len(scene.frames) * int(every.sum()) or bool(rings.clipped.any()):
        return None
    outer, inner = table.radii.unbind(-1)
    marks = Marks(outer[None], inner[None], table.half_gap[None, :, None], table.gain_scale[None, :, None])
    codes = Codes.of(rings, marks)
    could = (codes.mismatch < 1) & every & (rings.polarity[:, None, None] == table.polarity[:, None])
    place = could.nonzero()
    ring, target, marker = place.unbind(-1)
    if len(ring) != len(rings) or not bool((ring[1:] > ring[:-1]).all()):
        return None
    row = rings.frame * len(table) + target
    of_marker = torch.full((rows, every.shape[1]), -1, device=ring.device).index_put((row, marker), ring)
    own = Codes(*(code[ring, target, marker] for code in codes))
    gain = likely_gain(own, torch.ones_like(ring, dtype=torch.bool), row, table.gain_scale[scene.target])
    if not bool((own.under(gain[row]) < 1).all()) or int((of_marker >= 0).sum()) < len(rings):
        return None
    nowhere = torch.full((rows, 3, 4), torch.nan, dtype=torch.float64, device=ring.device)
    group, none = scene.group, torch.zeros(rows, dtype=torch.bool, device=ring.device)
    proposal = torch.stack([row, marker, ring], -1)
    return Identified(group, of_marker, nowhere[..., :3], nowhere[..., 3], torch.ones_like(group), gain, none, proposal)

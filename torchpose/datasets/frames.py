"""The frames of a plan as tensors, without files: a data set of torch for whoever trains or tests on them."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.utils.data import Dataset

from torchpose.datasets.dataset import analytic, simulated_frames
from torchpose.datasets.plan import Plan, load_plan


class Sample(NamedTuple):
    """A frame as the plan's sensor delivers it, uint8 or uint16, and its true pose, mm; or a batch of them."""

    frame: Shaped[Tensor, "*B H W"]
    R: Float[Tensor, "*B 3 3"]
    t: Float[Tensor, "*B 3"]


class SimulatedFrames(Dataset[Sample]):
    """Item i is frame i of a plan, the same as `torchpose simulate` writes: it depends on the plan alone.

    A `torch.utils.data.DataLoader` has a batch rendered in one go; with ``num_workers`` several side by side.

    Args:
        plan: as such, or the path of its file.

    Raises:
        ConfigError: the file is no plan.
    """

    def __init__(self, plan: Plan | str | PathLike[str]) -> None:
        self.plan = plan if isinstance(plan, Plan) else load_plan(Path(plan))

    def __len__(self) -> int:
        return len(self.plan)

    def __getitem__(self, number: int) -> Sample:
        if not -len(self) <= number < len(self):
            raise IndexError(f"{number}: the plan has {len(self)} frames")
        return self.__getitems__([number % len(self)])[0]

    def __getitems__(self, numbers: Sequence[int]) -> list[Sample]:
        """Several at once; torch's data loader asks for those of a batch."""
        which = torch.as_tensor(numbers, dtype=torch.int64)
        frames, part = simulated_frames(self.plan, analytic(self.plan), which), self.plan[which]
        return [Sample(*each) for each in zip(frames.clone(), part.R, part.t, strict=True)]

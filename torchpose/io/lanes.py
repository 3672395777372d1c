"""Sequences side by side: batches of frames that each follow the last frame of their lane, for tracking.

A frame after the other would be a batch of one each, which costs several times as much a frame as a batch of sixteen.
So sequences are cut into stretches that are worked on side by side; the first frame of a stretch has no last pose, and
is searched all over.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from torchpose.io.sources import Source

_LONGEST = 32  # frames of a stretch: of its frames 3 % are searched all over (convention)
_SHORTEST = 8  # frames, of which an eighth is searched (convention)
_GROUPS = 16  # that there should be, for processes to share (convention)


@dataclass(frozen=True)
class Lanes:
    """Stretches of sequences that are worked on side by side.

    Attributes:
        batches: batch k holds the frames k of those stretches that are as long.
        lane: number of the stretch that a frame is of, by the frame's name.
    """

    batches: list[list[Source]]
    lane: dict[str, int]

    def __iter__(self) -> Iterator[Source]:
        """All frames."""
        return (source for batch in self.batches for source in batch)


def in_lanes(sources: Sequence[Source], size: int) -> list[Lanes]:
    """All frames, in lanes of up to ``size`` stretches.

    The frames of a folder, of a film, or of one camera of a manifest follow each other in the order given. A film is
    one stretch: it is decoded from its beginning on.
    """
    sequences: dict[Any, list[Source]] = {}
    for source in sources:
        sequences.setdefault(source.film or source.path.parent, []).append(source)
    length = min(max(_SHORTEST, len(sources) // (size * _GROUPS)), _LONGEST)
    stretches = []
    for frames in sequences.values():
        step = len(frames) if frames[0].film is not None else length
        stretches += [frames[first : first + step] for first in range(0, len(frames), step)]
    stretches.sort(key=len, reverse=True)  # those of a group end together
    return [_side_by_side(stretches[first : first + size]) for first in range(0, len(stretches), size)]


def _side_by_side(stretches: Sequence[Sequence[Source]]) -> Lanes:
    batches = [[one[k] for one in stretches if k < len(one)] for k in range(len(stretches[0]))]
    return Lanes(batches, {source.name: lane for lane, one in enumerate(stretches) for source in one})

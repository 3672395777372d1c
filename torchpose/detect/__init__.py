"""Stage: candidate ellipses in whole batches of frames, by parallel region growing and a-contrario validation."""

from torchpose.detect.candidates import find_candidates, find_coarse
from torchpose.detect.lines import Segments
from torchpose.detect.reduce import reduction_factor
from torchpose.detect.shapes import Shapes, find_shapes
from torchpose.detect.validation import Candidates, Verdict, Wanted, merge_duplicates, same_ellipses

__all__ = [
    "Candidates",
    "Segments",
    "Shapes",
    "Verdict",
    "Wanted",
    "find_candidates",
    "find_coarse",
    "find_shapes",
    "merge_duplicates",
    "reduction_factor",
    "same_ellipses",
]

"""Stage: candidate ellipses in whole batches of frames, by parallel region growing and a-contrario validation."""

from torchpose.detect.candidates import Candidates, find_candidates

__all__ = ["Candidates", "find_candidates"]

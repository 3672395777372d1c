"""Stage: one pose from all cameras that see a target at one moment."""

from torchpose.moments.outcome import joined
from torchpose.moments.refined import refine_moments
from torchpose.moments.start import Start, begin
from torchpose.moments.views import Moments, View

__all__ = ["Moments", "Start", "View", "begin", "joined", "refine_moments"]

"""Simulation: frames with known truth."""

from torchpose.sim.renderer import add_noise, render
from torchpose.sim.truth import Truth, read_truth, write_truth

__all__ = ["Truth", "add_noise", "read_truth", "render", "write_truth"]

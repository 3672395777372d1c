"""Simulation: frames with known truth."""

from torchpose.sim.renderer import Defocus, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.sim.shapes import Shapes
from torchpose.sim.truth import Truth, read_truth, write_truth

__all__ = ["Defocus", "Lighting", "Shapes", "Truth", "add_noise", "read_truth", "render", "write_truth"]

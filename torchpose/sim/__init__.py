"""Simulation: frames with known truth."""

from torchpose.sim.renderer import Defocus, Imaging, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.sim.shapes import Shapes

__all__ = ["Defocus", "Imaging", "Lighting", "Shapes", "add_noise", "render"]

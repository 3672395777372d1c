"""Simulation: frames with known truth."""

from torchpose.sim.faults import faults_of, with_faults
from torchpose.sim.renderer import Defocus, Imaging, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.sim.shapes import Shapes

__all__ = ["Defocus", "Imaging", "Lighting", "Shapes", "add_noise", "faults_of", "render", "with_faults"]

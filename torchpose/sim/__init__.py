"""Simulation: frames with known truth."""

from torchpose.sim.faults import faults_of, with_faults
from torchpose.sim.prints import PrintErrors, Prints, printed
from torchpose.sim.renderer import Defocus, Imaging, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.sim.shapes import Shapes

__all__ = [
    "Defocus",
    "Imaging",
    "Lighting",
    "PrintErrors",
    "Prints",
    "Shapes",
    "add_noise",
    "faults_of",
    "printed",
    "render",
    "with_faults",
]

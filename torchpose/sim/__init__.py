"""Simulation: frames with known truth."""

from torchpose.sim.disturbances import Disturbances, SensorPattern, disturbed, read_out
from torchpose.sim.faults import faults_of, with_faults
from torchpose.sim.prints import PrintErrors, Prints, printed
from torchpose.sim.processing import Processing, processed
from torchpose.sim.renderer import Defocus, Imaging, render
from torchpose.sim.sensor import Lighting, add_noise
from torchpose.sim.shapes import Shapes
from torchpose.sim.texture import Texture

__all__ = [
    "Defocus",
    "Disturbances",
    "Imaging",
    "Lighting",
    "PrintErrors",
    "Prints",
    "Processing",
    "SensorPattern",
    "Shapes",
    "Texture",
    "add_noise",
    "disturbed",
    "faults_of",
    "printed",
    "processed",
    "read_out",
    "render",
    "with_faults",
]

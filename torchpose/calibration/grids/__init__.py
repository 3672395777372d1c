"""Boards of equal discs or rings in views to calibrate with: their marks, and the centres by the grey values."""

from torchpose.calibration.grids.centers import measure_marks, sizes_of_marks
from torchpose.calibration.grids.marks import Marks, find_marks
from torchpose.grids import Grid

__all__ = ["Grid", "Marks", "find_marks", "measure_marks", "sizes_of_marks"]

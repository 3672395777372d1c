"""Boards of equal discs or rings in views to calibrate with: their marks, and the centres by the grey values."""

from torchpose.calibration.grids.centers import measure_marks, nominal_board, sizes_of_marks
from torchpose.calibration.grids.marks import Marks, find_marks
from torchpose.grids import Grid

__all__ = ["Grid", "Marks", "find_marks", "measure_marks", "nominal_board", "sizes_of_marks"]

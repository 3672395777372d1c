"""Boards of equal discs or rings on a grid: which mark is which, and its centre by the grey values."""

from torchpose.calibration.grids.board import Grid
from torchpose.calibration.grids.centers import measure_marks, sizes_of_marks
from torchpose.calibration.grids.marks import Marks, find_marks

__all__ = ["Grid", "Marks", "find_marks", "measure_marks", "sizes_of_marks"]

"""Boards of equal discs or rings on a grid: what they are, and which ellipse of a frame is which of the marks."""

from torchpose.grids.board import GRID_EXAMPLES, Grid
from torchpose.grids.lattice import Lattice, order_marks
from torchpose.grids.placement import LEAST_MARKS, place_patches

__all__ = ["GRID_EXAMPLES", "LEAST_MARKS", "Grid", "Lattice", "order_marks", "place_patches"]

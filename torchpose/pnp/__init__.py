"""Perspective-n-point: camera pose from points or lines, batched, every method behind one calling convention."""

from torchpose.pnp.candidates import Candidates
from torchpose.pnp.planar import planar
from torchpose.pnp.result import PnPCode, PnPError, PnPResult
from torchpose.pnp.solve import solve

__all__ = ["Candidates", "PnPCode", "PnPError", "PnPResult", "planar", "solve"]

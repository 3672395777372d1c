"""Perspective-n-point: camera pose from points or lines, batched, every method behind one calling convention."""

from torchpose.pnp.candidates import Candidates
from torchpose.pnp.dlt import dlt
from torchpose.pnp.epnp import epnp
from torchpose.pnp.few import MOST as FEW
from torchpose.pnp.lines import lines
from torchpose.pnp.p3p import p3p
from torchpose.pnp.pairs import pair_minima, planar_starts
from torchpose.pnp.planar import planar
from torchpose.pnp.posit import posit
from torchpose.pnp.result import PnPCode, PnPError, PnPResult
from torchpose.pnp.solve import Method, solve

__all__ = [
    "FEW",
    "Candidates",
    "Method",
    "PnPCode",
    "PnPError",
    "PnPResult",
    "dlt",
    "epnp",
    "lines",
    "p3p",
    "pair_minima",
    "planar",
    "planar_starts",
    "posit",
    "solve",
]

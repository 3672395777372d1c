"""Poses from points that several cameras see: rays that do not meet in one point (generalised cameras)."""

from torchpose.pnp.several.rays import Rays
from torchpose.pnp.several.solve import solve_rays, solve_rig

__all__ = ["Rays", "solve_rays", "solve_rig"]

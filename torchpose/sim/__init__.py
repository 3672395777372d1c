"""Simulation: frames with known truth."""

from torchpose.sim.renderer import add_noise, render

__all__ = ["add_noise", "render"]

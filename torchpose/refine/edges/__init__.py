"""Refinement on the edge points of the rings."""

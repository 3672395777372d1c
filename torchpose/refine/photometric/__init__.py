"""Refinement on the grey values around the rings."""

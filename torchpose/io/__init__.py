"""Frames in, rows out: streaming readers and result tables that survive a killed run."""

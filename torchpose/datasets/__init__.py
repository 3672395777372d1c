"""Simulated data sets: plans, and frames written with their truth and bound."""

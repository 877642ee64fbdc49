"""Reproduces Section 4 of the paper in simulation."""

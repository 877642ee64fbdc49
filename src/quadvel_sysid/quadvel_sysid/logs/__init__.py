"""Measured logs of joints: readers for all formats, and the checks before identification."""

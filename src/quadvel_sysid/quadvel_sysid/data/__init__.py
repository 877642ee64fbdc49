"""Samples of all logs at the instants of the drive, their split, noise and preparation."""

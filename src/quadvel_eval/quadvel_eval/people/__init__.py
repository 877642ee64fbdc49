"""Measures person detection and tracking in laser scans, on recorded scans and simulated scenes."""

"""Whole runs in one process, faster than real time: grids, segments, reports. Needs no torch."""

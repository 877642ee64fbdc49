"""Benchmark of velocity tracking in simulation, for policy files of anybody."""

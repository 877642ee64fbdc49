"""Measures person following: real tracker and planner, with a planar robot or a simulated one."""

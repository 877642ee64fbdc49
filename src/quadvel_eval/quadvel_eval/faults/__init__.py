"""Fault campaign: injects faults at random instants and measures the robot's reaction."""

"""How well persons are found and tracked in laser scans: real ones, and those of simulated scenes in the plane."""

"""What the corrected model is used for: parameters of the simulator, replays on a robot."""

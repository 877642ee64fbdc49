"""How well a person is followed, in simulated scenes in the plane: the real tracker and planner, a robot without dynamics."""

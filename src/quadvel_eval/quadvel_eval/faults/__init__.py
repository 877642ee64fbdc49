"""The fault campaign: what goes wrong at random instants, what the robot does then, and how soon."""

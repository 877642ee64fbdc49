"""What the robot is: joint table, limits, postures, kinematics, symmetry, MJCF and URDF of the Unitree AlienGo."""

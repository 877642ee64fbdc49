"""Model of the Unitree AlienGo: joints, limits, postures, kinematics, symmetry, MJCF, URDF."""

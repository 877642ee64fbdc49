"""Name of the robot that a file belongs to: policy, estimator, actuator model or recording."""

UNNAMED_ROBOT = "aliengo"
"""Robot of a file without a name; such files are older than the names."""

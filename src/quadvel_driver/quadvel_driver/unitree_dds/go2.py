"""The Go2 for its driver: names and limits of the joints."""

import numpy as np

from quadvel_driver.driven_robot import DrivenRobot

LEGS, KINDS = ("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")
# Ranges of the joints, rad; those of the thighs differ between front and rear legs.
_FRONT_LOWER, _FRONT_UPPER = (-1.0472, -1.5708, -2.7227), (1.0472, 3.4907, -0.83776)
_REAR_LOWER, _REAR_UPPER = (-1.0472, -0.5236, -2.7227), (1.0472, 4.5379, -0.83776)

GO2 = DrivenRobot(
    name="Go2",
    joint_names=tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in KINDS),
    command_lower=np.array([*_FRONT_LOWER, *_FRONT_LOWER, *_REAR_LOWER, *_REAR_LOWER]),
    command_upper=np.array([*_FRONT_UPPER, *_FRONT_UPPER, *_REAR_UPPER, *_REAR_UPPER]),
    torque_limit=np.tile([23.7, 23.7, 45.43], 4),  # N m
    velocity_limit=np.full(12, 30.0),  # rad/s, at which a drive has no torque left
    no_state_hint="is the robot on, is it an EDU model, and is this its network interface and DDS domain?",
)
"""Names and limits of the Go2's joints, from its public models."""

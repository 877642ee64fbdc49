"""The AlienGo for its driver."""

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import COMMAND_LOWER, COMMAND_UPPER, TORQUE_LIMIT, VELOCITY_LIMIT

from .driven_robot import DrivenRobot

ALIENGO = DrivenRobot(
    name="AlienGo",
    joint_names=JOINT_NAMES,
    command_lower=COMMAND_LOWER,
    command_upper=COMMAND_UPPER,
    torque_limit=TORQUE_LIMIT,
    velocity_limit=VELOCITY_LIMIT,
    no_state_hint="is the robot on and in low-level mode, and is this the right network?",
    dropped_out_mode=8,
)
"""Names and limits of the AlienGo's joints."""

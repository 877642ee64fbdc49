"""What a driver has to know of its robot: names and limits of the joints, codes of the board. No ROS."""

from __future__ import annotations

import attrs

from quadvel_description.arrays import Array


@attrs.frozen(eq=False)
class DrivenRobot:
    """Joints of one kind of robot, in the order of commands and states.

    Attributes:
        name: Name of the robot.
        joint_names: Names of the joints, n of them, legs in the order FR, FL, RR, RL.
        command_lower: Least target that a drive accepts, (n,), rad.
        command_upper: Largest one, (n,), rad.
        torque_limit: Largest feed-forward torque, (n,), N m.
        velocity_limit: Largest target speed, (n,), rad/s.
        no_state_hint: What to look at if no state arrives.
        dropped_out_mode: Mode of a motor that the board has switched off; None if it is not known.
    """

    name: str
    joint_names: tuple[str, ...]
    command_lower: Array
    command_upper: Array
    torque_limit: Array
    velocity_limit: Array
    no_state_hint: str
    dropped_out_mode: int | None = None

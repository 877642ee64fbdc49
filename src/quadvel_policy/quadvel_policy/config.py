"""Parameters of the supervisor and of its parts. Knows no ROS.

`supervisor`, `control_loop` and `transitions` use it; `guard.GuardConfig` has the limits of the
guards.
"""

from __future__ import annotations

import attrs

from quadvel_description.fields import field, positive
from quadvel_description.robot import Robot

from .command_limits import JointCommandLimits
from .guard import FALL_TIME_S, GuardConfig

MAX_STIFFNESS, MAX_DAMPING = 1000.0, 50.0
"""N m/rad and N m s/rad; larger gains make the legs oscillate."""

MAX_TRIM = 0.3
"""m/s and rad/s; a larger steady error is no small difference of drives or ground."""


@attrs.frozen(kw_only=True)
class SupervisorConfig:
    """Gains and durations of the modes; limits of joint commands and guards; each is a node parameter."""

    joint_limits: JointCommandLimits = JointCommandLimits()
    guards: GuardConfig = GuardConfig()
    auto_stand: bool = field(False, "stand up once, automatically, as soon as the robot reports")
    require_operator: bool = field(False, "walk only after ~/enable_walking was called (set it on a robot)")
    stand_kp: float = positive(
        150.0, "gain of standing up, stance and lying down, N m/rad", at_most=MAX_STIFFNESS
    )
    stand_kd: float = positive(
        4.0, "damping of standing up, stance and lying down, N m s/rad", at_most=MAX_DAMPING
    )
    damping_kd: float = positive(5.0, "damping when passive or in fault, N m s/rad", at_most=MAX_DAMPING)
    fold_time: float = positive(0.8, "first part of standing up: to the lying posture, s", at_most=60.0)
    rise_time: float = positive(1.2, "second part of standing up: to the nominal posture, s", at_most=60.0)
    settle_time: float = positive(0.3, "from walking back to the nominal posture, s", at_most=60.0)
    lie_down_time: float = positive(1.0, "from standing to the lying posture, s", at_most=60.0)
    blend_time: float = positive(0.15, "over which the policy's torques fade in, s", at_most=FALL_TIME_S)
    max_velocity_trim: float = field(
        0.1,
        "largest change of a constant velocity command that removes a steady error, m/s and rad/s; 0: none",
        at_least=0.0,
        at_most=MAX_TRIM,
    )
    reset_gap: float = positive(
        0.02, "time without a state after which the policy's memory is reset, s", at_most=FALL_TIME_S
    )
    max_posture_error: float = positive(
        0.35, "largest joint error at which the robot counts as standing, rad", at_most=1.5
    )
    max_standing_speed: float = positive(
        0.1, "largest speed at which walking may end in a posture, m/s", at_most=1.0
    )
    brake_time: float = positive(
        0.6, "in which the policy brings the robot to a stand after a fault, s", at_most=FALL_TIME_S
    )

    def check(self, robot: Robot) -> None:
        """Check the limits against what the drives of a robot can do.

        Args:
            robot: The robot.

        Raises:
            ValueError: Limits are larger, so that they would limit nothing; names them all.
        """
        torque = float(robot.torque_limit.max())
        power = float(robot.torque_limit @ robot.velocity_limit)  # of all drives at their limits
        too_large = [
            f"{name}: found {getattr(record, name)}, expected at most {most:g}"
            for record, name, most in (
                (self.joint_limits, "max_torque_step", 2.0 * torque),  # from one torque limit to the other
                (self.joint_limits, "max_power", power),
                (self.guards, "max_torque_error", torque),
            )
            if getattr(record, name) > most
        ]
        if too_large:
            raise ValueError(f"{'; '.join(too_large)}, what the drives of {robot.title} can do")

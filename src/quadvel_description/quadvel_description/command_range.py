"""Joint targets beyond the command range: a clipped target plus feed-forward torque (decision 18).

A soft gain needs targets far from the joint to produce torque. At 30 N m/rad, targets within the
range of a bent knee give about 24 N m, half of the available torque. The part of a target that lies
beyond the range is therefore sent as feed-forward torque, so that the joint torque is the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .robot import Robot

STOP_STIFFNESS_NM_PER_RAD = 100.0
"""Largest feed-forward torque toward a mechanical stop by the remaining distance to it."""


def clip_to_command_range(robot: Robot, target: ArrayLike) -> Array:
    """Clip joint targets to the command range.

    Args:
        robot: The robot.
        target: Joint targets, (..., 12), rad.

    Returns:
        Clipped targets, (..., 12), rad.
    """
    return np.minimum(np.maximum(target, robot.command_lower), robot.command_upper)


def split_target(robot: Robot, target: ArrayLike, kp: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Split joint targets into targets within the command range and feed-forward torques.

    Args:
        robot: The robot.
        target: Joint targets, (..., 12), rad.
        kp: Proportional gains, (..., 12) or a number, N m/rad.
        q: Measured joint positions, (..., 12), rad.

    Returns:
        Clipped targets, (..., 12), rad, and torques, (..., 12), N m.
    """
    target, kp, q = (np.asarray(x, float) for x in (target, kp, q))
    sent = clip_to_command_range(robot, target)
    torque: Array = kp * (target - sent)
    # tau = kp (target - clip(target)), bounded by the drive's limit; toward a mechanical stop it
    # decreases to zero over the last part: |tau| <= min(K_stop * distance, tau_max).
    if np.count_nonzero(torque):
        limit = robot.torque_limit
        up = np.minimum(np.maximum(STOP_STIFFNESS_NM_PER_RAD * (robot.upper - q), 0.0), limit)
        down = np.minimum(np.maximum(STOP_STIFFNESS_NM_PER_RAD * (q - robot.lower), 0.0), limit)
        torque = np.minimum(np.maximum(torque, -down), up)
    return sent, torque

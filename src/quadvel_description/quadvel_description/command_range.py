"""Joint targets beyond the command range: a clipped target plus feed-forward torque (decision 18).

The command range holds the targets that the drives accept: `Robot.command_lower` and
`command_upper`. With a small kp, only a target far from the joint gives much torque. At
kp = 30 N m/rad, targets in the range of a bent knee give about 24 N m, half of the available
torque. The excess of a target over the range, times kp, is therefore sent as feed-forward torque:
the joint torque is the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .robot import Robot

STOP_STIFFNESS_NM_PER_RAD = 100.0
"""Largest feed-forward torque toward a mechanical stop, per radian of distance to the stop."""


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

"""Joint targets beyond the command range: a clipped target plus feed-forward torque (decision 18).

A soft gain needs targets far from the joint to produce torque. At 30 N m/rad, targets within the
range of a bent knee give about 24 N m, half of the available torque. The part of a target that lies
beyond the range is therefore sent as feed-forward torque, so that the joint torque is the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .robot import COMMAND_LOWER, COMMAND_UPPER, LOWER, TORQUE_LIMIT, UPPER

STOP_STIFFNESS_NM_PER_RAD = 100.0
"""Largest feed-forward torque toward a mechanical stop by the remaining distance to it."""


def clip_to_command_range(target: ArrayLike) -> Array:
    """Clip joint targets to the command range.

    Args:
        target: Joint targets, (..., 12), rad.

    Returns:
        Clipped targets, (..., 12), rad.
    """
    return np.minimum(np.maximum(target, COMMAND_LOWER), COMMAND_UPPER)


def split_target(target: ArrayLike, kp: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Split joint targets into targets within the command range and feed-forward torques.

    Args:
        target: Joint targets, (..., 12), rad.
        kp: Proportional gains, (..., 12) or a number, N m/rad.
        q: Measured joint positions, (..., 12), rad.

    Returns:
        Clipped targets, (..., 12), rad, and torques, (..., 12), N m.
    """
    target, kp, q = (np.asarray(x, float) for x in (target, kp, q))
    sent = clip_to_command_range(target)
    torque: Array = kp * (target - sent)
    # tau = kp (target - clip(target)), bounded by the drive's limit; toward a mechanical stop it
    # decreases to zero over the last part: |tau| <= min(K_stop * distance, tau_max).
    if np.count_nonzero(torque):
        up = np.minimum(np.maximum(STOP_STIFFNESS_NM_PER_RAD * (UPPER - q), 0.0), TORQUE_LIMIT)
        down = np.minimum(np.maximum(STOP_STIFFNESS_NM_PER_RAD * (q - LOWER), 0.0), TORQUE_LIMIT)
        torque = np.minimum(np.maximum(torque, -down), up)
    return sent, torque

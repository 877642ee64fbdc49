"""What the drives are asked for where a joint target lies beyond the range of commands (docs/decisions/0018).

A soft gain needs targets far from the joint to push with: at 30 N m/rad a bent knee gets no more than some 24 N m out of
targets within its range, half of what it can give. What a target has beyond the range goes along as feed-forward torque,
so that the joint does what the whole target would make it do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .robot import COMMAND_LOWER, COMMAND_UPPER, LOWER, TORQUE_LIMIT, UPPER

STOP_STIFFNESS = 100.0  # N m/rad: so much torque into a mechanical stop for the way that is left to it

Array = NDArray[np.float64]


def held(target: ArrayLike) -> Array:
    """Targets (..., 12), rad, held to the range of commands."""
    return np.minimum(np.maximum(target, COMMAND_LOWER), COMMAND_UPPER)


def within_range(target: ArrayLike, kp: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Targets (rad) held to the range of commands, and the torques (N m) that stand for the rest; (..., 12) all.

    target, q: rad, wanted and measured; kp: N m/rad. A torque towards a mechanical stop fades out on the last of the way,
    and none is beyond the drive's limit.
    """
    target, kp, q = (np.asarray(x, float) for x in (target, kp, q))
    sent = held(target)
    torque: Array = kp * (target - sent)
    if torque.any():
        up = np.minimum(np.maximum(STOP_STIFFNESS * (UPPER - q), 0.0), TORQUE_LIMIT)
        down = np.minimum(np.maximum(STOP_STIFFNESS * (q - LOWER), 0.0), TORQUE_LIMIT)
        torque = np.minimum(np.maximum(torque, -down), up)
    return sent, torque

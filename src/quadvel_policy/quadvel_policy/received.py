"""Validation of received velocities and time stamps.

`command_mux` and `control_loop` act on values that passed these checks.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadvel_description.arrays import Array
from quadvel_nodes.messages import BackInTimeError, MessageError, NotFiniteError


class StampCheck:
    """Refuses stamps that are far from the clock, or older than the stamp before."""

    def __init__(self, limit: float) -> None:
        """Create a check.

        Args:
            limit: Largest deviation of a stamp from the clock, s.
        """
        self._limit = limit
        self._stamp = self._now = -math.inf

    def check(self, stamp: float, now: float) -> None:
        """Check one stamp; a clock that was set back restarts the check of the order.

        Args:
            stamp: Stamp of the message, s.
            now: Time on the same clock, s.

        Raises:
            MessageError: The stamp is too far from the clock.
            BackInTimeError: The stamp is older than the one before.
        """
        if now < self._now:
            self._stamp = -math.inf
        self._now = now
        if not abs(now - stamp) <= self._limit:  # also refuses NaN
            ago = f"{now - stamp:.3f} s old" if stamp < now else f"{stamp - now:.3f} s ahead of the clock"
            raise MessageError(f"stamp is {ago}, expected at most {self._limit:.3f} s")
        if stamp < self._stamp:
            raise BackInTimeError(f"stamp is {self._stamp - stamp:.3f} s older than the one before")
        self._stamp = stamp


def planar_velocity(twist: Any) -> Array:
    """Read the planar part of a twist.

    Args:
        twist: A geometry_msgs/Twist.

    Returns:
        vx, vy (m/s) and wz (rad/s), (3,).

    Raises:
        NotFiniteError: A number is not finite.
    """
    for field in ("linear", "angular"):
        values = [getattr(getattr(twist, field), axis) for axis in "xyz"]
        if not all(map(math.isfinite, values)):
            raise NotFiniteError(f"{field} is {values}, expected finite numbers")
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z])

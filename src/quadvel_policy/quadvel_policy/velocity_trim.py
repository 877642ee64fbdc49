"""Trim of a constant velocity command, so that the mean of the velocity reaches it.

A policy walks a little slower, faster or sideways on drives and ground that its training did not have.
The trim removes that steady error: it adds the integral of the error to the command. The velocity is that
of the controller's Kalman filter, which needs no training on that ground. Knows no ROS.
"""

from __future__ import annotations

import math

import numpy as np

from quadvel_description.arrays import Array

from .observation import CONTROL_PERIOD_S, VelocityCommandLimits

SETTLING_S = 0.5
"""Time constant after which the robot counts as having followed a change of the command."""
SETTLED = 0.03
"""m/s and rad/s, largest distance of a command from its low-pass at which the trim integrates."""
INTEGRATION_S = 1.0
"""Time constant of the integral, and of its decay while the command changes; twice SETTLING_S, so that the
loop through the robot does not oscillate.
"""

_BISECTIONS = 8
"""Halvings to find how much of a trim the limits leave: a 256th of it."""
_ROUND_OFF = 1e-9
"""m/s and rad/s by which sums of a command and its trim may miss the bound."""

Axes = tuple[float, float, float]
ZERO: Axes = (0.0, 0.0, 0.0)


class VelocityTrim:
    """Adds a bounded integral of the velocity error to the command of a policy.

    With the command c and its low-pass s (SETTLING_S), the estimated velocity v and the trim i, all of
    (vx, vy, wz):

        i' = (c - v) / INTEGRATION_S  where |c - s| <= SETTLED on all axes
        i' = -i / INTEGRATION_S       elsewhere: the command changes
        i  = 0                        in stance, or for a zero velocity: the robot brakes

    with |i| <= bound and c + i within the limits of the policy, which gets c + i. The limits couple the
    axes: more speed leaves less turn rate. So i is shortened until no axis loses more than its bound.

    Attributes:
        trim: The present trim i of vx, vy (m/s) and wz (rad/s).
    """

    def __init__(self, limits: VelocityCommandLimits, bound: float) -> None:
        """Create a trim of zero.

        Args:
            limits: Velocities that the policy can follow.
            bound: Largest trim of each axis, m/s and rad/s; 0: commands are not changed.
        """
        self._limits, self._bound = limits, bound
        self._settling_share = 1.0 - math.exp(-CONTROL_PERIOD_S / SETTLING_S)
        self._decay = math.exp(-CONTROL_PERIOD_S / INTEGRATION_S)
        self.reset()

    def reset(self) -> None:
        """Set the trim to zero, for a robot that stands."""
        self._slow_command, self.trim = ZERO, ZERO

    def apply(self, command: Array, velocity: Array, yaw_rate: float) -> Array:
        """Integrate the error of one tick.

        Args:
            command: vx, vy (m/s), wz (rad/s), stance (0 or 1), within limits, (4,).
            velocity: Velocity of the trunk by the Kalman filter, body frame, (3,), m/s.
            yaw_rate: Measured turn rate, body frame, rad/s.

        Returns:
            The command for the policy, (4,).
        """
        if not self._bound:
            return command
        vx, vy, wz, stance = command.tolist()
        wanted = vx, vy, wz
        distance = self._follow(wanted)
        if stance >= 0.5 or not any(wanted):
            self.trim = ZERO
            return command
        if distance <= SETTLED:
            errors = vx - float(velocity[0]), vy - float(velocity[1]), wz - yaw_rate
            trim = (i + e * CONTROL_PERIOD_S / INTEGRATION_S for i, e in zip(self.trim, errors, strict=True))
            ix, iy, iz = (min(max(i, -self._bound), self._bound) for i in trim)
        else:
            ix, iy, iz = (i * self._decay for i in self.trim)
        px, py, pz = self._add(wanted, (ix, iy, iz))
        self.trim = px - vx, py - vy, pz - wz
        return np.array([px, py, pz, stance])

    def _add(self, wanted: Axes, trim: Axes) -> Axes:
        """Add the longest part of a trim that changes no axis by more than the bound, within the limits."""
        found = self._add_share(wanted, trim, 1.0)
        if self._is_near(found, wanted):
            return found
        low, high, found = 0.0, 1.0, wanted
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            tried = self._add_share(wanted, trim, middle)
            if self._is_near(tried, wanted):
                low, found = middle, tried
            else:
                high = middle
        return found

    def _add_share(self, wanted: Axes, trim: Axes, share: float) -> Axes:
        """Add a share of a trim to a command and clamp the sum to the limits of the policy."""
        return self._limits.clamp(c + share * i for c, i in zip(wanted, trim, strict=True))

    def _is_near(self, found: Axes, wanted: Axes) -> bool:
        """Whether each axis lies within the bound of the command."""
        return max(abs(p - c) for p, c in zip(found, wanted, strict=True)) <= self._bound + _ROUND_OFF

    def _follow(self, wanted: Axes) -> float:
        """Update the low-pass of the command; return the command's largest distance from it, m/s or rad/s."""
        sx, sy, sz = (
            s + self._settling_share * (c - s) for c, s in zip(wanted, self._slow_command, strict=True)
        )
        self._slow_command = sx, sy, sz
        return max(abs(c - s) for c, s in zip(wanted, self._slow_command, strict=True))

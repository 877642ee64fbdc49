"""The operator's intent: a velocity while a control is held, and a latched STOP. No ROS, no page.

Page, keyboard and gamepad work alike: each repeats its hold, and the hold ends when the repeats
stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quadvel_description.arrays import Array

HOLD_TIMEOUT_S = 0.4
"""Time without a repeat after which a hold ends; repeats come at 20 Hz, but a browser may stall."""
LATE_GAP_S = 0.2
"""Gap between two repeats of a hold from which they are late."""
LATE_DISPLAY_S = 2.0
"""Time for which late repeats are reported."""
ZERO_DURATION_S = 0.5
"""Time of zero velocity after a hold; then other sources may command the robot."""
PUBLISH_PERIOD_S = 0.05
"""Time between two published velocities."""
STOP_RETRY_S = 0.25
"""Time after which an unacknowledged STOP is sent again."""
BRAKING_MODES = ("passive", "fault")
"""Modes with damped joints."""
MAX_VELOCITY = np.array([3.2, 2.0, 3.0])
"""Largest vx, vy (m/s), wz (rad/s) that an operator can command."""


class Operator:
    """Holds and STOP of one operator station.

    Attributes:
        stopped: Whether STOP is latched.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._holder: object = None
        self._velocity = np.zeros(3)
        self._held_at = self._ended_at = -math.inf
        self._held_since = self._late_at = -math.inf
        self._late_by = 0.0

    def hold(self, holder: object, velocity: Sequence[float], now: float) -> None:
        """Start or repeat a hold, at least every HOLD_TIMEOUT_S.

        Other holders are ignored meanwhile.

        Args:
            holder: Identity of the page or device.
            velocity: vx, vy (m/s), wz (rad/s).
            now: s.

        Raises:
            ValueError: The velocity is not three finite numbers.
        """
        wanted = np.array(velocity, float)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            raise ValueError(f"velocity is {list(velocity)}, expected three finite numbers")
        if self._is_held(now) and holder != self._holder:
            return
        is_repeat = holder == self._holder and self._held_at > -math.inf
        if is_repeat and now - self._held_at > LATE_GAP_S:
            self._late_at, self._late_by = now, now - self._held_at
        if not is_repeat:
            self._held_since = now
        self._holder, self._held_at = holder, now
        self._velocity = np.clip(wanted, -MAX_VELOCITY, MAX_VELOCITY)

    def end_hold(self, holder: object, now: float) -> None:
        """End the hold of a holder.

        Args:
            holder: As for `hold`.
            now: s.
        """
        if holder == self._holder and self._held_at > -math.inf:
            self._held_at, self._ended_at = -math.inf, min(now, self._held_at + HOLD_TIMEOUT_S)

    def stop(self) -> None:
        """Latch STOP: no velocity until `release`."""
        self.stopped = True
        self._held_at = self._ended_at = -math.inf

    def release(self) -> None:
        """Release the STOP. Earlier holds do not resume."""
        self.stopped = False
        self._held_at = self._ended_at = -math.inf

    def should_resend_stop(self, mode: str, since: float) -> bool:
        """Return whether an unacknowledged STOP is due to be sent again.

        Args:
            mode: Mode of the robot, "" if unknown.
            since: Time since it was last sent, s.

        Returns:
            True if STOP is latched, STOP_RETRY_S have passed, and the joints are not damped.
        """
        return self.stopped and since > STOP_RETRY_S and mode not in BRAKING_MODES

    def hold_duration(self, now: float) -> float:
        """Return the duration of the present hold.

        Args:
            now: s.

        Returns:
            s; 0 without a hold.
        """
        return now - self._held_since if self._is_held(now) else 0.0

    def message_gap(self, now: float) -> float:
        """Return the last late gap between repeats within LATE_DISPLAY_S.

        Args:
            now: s.

        Returns:
            s; 0 if no repeat was late.
        """
        return self._late_by if now - self._late_at <= LATE_DISPLAY_S else 0.0

    def velocity(self, now: float) -> Array | None:
        """Return the velocity to publish now.

        Args:
            now: s.

        Returns:
            (3,) vx, vy (m/s), wz (rad/s): the held one, then zeros for ZERO_DURATION_S; None if
            nothing is to be published.
        """
        if self.stopped:
            return None
        if self._is_held(now):
            return self._velocity.copy()
        ended = max(self._ended_at, self._held_at + HOLD_TIMEOUT_S)
        return np.zeros(3) if now - ended <= ZERO_DURATION_S else None

    def _is_held(self, now: float) -> bool:
        """Return whether a hold is active."""
        return now - self._held_at <= HOLD_TIMEOUT_S

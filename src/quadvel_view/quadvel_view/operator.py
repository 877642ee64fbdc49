"""What the operator wants: a velocity while something is held down, and a STOP that stays. No ROS, no page.

Page, keyboard and gamepad are alike here: each says what is held, again and again, and silence means that it was let go.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SILENCE = 0.4
"""s without a word from who holds, after which it counts as let go: twenty words a second are expected, but a browser may stall"""
LATE = 0.2
"""s between two words of who holds, from which on they are late"""
LATE_SHOWN = 2.0
"""s for which late words are reported"""
AFTERGLOW = 0.5
"""s of zeros once all is let go; then whoever else commands the robot has its turn"""
PERIOD = 0.05
"""s from one velocity to the next"""
STOP_AGAIN = 0.25
"""s after which a STOP that was not heeded is said again"""
BRAKING = ("passive", "fault")
"""Modes in which the joints brake"""
TOP_SPEED = np.array([3.2, 2.0, 3.0])
"""m/s, m/s, rad/s: no hand asks for more"""


class Operator:
    """Who holds what. stopped: whether STOP was pressed and not released since."""

    def __init__(self) -> None:
        self.stopped = False
        self._holder: object = None
        self._velocity = np.zeros(3)
        self._held_at = self._let_go_at = -math.inf
        self._held_since = self._late_at = -math.inf
        self._late_by = 0.0

    def hold(self, holder: object, velocity: Sequence[float], now: float) -> None:
        """`holder` holds this velocity (vx, vy in m/s, wz in rad/s), and says so at least every SILENCE (s).

        While one holds, others are not listened to. Raises ValueError for what is no velocity.
        """
        wanted = np.array(velocity, float)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            raise ValueError(f"velocity is {list(velocity)}, expected three finite numbers")
        if self._is_held(now) and holder != self._holder:
            return
        goes_on = holder == self._holder and self._held_at > -math.inf
        if goes_on and now - self._held_at > LATE:
            self._late_at, self._late_by = now, now - self._held_at
        if not goes_on:
            self._held_since = now
        self._holder, self._held_at = holder, now
        self._velocity = np.clip(wanted, -TOP_SPEED, TOP_SPEED)

    def let_go(self, holder: object, now: float) -> None:
        """`holder` holds nothing any more."""
        if holder == self._holder and self._held_at > -math.inf:
            self._held_at, self._let_go_at = -math.inf, min(now, self._held_at + SILENCE)

    def stop(self) -> None:
        """STOP: no velocity any more until `release`."""
        self.stopped = True
        self._held_at = self._let_go_at = -math.inf

    def release(self) -> None:
        """End the STOP. What was held when it came does not count."""
        self.stopped = False
        self._held_at = self._let_go_at = -math.inf

    def is_unheeded(self, mode: str, since: float) -> bool:
        """Whether STOP has to be said again, `since` (s) it was said last. mode: the robot's, "" where it is not known."""
        return self.stopped and since > STOP_AGAIN and mode not in BRAKING

    def held_for(self, now: float) -> float:
        """For how long a velocity has been held, s; 0 where none is."""
        return now - self._held_since if self._is_held(now) else 0.0

    def lateness(self, now: float) -> float:
        """How far apart words of who holds came in the last LATE_SHOWN, s; 0 where none was late."""
        return self._late_by if now - self._late_at <= LATE_SHOWN else 0.0

    def velocity(self, now: float) -> Array | None:
        """What is to be published now: the velocity that is held, zeros for a while after it, or None: nothing."""
        if self.stopped:
            return None
        if self._is_held(now):
            return self._velocity.copy()
        ended = max(self._let_go_at, self._held_at + SILENCE)
        return np.zeros(3) if now - ended <= AFTERGLOW else None

    def _is_held(self, now: float) -> bool:
        return now - self._held_at <= SILENCE

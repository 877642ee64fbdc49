"""Time of the robot without stalls: stamps of states, minus the time in which a simulated robot stood still.

Stamps come from the clock of the machine, ticks from the clock of the robot. If the machine stalls
together with its simulated robot, stamps advance but ticks do not: the next state follows the last
one, and no reaction is late. A real robot moves on during a stall of the machine, and so do its
ticks.
"""

from __future__ import annotations

import math

STAMP_JITTER_S = 0.01
"""s, deviation of stamps from ticks that does not count as a stall."""
_TICK_MODULUS = 2**32
_MAX_TICK_STEP_S = 1e-3 * _TICK_MODULUS / 2  # a larger difference means that the tick went back


class StallFreeClock:
    """Converts the stamps of one robot's states to stall-free time.

    Attributes:
        stalled: Time that the robot stood still and that is left out, since the start, s.
    """

    def __init__(self) -> None:
        self.stalled = 0.0
        self._last: tuple[float, int] | None = None  # stamp (s) and tick (ms) of the last state
        self._time = 0.0  # s, stall-free time of the last state
        self._was_waiting = False  # whether the robot's time stood still at that state
        # Before the last stall: the time left out until then, and the stall-free time of its begin, s.
        self._stalled_before, self._stall_began = 0.0, math.inf

    @property
    def tick(self) -> int | None:
        """Tick of the last state, ms; None before the first state."""
        return None if self._last is None else self._last[1]

    def update(self, stamp: float, tick: int, max_stall: float = math.inf, is_waiting: bool = False) -> float:
        """Take the next state and return its stall-free time.

            standstill = (stamp - stamp of the last state) - (tick - tick of the last state)

        A standstill beyond STAMP_JITTER_S, up to `max_stall`, is left out.

        Args:
            stamp: Time of the state, s.
            tick: Clock of the robot, ms, modulo 2^32. If it does not advance, only the stamp
                counts.
            max_stall: Longest standstill to leave out, s.
            is_waiting: Whether the robot reports that its time stands still; then any standstill is
                left out.

        Returns:
            Stall-free time of the state, s.
        """
        time = stamp - self.stalled
        if self._last is not None:
            tick_elapsed = 1e-3 * ((tick - self._last[1]) % _TICK_MODULUS)
            standstill = stamp - self._last[0] - tick_elapsed
            tolerance = 0.0 if is_waiting or self._was_waiting else STAMP_JITTER_S
            if (is_waiting and tick_elapsed < _MAX_TICK_STEP_S) or (
                tick_elapsed > 0.0 and tolerance < standstill <= max_stall
            ):
                time = self._time + tick_elapsed
                self._exclude_stall(stamp - time - self.stalled, time if is_waiting else self._time)
        self._last, self._time, self._was_waiting = (stamp, tick), time, is_waiting
        return time

    def _exclude_stall(self, standstill: float, began: float) -> None:
        """Leave out a standstill (s) that began at the stall-free time `began` (s), or extend the last one."""
        if began != self._stall_began:
            self._stalled_before, self._stall_began = self.stalled, began
        self.stalled += standstill

    def on_clock_set(self, change: float) -> None:
        """Account for a step of the clock of the stamps.

        Args:
            change: The step, s, positive if the clock was set forward.
        """
        self.stalled += change
        self._stalled_before += change
        if self._last is not None:
            self._last = self._last[0] + change, self._last[1]

    def time_at(self, stamp: float) -> float:
        """Convert a stamp to stall-free time, back to the standstill before the last one.

        A message about a state can arrive after the state that ended a standstill. During the
        standstill, stall-free time is constant.

        Args:
            stamp: Time of the message, s.

        Returns:
            Stall-free time, s.
        """
        return max(stamp - self.stalled, min(stamp - self._stalled_before, self._stall_began))

"""The robot's own time: that of its stamps, less what it stood still itself.

Stamps are on the clock of the machine, ticks on the robot's own. Where a machine stalls together with the robot that it
simulates, its clock goes on without the robot: what the robot does next follows what it did last, and nobody missed
anything. A real robot lives on meanwhile, and its ticks tell so.
"""

from __future__ import annotations

import math

JITTER = 0.01  # s, by which stamps may be off the ticks for other reasons
_WRAP = 2**32
_LONGEST_LIFE = 1e-3 * _WRAP / 2  # s from state to state; a tick that is further on went back


class StallFreeClock:
    """Follows the states of one robot. stalled: s that it stood still and that were left out, since the start."""

    def __init__(self) -> None:
        self.stalled = 0.0
        self._last: tuple[float, int] | None = None  # stamp, s, and tick
        self._time = 0.0  # s, the robot's, of the last state
        self._waited = False  # whether that state said that the robot's time stood still
        # Of the last standstill: what had been left out before it, and the robot's time at which it began, s.
        self._stalled_before, self._began = 0.0, math.inf

    @property
    def tick(self) -> int | None:
        """Of the last state, ms; None before the first one."""
        return None if self._last is None else self._last[1]

    def follow(self, stamp: float, tick: int, longest: float = math.inf, waiting: bool = False) -> float:
        """The robot's time of the next state.

        Args:
            stamp: When the state held, s.
            tick: The robot's own clock, ms, which wraps at 2^32. One that does not move is no clock: then stamps count.
            longest: The longest standstill to leave out, s.
            waiting: Whether the robot itself says that its time stands still at this state: then any standstill is left out.

        Returns:
            The robot's time, s.
        """
        time = stamp - self.stalled
        if self._last is not None:
            lived = 1e-3 * ((tick - self._last[1]) % _WRAP)
            standstill = stamp - self._last[0] - lived
            tolerance = 0.0 if waiting or self._waited else JITTER
            if (waiting and lived < _LONGEST_LIFE) or (lived > 0.0 and tolerance < standstill <= longest):
                time = self._time + lived
                self._leave_out(stamp - time - self.stalled, time if waiting else self._time)
        self._last, self._time, self._waited = (stamp, tick), time, waiting
        return time

    def _leave_out(self, standstill: float, began: float) -> None:
        """Leave out a standstill (s) that began at the robot's time `began` (s); it may go on from the one before."""
        if began != self._began:
            self._stalled_before, self._began = self.stalled, began
        self.stalled += standstill

    def clock_was_set(self, change: float) -> None:
        """The clock of the stamps was set by `change` (s), which is no event in the robot's life."""
        self.stalled += change
        self._stalled_before += change
        if self._last is not None:
            self._last = self._last[0] + change, self._last[1]

    def at(self, stamp: float) -> float:
        """The robot's time at any stamp (s) since the standstill before the last one.

        A message about a state may come after the state that ended a standstill. While that lasted, the robot's time stood.
        """
        return max(stamp - self.stalled, min(stamp - self._stalled_before, self._began))

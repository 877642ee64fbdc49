"""The robot's own time: that of its stamps, less what it stood still itself.

Stamps are on the clock of the machine, ticks on the robot's own. Where a machine stalls together with the robot that it
simulates, its clock goes on without the robot: what the robot does next follows what it did last, and nobody missed
anything. A real robot lives on meanwhile, and its ticks tell so.
"""

from __future__ import annotations

import math

JITTER = 0.01  # s, by which stamps may be off the ticks for other reasons
_WRAP = 2**32


class RobotTime:
    """Follows the states of one robot. stalled: s that it stood still and that were left out, since the start."""

    def __init__(self) -> None:
        self.stalled = 0.0
        self._last: tuple[float, int] | None = None
        # Of the last standstill: what had been left out before it, and the robot's time at which it began, s.
        self._stalled_before, self._began = 0.0, math.inf

    def follow(self, stamp: float, tick: int, longest: float = math.inf) -> float:
        """The robot's time of the next state, s. stamp: s. tick: ms, wraps. longest: standstill to leave out, s.

        A tick that does not move is no clock: then stamps count.
        """
        if self._last is not None:
            lived = 1e-3 * ((tick - self._last[1]) % _WRAP)
            standstill = stamp - self._last[0] - lived
            if lived > 0.0 and JITTER < standstill <= longest:
                self._stalled_before, self._began = self.stalled, self._last[0] - self.stalled
                self.stalled += standstill
        self._last = stamp, tick
        return stamp - self.stalled

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

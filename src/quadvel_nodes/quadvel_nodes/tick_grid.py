"""Which samples of a stream a periodic loop answers."""

from __future__ import annotations

import math


class TickGrid:
    """Picks the samples to answer: one each `period` (s) of the samples' own clock, however often they come.

    Deadlines are absolute: neither jitter nor the time that the work takes adds up.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._next: float | None = None
        self._last = -math.inf

    def periods(self, stamp: float) -> int:
        """Periods since the last answer: 0 means not due, 1 on time, more that some were missed. stamp: s."""
        if self._next is None or stamp < self._last:
            self._next = stamp
        due = math.floor((stamp - self._next) / self._period + 0.5) + 1
        if due > 0:
            self._next += due * self._period
            self._last = stamp
        return max(due, 0)

"""Which samples of a stream a periodic loop answers."""

from __future__ import annotations

import math

FOLLOW = 0.02
"""Share of how far a sample is off its deadline by which the deadlines after it move: samples have a clock of their own,
which drifts away from any that stands still, and at the border between two periods every jitter would lose or double one"""


class TickGrid:
    """Picks the samples to answer: one each `period` (s) of the samples' own clock, however often they come.

    Deadlines do not depend on when samples are answered: neither jitter nor the time that the work takes adds up.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._next: float | None = None
        self._last = self._before = -math.inf  # stamps of the last answer, and of the sample before
        self._spacing, self._seen = (
            period,
            0,
        )  # s from sample to sample in the mean, and how many it is the mean of

    def periods(self, stamp: float) -> int:
        """Periods since the last answer: 0 means not due, 1 on time, more that some were missed. stamp: s."""
        if self._next is None or stamp < self._last:
            self._next = self._before = stamp
        elapsed, self._before = stamp - self._before, stamp
        if elapsed > 0.0:
            self._seen += 1
            share = max(1.0 / self._seen, FOLLOW)
            self._spacing += share * (min(elapsed, 2.0 * self._period) - self._spacing)
        early = 0.5 * min(self._spacing, self._period)  # the nearest sample, be it a little before its time
        due = math.floor((stamp - self._next + early) / self._period) + 1
        if due > 0:
            deadline = self._next + (due - 1) * self._period
            self._next = deadline + self._period + FOLLOW * (stamp - deadline)
            self._last = stamp
        return max(due, 0)

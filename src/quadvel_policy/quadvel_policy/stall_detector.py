"""Tells a robot that fell silent from a process that could not listen. It measures no time itself.

After a stall of the machine the newest message known is old, while newer ones wait to be read, or their sender
has just woken up, too. A process knows its own stalls by its timer, which came late.
"""

from __future__ import annotations

import math


class StallDetector:
    """Notices when this process did not run, and excuses silence for a period after that, once.

    count: how often it did not, since the start. lost: s in which it did not, since the last message.
    """

    def __init__(self, period: float, tolerance: float) -> None:
        """`look` is called by a timer of this period (s) at least; later by more than `tolerance` (s) is a pause."""
        self.count = 0
        self.lost = 0.0
        self._period = period
        self._tolerance = tolerance
        self._looked: float | None = None
        self._waits_until: float | None = None  # None: no pause since the last message

    def poll(self, now: float) -> None:
        """This process runs at `now` (s)."""
        if self._looked is not None and now - self._looked > self._period + self._tolerance:
            self.count += 1
            self.lost += now - self._looked
            if self._waits_until is None:
                self._waits_until = now + self._period
        self._looked = now

    def heard(self) -> None:
        """A message fit to use came."""
        self._waits_until = None
        self.lost = 0.0

    @property
    def since_heard(self) -> bool:
        """Whether there was a pause since the last message."""
        return self._waits_until is not None

    def excuse(self, now: float) -> bool:
        """Whether nothing can be said at `now` (s) about who is silent."""
        return now <= (-math.inf if self._waits_until is None else self._waits_until)

"""Detection of stalls of this process, to distinguish them from a silent robot.

It reads no clock: the caller passes the time. After a stall the last message seems too old, although
newer ones wait to be read, or their sender stalled, too. A process detects its own stall by a timer that fires late.
"""

from __future__ import annotations

import math


class StallDetector:
    """Detects that this process did not run, and excuses silence for one period after that.

    Further stalls do not prolong the excuse until a message arrives.

    Attributes:
        count: Number of stalls since the start.
        stalled_s: Sum of the intervals between calls of `poll` that held a stall, since the last message, s.
    """

    def __init__(self, period: float, tolerance: float) -> None:
        """Create a detector.

        Args:
            period: Longest time between two calls of `poll` by a timer, s.
            tolerance: A call that is later by more than this is a stall, s.
        """
        self.count = 0
        self.stalled_s = 0.0
        self._period = period
        self._tolerance = tolerance
        self._last_poll: float | None = None
        self._excused_until: float | None = None  # None: no stall since the last message

    def poll(self, now: float) -> None:
        """Record that this process runs.

        Args:
            now: Time, s.
        """
        if self._last_poll is not None and now - self._last_poll > self._period + self._tolerance:
            self.count += 1
            self.stalled_s += now - self._last_poll
            if self._excused_until is None:
                self._excused_until = now + self._period
        self._last_poll = now

    def on_message(self) -> None:
        """Record that a valid message arrived."""
        self._excused_until = None
        self.stalled_s = 0.0

    @property
    def has_stalled(self) -> bool:
        """Whether there was a stall since the last message."""
        return self._excused_until is not None

    def excuses_silence(self, now: float) -> bool:
        """Return whether silence may be due to a recent stall.

        Args:
            now: Time, s.

        Returns:
            True until one period after the first stall since the last message.
        """
        return now <= (-math.inf if self._excused_until is None else self._excused_until)

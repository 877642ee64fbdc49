"""Log lines about a machine that is too slow for real time: immediately, then once a minute."""

from __future__ import annotations

from math import inf

SUMMARY_PERIOD_S = 60.0


class SlownessLog:
    """Limits the warnings about lost real time, so that other warnings stay visible."""

    def __init__(self) -> None:
        self._reported = 0.0  # s of lost real time that a line has reported
        self._next = -inf  # s, before which no line is due

    def next_line(self, now: float, lost: float) -> str:
        """Return the line that is due.

        Args:
            now: Present time on a clock that is not set back, s.
            lost: Real time since the start that was not simulated, s.

        Returns:
            The line, or "".
        """
        new, is_first = lost - self._reported, self._next == -inf
        if new <= 0.0 or now < self._next:
            return ""
        self._reported, self._next = lost, now + SUMMARY_PERIOD_S
        lost_time = f"this machine is too slow: {new:.2f} s of real time given up"
        return (
            f"{lost_time}; more is summed up once a minute"
            if is_first
            else f"{lost_time} since the last line"
        )

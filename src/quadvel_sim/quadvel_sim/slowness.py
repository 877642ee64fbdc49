"""What a log says of a machine that is too slow for real time: the first time at once, then a summary a minute. No ROS."""

from __future__ import annotations

from math import inf

SUMMARY_PERIOD_S = 60.0


class SlownessLog:
    """Keeps warnings about lost real time from burying all others in a log."""

    def __init__(self) -> None:
        self._reported = 0.0  # s of lost real time that a line has reported
        self._next = -inf  # s, before which no line is due

    def line(self, now: float, lost: float) -> str:
        """The line that is due, or "".

        Args:
            now: s, on a clock that is not set back.
            lost: s of real time that were not simulated, since the start.
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

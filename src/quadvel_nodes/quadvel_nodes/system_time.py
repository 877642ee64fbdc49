"""Conversion of the monotonic clock to stamps of messages in system time. For node files only."""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time

DRIFT_TOLERANCE_NS = 10**6  # ns; stamps follow the system clock only after a larger drift


class SystemTime:
    """Tracks the offset from the monotonic to the system clock, without copying its jitter."""

    def __init__(self) -> None:
        self._offset_ns, self._error_ns = _clock_offset_ns()

    def stamp(self, instant: float) -> Any:
        """Convert a time of the monotonic clock to a stamp.

        Args:
            instant: Time on the monotonic clock, s.

        Returns:
            The system time, a builtin_interfaces/Time.
        """
        shift, error = _clock_offset_ns()
        was_set = abs(shift - self._offset_ns) > DRIFT_TOLERANCE_NS + self._error_ns + error
        if was_set or error + DRIFT_TOLERANCE_NS < self._error_ns:
            self._offset_ns, self._error_ns = shift, error
        return as_time(round(instant * 1e9) + self._offset_ns)


def _clock_offset_ns() -> tuple[int, int]:
    """Return the offset of the system clock from the monotonic clock, and its largest error, ns.

    A loaded machine may pause the process for tens of ms between two readings.
    """
    before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return now - before, after - before


def as_time(nanoseconds: int) -> Any:
    """Convert nanoseconds to a stamp.

    Args:
        nanoseconds: System time, ns.

    Returns:
        A builtin_interfaces/Time.
    """
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

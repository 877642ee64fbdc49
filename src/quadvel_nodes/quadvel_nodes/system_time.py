"""Instants of a steady clock as stamps of messages, which are in the system's time. For node files only."""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time

TOLERANCE = 10**6  # ns that system and monotonic clock may drift apart before the stamps follow


class SystemTime:
    """Follows how far the system's clock is from the monotonic one, without taking over its jitter."""

    def __init__(self) -> None:
        self._shift = time.time_ns() - time.monotonic_ns()

    def stamp(self, instant: float) -> Any:
        """An instant of the monotonic clock, s, as a builtin_interfaces/Time."""
        before = time.monotonic_ns()
        shift = time.time_ns() - before
        at_once = (
            time.monotonic_ns() - before < 0.5 * TOLERANCE
        )  # else a pause may look like a clock that was set
        if at_once and abs(shift - self._shift) > TOLERANCE:
            self._shift = shift
        return as_time(round(instant * 1e9) + self._shift)


def as_time(nanoseconds: int) -> Any:
    """A builtin_interfaces/Time."""
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

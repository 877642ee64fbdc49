"""Instants of a steady clock as stamps of messages, which are in the system's time. For node files only."""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time

TOLERANCE = 10**6  # ns that system and monotonic clock may drift apart before the stamps follow


class SystemTime:
    """Follows how far the system's clock is from the monotonic one, without taking over its jitter."""

    def __init__(self) -> None:
        self._shift, self._error = _shift()

    def stamp(self, instant: float) -> Any:
        """An instant of the monotonic clock, s, as a builtin_interfaces/Time."""
        shift, error = _shift()
        was_set = abs(shift - self._shift) > TOLERANCE + self._error + error
        if was_set or error + TOLERANCE < self._error:
            self._shift, self._error = shift, error
        return as_time(round(instant * 1e9) + self._shift)


def _shift() -> tuple[int, int]:
    """How far the system's clock is ahead of the monotonic one, ns, and by how much that may be wrong.

    The process may be paused between two readings, for tens of ms on a loaded machine.
    """
    before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return now - before, after - before


def as_time(nanoseconds: int) -> Any:
    """A builtin_interfaces/Time."""
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

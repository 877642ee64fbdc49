"""Clocks: system time, steady time, and ROS time, which /clock may drive."""

from __future__ import annotations

import time

from quadvel_dds.errors import Partial

from .time import ClockType as ClockType
from .time import Time


class Clock(Partial):
    """A system, steady or ROS clock. ROS time is system time, or that of /clock with use_sim_time.

    With use_sim_time a node sets ROS time to 0 until the first message of /clock. Its timers follow
    /clock directly, and the steady clock otherwise: they do not call `now`.

    Attributes:
        clock_type: Type of the clock.
    """

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        """Create a clock.

        Args:
            clock_type: Type of the clock.
        """
        self.clock_type = ClockType(clock_type)
        self._simulated_ns: int | None = None  # latest value of /clock, if it drives this clock

    def now(self) -> Time:
        """Return the present time.

        Returns:
            Time of this clock.
        """
        return Time(nanoseconds=self._now_ns(), clock_type=self.clock_type)

    def _now_ns(self) -> int:
        if self._simulated_ns is not None:
            return self._simulated_ns
        return time.monotonic_ns() if self.clock_type is ClockType.STEADY_TIME else time.time_ns()

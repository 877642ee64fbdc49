"""Clocks: system, steady, and ROS time, which a simulator may drive through /clock."""

from __future__ import annotations

import time

from quadvel_dds.errors import Partial

from .time import ClockType as ClockType
from .time import Time


class Clock(Partial):
    """ROS time is system time until it is driven by /clock (parameter use_sim_time of a node)."""

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = ClockType(clock_type)
        self._simulated_ns: int | None = None  # what /clock said last, where it counts

    def now(self) -> Time:
        return Time(nanoseconds=self._now_ns(), clock_type=self.clock_type)

    def _now_ns(self) -> int:
        if self._simulated_ns is not None:
            return self._simulated_ns
        return time.monotonic_ns() if self.clock_type == ClockType.STEADY_TIME else time.time_ns()

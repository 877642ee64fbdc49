"""Clocks: system, steady, and ROS time, which a simulator may drive through /clock."""

from __future__ import annotations

import time

from quadvel_dds.errors import Partial

from .time import ClockType, Time

__all__ = ["Clock", "ClockType", "ROSClock"]


class Clock(Partial):
    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> Clock:
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        self = super().__new__(ROSClock if clock_type == ClockType.ROS_TIME else cls)
        self._clock_type = clock_type
        return self

    _clock_type: ClockType
    _simulated_ns: int | None = None  # what /clock said last, where it counts

    @property
    def clock_type(self) -> ClockType:
        return self._clock_type

    def __repr__(self) -> str:
        return f"Clock(clock_type={self.clock_type.name})"

    def now(self) -> Time:
        return Time(nanoseconds=self._now_ns(), clock_type=self.clock_type)

    def _now_ns(self) -> int:
        if self._simulated_ns is not None:
            return self._simulated_ns
        return time.monotonic_ns() if self.clock_type == ClockType.STEADY_TIME else time.time_ns()


class ROSClock(Clock):
    """System time until it is driven by /clock (parameter use_sim_time of the node)."""

    def __new__(cls) -> ROSClock:
        self = super().__new__(cls, clock_type=ClockType.ROS_TIME)
        assert isinstance(self, ROSClock)
        return self

    def __init__(self, *, clock_type: ClockType = ClockType.ROS_TIME) -> None:
        """Clock(clock_type=ROS_TIME) is one of these, and hands its argument on."""

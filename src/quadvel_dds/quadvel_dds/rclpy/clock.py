"""Clocks: system, steady, and ROS time, which a simulator may drive through /clock."""

from __future__ import annotations

import time
from threading import Condition
from typing import Any

from quadvel_dds.errors import unsupported

from .clock_type import ClockType
from .duration import Duration
from .time import Time

__all__ = ["Clock", "ClockType", "ROSClock"]


class Clock:
    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> Clock:
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        self = super().__new__(ROSClock if clock_type == ClockType.ROS_TIME else cls)
        self._clock_type = clock_type
        return self

    _clock_type: ClockType

    @property
    def clock_type(self) -> ClockType:
        return self._clock_type

    def __repr__(self) -> str:
        return f"Clock(clock_type={self.clock_type.name})"

    def now(self) -> Time:
        return Time(nanoseconds=self._now_ns(), clock_type=self.clock_type)

    def _now_ns(self) -> int:
        return time.monotonic_ns() if self.clock_type == ClockType.STEADY_TIME else time.time_ns()

    def _is_simulated(self) -> bool:
        return False

    def sleep_until(self, until: Time, context: Any = None) -> bool:
        """Sleep until a time of this clock; returns False if the context was shut down before."""
        from .utilities import get_default_context

        if until.clock_type != self.clock_type:
            raise ValueError("until's clock type does not match this clock's type")
        context = context or get_default_context()
        changed = Condition()

        def wake() -> None:
            with changed:
                changed.notify_all()

        context.on_shutdown(wake)
        try:
            with changed:
                while context.ok() and (left := until.nanoseconds - self._now_ns()) > 0:
                    self._wait(changed, left)
        finally:
            context._forget_shutdown_callback(wake)
        return bool(context.ok())

    def _wait(self, changed: Condition, nanoseconds: int) -> None:
        changed.wait(nanoseconds / 1e9)

    def sleep_for(self, rel_time: Duration, context: Any = None) -> bool:
        return self.sleep_until(self.now() + rel_time, context)

    create_jump_callback = unsupported("Clock.create_jump_callback")
    handle = property(unsupported("Clock.handle"))


class ROSClock(Clock):
    """System time until it is driven by /clock (parameter use_sim_time of the node)."""

    def __new__(cls) -> ROSClock:
        self = super().__new__(cls, clock_type=ClockType.ROS_TIME)
        assert isinstance(self, ROSClock)
        return self

    def __init__(self, *, clock_type: ClockType = ClockType.ROS_TIME) -> None:
        self._simulated_ns: int | None = None

    def _is_simulated(self) -> bool:
        return self._simulated_ns is not None

    def _now_ns(self) -> int:
        return time.time_ns() if self._simulated_ns is None else self._simulated_ns

    def _wait(self, changed: Condition, nanoseconds: int) -> None:
        # Simulated time does not say when it will come; its messages arrive every few milliseconds.
        changed.wait(0.001 if self._is_simulated() else nanoseconds / 1e9)

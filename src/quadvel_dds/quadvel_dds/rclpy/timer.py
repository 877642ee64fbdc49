"""Timers that keep to absolute deadlines, and rates."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event
from typing import Any

from quadvel_dds.errors import unsupported

from .clock import Clock


class Timer:
    """Calls back every `timer_period_ns`.

    Deadlines are multiples of the period from the start, on the monotonic clock (on simulated time where the
    clock is driven by /clock), so that lateness does not add up; deadlines missed while a callback ran are
    left out. Simulated time that goes back starts it anew.
    """

    def __init__(
        self,
        callback: Callable[[], Any],
        callback_group: Any,
        timer_period_ns: int,
        clock: Clock,
        *,
        context: Any = None,
        autostart: bool = True,
    ) -> None:
        if timer_period_ns < 0:
            raise ValueError(f"a timer's period must not be negative, found {timer_period_ns} ns")
        self.callback = callback
        self.callback_group = callback_group
        self._period_ns = timer_period_ns
        self._clock = clock
        self._canceled = not autostart
        self._on_change: Callable[[], None] = lambda: None
        self._restart()

    def _restart(self) -> None:
        self._simulated = self._clock._is_simulated()
        self._last_ns = self._now_ns()
        self._next_ns = self._last_ns + self._period_ns

    def _now_ns(self) -> int:
        return self._clock._now_ns() if self._simulated else time.monotonic_ns()

    @property
    def clock(self) -> Clock:
        return self._clock

    @property
    def timer_period_ns(self) -> int:
        return self._period_ns

    @timer_period_ns.setter
    def timer_period_ns(self, value: int) -> None:
        self._period_ns = int(value)
        self._on_change()

    def is_ready(self) -> bool:
        return not self._canceled and self._remaining_ns() <= 0

    def is_canceled(self) -> bool:
        return self._canceled

    def cancel(self) -> None:
        self._canceled = True

    def reset(self) -> None:
        self._canceled = False
        self._restart()
        self._on_change()

    def time_since_last_call(self) -> int:
        return self._now_ns() - self._last_ns

    def time_until_next_call(self) -> int | None:
        return None if self._canceled else self._remaining_ns()

    def destroy(self) -> None:
        self._canceled = True

    handle = property(unsupported("Timer.handle"))

    def _remaining_ns(self) -> int:
        if self._simulated != self._clock._is_simulated() or self._now_ns() < self._last_ns:  # set back
            self._restart()
        return self._next_ns - self._now_ns()

    def _wake_ns(self) -> int | None:
        """Monotonic time of the next deadline; None if only /clock can bring it."""
        remaining = self._remaining_ns()  # first: it may change over to or from simulated time
        return None if self._simulated and remaining > 0 else time.monotonic_ns() + remaining

    def _take(self) -> Callable[[], Any] | None:
        if not self.is_ready():
            return None
        now = self._now_ns()
        self._last_ns = now
        self._next_ns += self._period_ns
        behind = now - self._next_ns
        if behind > 0:
            self._next_ns += -(-behind // self._period_ns) * self._period_ns if self._period_ns else behind
        return self.callback


class Rate:
    """Sleeps to hold a frequency; another thread must spin the node."""

    def __init__(self, timer: Timer, *, context: Any) -> None:
        self._timer = timer
        self._context = context
        self._event = Event()
        timer.callback = self._event.set
        context.on_shutdown(self._event.set)

    def sleep(self) -> None:
        from .exceptions import ROSInterruptException

        self._event.clear()
        if self._context.ok():
            self._event.wait()
        if not self._context.ok():
            raise ROSInterruptException

    def destroy(self) -> None:
        self._timer.destroy()
        self._event.set()

"""Timers that keep to absolute deadlines."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from quadvel_dds.errors import Partial, module_getattr

from .clock import Clock

__getattr__ = module_getattr(__name__)


class Timer(Partial):
    """Calls back every `timer_period_ns`.

    Deadlines are multiples of the period from the start, on the monotonic clock (on simulated time where the
    clock is driven by /clock), so that lateness does not add up; deadlines missed while a callback ran are
    left out. Simulated time that goes back starts it anew.
    """

    def __init__(
        self, callback: Callable[[], Any], callback_group: Any, timer_period_ns: int, clock: Clock, *,
        context: Any = None, autostart: bool = True,
    ) -> None:  # fmt: skip
        if timer_period_ns < 0:
            raise ValueError(f"a timer's period must not be negative, found {timer_period_ns} ns")
        self.callback = callback
        self.timer_period_ns = timer_period_ns
        self.clock = clock
        self._canceled = not autostart
        self._on_change: Callable[[], None] = lambda: None
        self._restart()

    def _restart(self) -> None:
        self._simulated = self.clock._simulated_ns is not None
        self._last_ns = self._now_ns()
        self._next_ns = self._last_ns + self.timer_period_ns

    def _now_ns(self) -> int:
        return self.clock._now_ns() if self._simulated else time.monotonic_ns()

    def is_ready(self) -> bool:
        return not self._canceled and self._remaining_ns() <= 0

    def cancel(self) -> None:
        self._canceled = True

    destroy = cancel

    def reset(self) -> None:
        self._canceled = False
        self._restart()
        self._on_change()

    def _remaining_ns(self) -> int:
        changed = self._simulated != (self.clock._simulated_ns is not None)
        if changed or self._now_ns() < self._last_ns:  # set back
            self._restart()
        return self._next_ns - self._now_ns()

    def _wake_ns(self) -> int | None:
        """Monotonic time of the next deadline; None if it has none, or only /clock can bring it."""
        if self._canceled:
            return None
        remaining = self._remaining_ns()  # first: it may change over to or from simulated time
        return None if self._simulated and remaining > 0 else time.monotonic_ns() + remaining

    def _take(self) -> Callable[[], Any] | None:
        if not self.is_ready():
            return None
        self._last_ns = now = self._now_ns()
        period = self.timer_period_ns
        self._next_ns += period
        behind = now - self._next_ns
        if behind > 0:
            self._next_ns += -(-behind // period) * period if period else behind
        return self.callback

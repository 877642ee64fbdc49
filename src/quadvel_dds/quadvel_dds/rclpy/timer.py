"""Timers with absolute deadlines.

The executor waits for the next deadline and runs the callback.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from quadvel_dds.errors import Partial, module_getattr

from .clock import Clock

__getattr__ = module_getattr(__name__)


class Timer(Partial):
    """Periodic timer.

    Deadlines are multiples of the period after the start, so lateness does not accumulate; missed
    ones are skipped. The time is the monotonic clock, or simulated time if /clock drives the clock.
    If simulated time goes back, the timer restarts.

    Attributes:
        callback: Called once per period.
        timer_period_ns: Period, ns.
        clock: Clock of the timer.
    """

    def __init__(
        self, callback: Callable[[], Any], callback_group: Any, timer_period_ns: int, clock: Clock, *,
        context: Any = None, autostart: bool = True,
    ) -> None:  # fmt: skip
        """Create a timer; `Node.create_timer` calls this.

        Args:
            callback: Called once per period.
            callback_group: Ignored.
            timer_period_ns: Period, ns.
            clock: Clock of the timer.
            context: Ignored.
            autostart: Whether the timer starts now.

        Raises:
            ValueError: The period is negative.
        """
        if timer_period_ns < 0:
            raise ValueError(f"a timer's period must not be negative, found {timer_period_ns} ns")
        self.callback = callback
        self.timer_period_ns = timer_period_ns
        self.clock = clock
        self._canceled = not autostart
        self._on_change: Callable[[], None] = lambda: None
        self._restart()

    def _restart(self) -> None:
        """Put the next deadline one period from now."""
        self._simulated = self.clock._simulated_ns is not None
        self._last_ns = self._now_ns()
        self._next_ns = self._last_ns + self.timer_period_ns

    def _now_ns(self) -> int:
        return self.clock._now_ns() if self._simulated else time.monotonic_ns()

    def is_ready(self) -> bool:
        """Return whether the next deadline has passed.

        Returns:
            Whether the callback is due.
        """
        return not self._canceled and self._remaining_ns() <= 0

    def cancel(self) -> None:
        """Stop the timer."""
        self._canceled = True

    destroy = cancel

    def reset(self) -> None:
        """Restart the timer."""
        self._canceled = False
        self._restart()
        self._on_change()

    def _remaining_ns(self) -> int:
        """Return the time to the next deadline; restart if the clock was changed or set back."""
        changed = self._simulated != (self.clock._simulated_ns is not None)
        if changed or self._now_ns() < self._last_ns:  # set back
            self._restart()
        return self._next_ns - self._now_ns()

    def _wake_ns(self) -> int | None:
        """Return the monotonic time of the next deadline, or None (none, or simulated time)."""
        if self._canceled:
            return None
        if not self._simulated and self.clock._simulated_ns is None:  # the monotonic clock is never set
            return self._next_ns
        remaining = self._remaining_ns()  # first: it may change over to or from simulated time
        return None if self._simulated and remaining > 0 else time.monotonic_ns() + remaining

    def _take(self) -> Callable[[], Any] | None:
        """Return the callback if it is due, and move the deadline into the future."""
        if not self.is_ready():
            return None
        self._last_ns = now = self._now_ns()
        period = self.timer_period_ns
        self._next_ns += period
        behind = now - self._next_ns
        if behind > 0:
            self._next_ns += -(-behind // period) * period if period else behind
        return self.callback

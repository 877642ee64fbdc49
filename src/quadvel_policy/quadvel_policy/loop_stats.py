"""How well a periodic loop keeps time: percentiles of its times since the start.

It measures nothing itself; the controller hands it what it measured.
"""

from __future__ import annotations

import math
from collections import deque

import attrs
import numpy as np

MOST_OVERRUNS = 2**32 - 1  # what a uint32 of quadvel_msgs/ControllerState holds; the count stays there


class Histogram:
    """Durations from 1 us to 10 s in bins 1 % wide: percentiles since the start in constant memory."""

    _SHORTEST = 1e-6
    _WIDTH = math.log(1.01)

    def __init__(self) -> None:
        self._counts = np.zeros(math.ceil(math.log(10.0 / self._SHORTEST) / self._WIDTH) + 1, np.int64)

    def add(self, seconds: float) -> None:
        """Count one duration, s; shorter or longer ones go to the first or last bin."""
        bin = int(math.log(max(seconds, self._SHORTEST) / self._SHORTEST) / self._WIDTH)
        self._counts[min(bin, len(self._counts) - 1)] += 1

    def percentile(self, percent: float) -> float:
        """In s, within 1 %; nan before the first `add`."""
        cumulated = self._counts.cumsum()
        total = int(cumulated[-1])
        if not total:
            return math.nan
        bin = int(cumulated.searchsorted(math.ceil(percent / 100.0 * total)))
        return self._SHORTEST * math.exp((bin + 0.5) * self._WIDTH)


@attrs.frozen
class LoopSummary:
    """One look at the loop, in the units of quadvel_msgs/ControllerState."""

    rate_hz: float = 0.0
    period_p99_ms: float = math.nan
    inference_p50_us: float = math.nan
    compute_p50_us: float = math.nan
    compute_p99_us: float = math.nan
    overruns: int = 0


class LoopStats:
    """Collects the loop's times. overruns: deadlines missed since the start; in_a_row: none kept between."""

    def __init__(self) -> None:
        self._period, self._inference, self._compute = Histogram(), Histogram(), Histogram()
        self._starts: deque[float] = deque()  # of the last second
        self._last = math.nan
        self.overruns = 0
        self.in_a_row = 0

    def add(self, start: float, compute: float, inference: float, missed: int) -> None:
        """One tick: start on a steady clock, what it and the network alone took (s), deadlines missed."""
        if not math.isnan(self._last):
            self._period.add(start - self._last)
        self._last = start
        self._starts.append(start)
        self._forget_until(start - 1.0)
        self._compute.add(compute)
        if not math.isnan(inference):
            self._inference.add(inference)
        self.overruns = min(self.overruns + missed, MOST_OVERRUNS)
        self.in_a_row = self.in_a_row + missed if missed else 0

    def summary(self, now: float) -> LoopSummary:
        """Rate over the second before `now` (the clock of `add`); the rest since the start."""
        self._forget_until(now - 1.0)
        return LoopSummary(
            rate_hz=float(len(self._starts)),
            period_p99_ms=1e3 * self._period.percentile(99),
            inference_p50_us=1e6 * self._inference.percentile(50),
            compute_p50_us=1e6 * self._compute.percentile(50),
            compute_p99_us=1e6 * self._compute.percentile(99),
            overruns=self.overruns,
        )

    def _forget_until(self, start: float) -> None:
        while self._starts and self._starts[0] <= start:
            self._starts.popleft()

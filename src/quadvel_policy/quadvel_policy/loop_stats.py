"""Timing statistics of a periodic loop: rate, percentiles and overruns since the start.

The module takes no time itself; the controller passes the measured times.
"""

from __future__ import annotations

import math
from collections import deque

import attrs
import numpy as np

MAX_OVERRUN_COUNT = 2**32 - 1  # largest uint32 (quadvel_msgs/ControllerState), where the count stays


class Histogram:
    """Percentiles of durations in constant memory: bins of 1 % width from 1 us to 10 s."""

    _SHORTEST = 1e-6
    _WIDTH = math.log(1.01)

    def __init__(self) -> None:
        self._counts = [0] * (math.ceil(math.log(10.0 / self._SHORTEST) / self._WIDTH) + 1)

    def add(self, seconds: float) -> None:
        """Count one duration.

        Args:
            seconds: Duration, s; shorter or longer ones count in the first or last bin.
        """
        bin = int(math.log(max(seconds, self._SHORTEST) / self._SHORTEST) / self._WIDTH)
        self._counts[min(bin, len(self._counts) - 1)] += 1

    def percentile(self, percent: float) -> float:
        """Return a percentile of all durations.

        Args:
            percent: 0 to 100.

        Returns:
            The duration, s, within 1 %; NaN before the first `add`.
        """
        cumulated = np.cumsum(self._counts)
        total = int(cumulated[-1])
        if not total:
            return math.nan
        bin = int(cumulated.searchsorted(math.ceil(percent / 100.0 * total)))
        return self._SHORTEST * math.exp((bin + 0.5) * self._WIDTH)


@attrs.frozen
class LoopSummary:
    """Statistics of the loop, in the units of quadvel_msgs/ControllerState.

    Attributes:
        rate_hz: Rate of the ticks in the last second, Hz.
        period_p99_ms: 99th percentile of the time between ticks, ms.
        inference_p50_us: Median duration of the network, us.
        compute_p50_us: Median duration of a tick, us.
        compute_p99_us: 99th percentile of the duration of a tick, us.
        overruns: Number of missed deadlines since the start.
    """

    rate_hz: float = 0.0
    period_p99_ms: float = math.nan
    inference_p50_us: float = math.nan
    compute_p50_us: float = math.nan
    compute_p99_us: float = math.nan
    overruns: int = 0


class LoopStats:
    """Collects the times of a loop.

    Attributes:
        overruns: Number of missed deadlines since the start.
        consecutive_overruns: Number of missed deadlines since the last tick in time.
    """

    def __init__(self) -> None:
        self._period, self._inference, self._compute = Histogram(), Histogram(), Histogram()
        self._starts: deque[float] = deque()  # of the last second
        self._last = math.nan
        self.overruns = 0
        self.consecutive_overruns = 0

    def add(self, start: float, compute: float, inference: float, missed: int) -> None:
        """Count one tick.

        Args:
            start: Start of the tick on a steady clock, s.
            compute: Duration of the tick, s.
            inference: Duration of the network step, s; NaN if there was none.
            missed: Number of missed deadlines.
        """
        if not math.isnan(self._last):
            self._period.add(start - self._last)
        self._last = start
        self._starts.append(start)
        self._drop_before(start - 1.0)
        self._compute.add(compute)
        if not math.isnan(inference):
            self._inference.add(inference)
        self.overruns = min(self.overruns + missed, MAX_OVERRUN_COUNT)
        self.consecutive_overruns = self.consecutive_overruns + missed if missed else 0

    def summary(self, now: float) -> LoopSummary:
        """Summarise the statistics.

        Args:
            now: Time on the clock of `add`, s.

        Returns:
            The rate over the last second, the rest since the start.
        """
        self._drop_before(now - 1.0)
        return LoopSummary(
            rate_hz=float(len(self._starts)),
            period_p99_ms=1e3 * self._period.percentile(99),
            inference_p50_us=1e6 * self._inference.percentile(50),
            compute_p50_us=1e6 * self._compute.percentile(50),
            compute_p99_us=1e6 * self._compute.percentile(99),
            overruns=self.overruns,
        )

    def _drop_before(self, start: float) -> None:
        while self._starts and self._starts[0] <= start:
            self._starts.popleft()

"""Decimation of a fast stream to a regular lower rate. Knows no ROS."""

from __future__ import annotations


class Decimator:
    """Accepts the first sample in each period of the stream's own counter.

    Periods are fixed on the counter, so the accepted samples keep their phase: the next sample
    replaces a lost one, and the following sample is on time again.
    """

    def __init__(self, rate: int) -> None:
        """Create a decimator.

        Args:
            rate: Rate of accepted samples, Hz, at most 1000 (the rate of the counter).
        """
        self._rate = rate
        self._last: int | None = None

    def accepts(self, tick: int) -> bool:
        """Return whether a sample is the first of its period.

        Args:
            tick: Counter of the sample, ms; does not go back, but may wrap.

        Returns:
            True if the sample is accepted.
        """
        period = tick * self._rate // 1000
        first, self._last = period != self._last, period
        return first

"""Fewer samples of a fast stream, at an even rate. Knows no ROS."""

from __future__ import annotations


class Decimator:
    """Lets one sample pass in each period of the stream's own counter: the first that comes in it.

    The periods are fixed on the counter, so that what passes keeps its phase: where a sample was lost, the next one passes
    in its place, and the one after that is on time again.
    """

    def __init__(self, rate: int) -> None:
        """rate: Hz, up to that of the counter, which counts ms."""
        self._rate = rate
        self._last: int | None = None

    def passes(self, tick: int) -> bool:
        """Whether the sample with this tick (ms) is the first of its period. Ticks do not go back, but may wrap."""
        period = tick * self._rate // 1000
        first, self._last = period != self._last, period
        return first

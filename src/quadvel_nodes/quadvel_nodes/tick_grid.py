"""Selection of the samples of a stream that a periodic loop answers.

`quadvel_estimator.tracker` and `quadvel_policy.control_loop` ask it which samples to use.
"""

from __future__ import annotations

import math

PHASE_GAIN = 0.02
"""Gain with which the deadlines follow the samples. The clock of the samples drifts; with fixed
deadlines, the samples would drift to the border between two periods, where jitter loses or doubles
a tick.
"""


class TickGrid:
    """Selects one sample per period of the samples' own clock, at any sample rate.

    Deadlines lie on a grid and do not depend on when samples are answered: neither jitter nor
    computing time accumulates.
    """

    def __init__(self, period: float) -> None:
        """Create a grid.

        Args:
            period: Period of the loop, s.
        """
        self._period = period
        self._deadline: float | None = None
        self._last_answered = self._previous_sample = -math.inf  # s
        self._spacing, self._spacing_count = (
            period,
            0,
        )  # s from sample to sample in the mean, and how many it is the mean of

    def periods_due(self, stamp: float) -> int:
        """Return how many periods have passed since the last answer, and count this sample as the answer if any.

        With period T, deadline d and mean spacing s of the samples, a sample at t is due if
        t >= d - min(s, T) / 2: the nearest sample to the deadline answers. Then the deadline moves
        to the next period, plus PHASE_GAIN times the deviation of the sample from its deadline.

        Args:
            stamp: Time of the sample, s; a stamp that goes back restarts the grid.

        Returns:
            0 if the sample is not due, 1 if it is due, more if periods were missed.
        """
        if self._deadline is None or stamp < self._last_answered:
            self._deadline = self._previous_sample = stamp
        elapsed, self._previous_sample = stamp - self._previous_sample, stamp
        if elapsed > 0.0:
            self._spacing_count += 1
            share = max(1.0 / self._spacing_count, PHASE_GAIN)
            self._spacing += share * (min(elapsed, 2.0 * self._period) - self._spacing)
        early = 0.5 * min(self._spacing, self._period)  # the nearest sample answers
        due = math.floor((stamp - self._deadline + early) / self._period) + 1
        if due > 0:
            deadline = self._deadline + (due - 1) * self._period
            self._deadline = deadline + self._period + PHASE_GAIN * (stamp - deadline)
            self._last_answered = stamp
        return max(due, 0)

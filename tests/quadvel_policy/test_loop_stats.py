"""Timing statistics of a periodic loop."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadvel_dds.messages import deserialize, serialize
from quadvel_msgs.msg import ControllerState
from quadvel_policy.loop_stats import Histogram, LoopStats

PERIOD = 0.005


def test_percentiles_are_those_of_the_samples_within_one_percent() -> None:
    samples = np.random.default_rng(1).lognormal(math.log(2e-4), 0.7, 20000)
    histogram = Histogram()
    for sample in samples:
        histogram.add(sample)
    for percent in (1, 50, 99, 99.9):
        expected = np.percentile(samples, percent, method="inverted_cdf")
        assert histogram.percentile(percent) == pytest.approx(expected, rel=0.011)


def test_percentiles_of_nothing_are_nan_and_extremes_are_counted() -> None:
    histogram = Histogram()
    assert math.isnan(histogram.percentile(50))
    for sample in (0.0, 100.0):
        histogram.add(sample)
    assert histogram.percentile(50) == pytest.approx(1e-6, rel=0.01)
    assert histogram.percentile(100) == pytest.approx(10.0, rel=0.02)


def test_the_summary_is_in_the_messages_units() -> None:
    stats = LoopStats()
    for i in range(400):
        stats.add(PERIOD * i, compute=3e-4, inference=math.nan if i < 100 else 4e-5, missed=0)
    summary = stats.summary(now=PERIOD * 399)
    assert summary.rate_hz == 200
    assert summary.period_p99_ms == pytest.approx(5.0, rel=0.01)
    assert summary.inference_p50_us == pytest.approx(40.0, rel=0.01)
    assert summary.compute_p50_us == pytest.approx(300.0, rel=0.01)
    assert summary.compute_p99_us == pytest.approx(300.0, rel=0.01)
    assert summary.overruns == 0
    assert stats.summary(now=PERIOD * 399 + 5.0).rate_hz == 0


def test_missed_deadlines_in_a_row_end_with_one_that_is_kept() -> None:
    stats = LoopStats()
    for i, missed in enumerate((0, 1, 2, 1)):
        stats.add(PERIOD * i, compute=1e-3, inference=math.nan, missed=missed)
    assert (stats.overruns, stats.consecutive_overruns) == (4, 4)
    stats.add(1.0, compute=1e-3, inference=math.nan, missed=0)
    assert (stats.overruns, stats.consecutive_overruns) == (4, 0)


def test_a_clock_that_leaps_by_decades_still_gives_a_state_that_can_be_sent() -> None:
    """As where a simulator in lockstep and one in real time report to the same controller."""
    stats = LoopStats()
    for _ in range(2):
        stats.add(0.0, 1e-4, math.nan, 359_157_296_662)
    message = ControllerState(overruns=stats.summary(0.0).overruns)
    assert deserialize(serialize(message), message.TYPENAME).overruns == stats.overruns == 2**32 - 1

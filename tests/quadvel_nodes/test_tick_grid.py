"""Which samples of a stream a periodic loop answers."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_nodes.tick_grid import TickGrid

PERIOD = 0.005


def answered(stamps: np.ndarray) -> list[int]:
    grid = TickGrid(PERIOD)
    return [grid.periods_due(stamp) for stamp in stamps]


def test_every_sample_at_the_loops_own_rate_is_answered() -> None:
    assert answered(1e9 + PERIOD * np.arange(1000)) == [1] * 1000


def test_jitter_loses_no_sample_and_does_not_add_up() -> None:
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 1000)
    jitter[0] = 0.0
    assert answered(PERIOD * np.arange(1000) + jitter) == [1] * 1000


@pytest.mark.parametrize("rate", [1000, 500, 400, 333])
def test_of_faster_samples_as_many_are_answered_as_periods_passed(rate: int) -> None:
    stamps = np.arange(10 * rate) / rate
    counts = answered(stamps)
    assert set(counts) == {0, 1}
    assert sum(counts) == pytest.approx(2000, rel=1e-3)


def test_missed_periods_are_counted_and_the_grid_goes_on() -> None:
    grid = TickGrid(PERIOD)
    assert [grid.periods_due(t) for t in (0.0, 0.005, 0.030, 0.035)] == [1, 1, 5, 1]


def test_a_clock_that_is_set_back_starts_a_new_grid() -> None:
    grid = TickGrid(PERIOD)
    assert [grid.periods_due(t) for t in (100.0, 100.005, 3.0, 3.005)] == [1, 1, 1, 1]


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
@pytest.mark.parametrize("rate", [200, 1000])
def test_samples_whose_clock_drifts_are_all_answered_though_their_stamps_jitter(
    drift: float, rate: int
) -> None:
    """Clock drift of the board: after a minute, the clocks differ by more than a period."""
    jitter = np.random.default_rng(0).normal(0.0, 1e-4, 120 * rate)
    counts = np.array(answered((1.0 + drift) * np.arange(120 * rate) / rate + jitter))
    assert set(counts) == ({1} if rate == 200 else {0, 1})
    assert counts.sum() == pytest.approx(24_000, abs=5)


def test_a_first_sample_that_came_off_its_time_does_not_set_the_grid_for_good() -> None:
    stamps = PERIOD * np.arange(2000) + np.random.default_rng(0).uniform(-5e-4, 5e-4, 2000)
    stamps[0] += 0.0024
    assert set(answered(stamps)[200:]) == {1}

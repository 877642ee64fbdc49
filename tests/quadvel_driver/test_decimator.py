"""Fewer samples of a fast stream, and what a controller makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_driver.decimator import Decimator
from quadvel_nodes.tick_grid import TickGrid


def passed(ticks: list[int], rate: int = 200) -> list[int]:
    thinning = Decimator(rate)
    return [tick for tick in ticks if thinning.accepts(tick % 2**32)]


@pytest.mark.parametrize(("rate", "period"), [(200, 5), (500, 2), (1000, 1), (50, 20)])
def test_one_sample_passes_in_each_period(rate: int, period: int) -> None:
    assert passed(list(range(1000, 2000)), rate) == list(range(1000, 2000, period))


def test_where_a_sample_is_lost_the_next_one_passes_and_the_phase_stays() -> None:
    ticks = [tick for tick in range(1000, 1100) if tick not in (1005, 1020, 1021)]
    assert passed(ticks)[:7] == [1000, 1006, 1010, 1015, 1022, 1025, 1030]


def test_it_goes_on_where_the_counter_wraps() -> None:
    ticks = list(range(2**32 - 100, 2**32 + 100))
    assert np.diff(passed(ticks)).max() <= 5


def test_a_controller_answers_all_that_passes_though_samples_are_lost_and_stamps_jitter() -> None:
    rng = np.random.default_rng(0)
    sent = passed([tick for tick in range(1000, 61_000) if rng.random() > 0.1])
    grid = TickGrid(0.005)
    answered = [grid.periods_due(1e-3 * tick + rng.normal(0.0, 2e-4)) for tick in sent]
    assert np.mean(np.array(answered) == 1) > 0.99

"""When the robot lived, by its stamps and ticks."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_nodes.stall_free_clock import STAMP_JITTER_S, StallFreeClock


def lived(*samples: tuple[float, int]) -> list[float]:
    """The robot's time of each sample (stamp in s, tick in ms)."""
    time = StallFreeClock()
    return [time.update(stamp, tick) for stamp, tick in samples]


def test_where_stamps_and_ticks_agree_the_time_is_the_stamp() -> None:
    assert lived((8.0, 40), (8.005, 45), (8.205, 245)) == [8.0, 8.005, 8.205]


def test_what_the_robot_stood_still_is_left_out() -> None:
    time = StallFreeClock()
    found = [time.update(*sample) for sample in ((8.0, 40), (8.005, 45), (8.065, 50), (8.07, 55), (8.2, 60))]
    np.testing.assert_allclose(found, 8.0 + 0.005 * np.arange(5))
    assert time.stalled == pytest.approx(0.055 + 0.125)


def test_jitter_of_the_stamps_stays_and_does_not_add_up() -> None:
    jitter = np.random.default_rng(0).uniform(-0.5 * STAMP_JITTER_S, 0.5 * STAMP_JITTER_S, 1000)
    stamps = 0.005 * np.arange(1000) + np.abs(jitter)
    assert lived(*((stamp, 5 * i) for i, stamp in enumerate(stamps.tolist()))) == stamps.tolist()


def test_clocks_that_drift_apart_do_not_add_up_to_a_standstill() -> None:
    samples = [(0.00501 * i, 5 * i) for i in range(20_000)]  # 0.2 s apart at the end
    assert lived(*samples)[-1] == samples[-1][0]


def test_a_tick_may_wrap() -> None:
    np.testing.assert_allclose(lived((1.0, 2**32 - 2), (1.105, 3)), [1.0, 1.005])


@pytest.mark.parametrize("tick", [40, 30, 0])
def test_where_the_tick_stands_or_starts_over_stamps_count(tick: int) -> None:
    assert lived((8.0, 40), (8.08, tick)) == [8.0, 8.08]


def test_a_long_standstill_counts() -> None:
    time = StallFreeClock()
    time.update(8.0, 40)
    assert time.update(8.065, 45, max_stall=0.05) == 8.065


def test_a_clock_that_was_set_is_no_event_in_the_robots_life() -> None:
    time = StallFreeClock()
    time.update(8.0, 40)
    for change in (5.0, -7.0):
        time.on_clock_set(change)
        before = time.stalled
        assert time.update(8.005 + before, 45) == pytest.approx(8.005)
        assert time.stalled == before


def test_stamps_that_were_set_back_are_followed() -> None:
    np.testing.assert_allclose(lived((8.0, 40), (3.0, 45), (3.005, 50)), [8.0, 3.0, 3.005])


def test_a_stamp_from_before_a_standstill_keeps_its_place_after_it() -> None:
    time = StallFreeClock()
    states = [time.update(*sample) for sample in ((8.0, 40), (8.005, 45), (8.31, 50))]
    np.testing.assert_allclose([time.time_at(8.0), time.time_at(8.005), time.time_at(8.31)], states)
    assert time.time_at(8.2) == pytest.approx(8.005)  # the robot stood still
    assert time.time_at(8.4) == pytest.approx(8.1)
    assert StallFreeClock().time_at(3.0) == 3.0

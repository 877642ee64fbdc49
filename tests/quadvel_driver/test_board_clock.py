"""Times of states from the board's counter and the arrival times."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_driver.board_clock import OFFSET_WINDOW, UNIT_WINDOW_S, BoardClock, BoardTime

COUNTS = {1e-3: 1, 1e-6: 1000}  # a ms, by unit


def stream(clock: BoardClock, states: int, unit: float = 1e-3, first: int = 100, delay=lambda i: 0.0) -> list:
    """Times of a clock for states each ms from 50 s on, which arrive `delay` (s) late."""
    return [
        clock.update((first + i * COUNTS[unit]) % 2**32, 50.0 + 1e-3 * i + delay(i)) for i in range(states)
    ]


@pytest.mark.parametrize("unit", [1e-3, 1e-6])
def test_it_finds_out_whether_a_board_counts_milli_or_microseconds(unit: float) -> None:
    clock = BoardClock()
    instants = stream(clock, 300, unit)
    assert clock.unit == unit
    nothing = round(1e3 * UNIT_WINDOW_S) + OFFSET_WINDOW
    assert instants[: nothing - 1] == (nothing - 1) * [None]
    times = np.array([instant.time for instant in instants[nothing + 1 :]])
    np.testing.assert_allclose(times, 50.0 + 1e-3 * np.arange(nothing + 1, 300), atol=1e-9)


@pytest.mark.parametrize("unit", [1e-3, 1e-6])
@pytest.mark.parametrize("speed", [0.2, 3.0])
def test_the_unit_is_found_where_board_or_machine_are_slow_or_fast(unit: float, speed: float) -> None:
    clock = BoardClock()
    for i in range(2000):
        clock.update(100 + i * COUNTS[unit], 50.0 + 1e-3 * i / speed)
    assert clock.unit == unit


def test_a_counter_of_no_known_unit_is_told_and_gives_no_instants() -> None:
    clock = BoardClock()
    assert not any(clock.update(100 + i * 32, 50.0 + 1e-3 * i) for i in range(500))
    assert clock.unit is None
    assert clock.rate == pytest.approx(32000, rel=0.02)


@pytest.mark.parametrize(("unit", "first"), [(1e-3, 2**32 - 200), (1e-6, 2**32 - 200_000)])
def test_ticks_go_on_where_the_counter_wraps(unit: float, first: int) -> None:
    instants = [instant for instant in stream(BoardClock(), 400, unit, first) if instant]
    ticks = np.array([instant.tick for instant in instants], np.int64)
    assert set(np.diff(ticks) % 2**32) == {1}
    times = [instant.time for instant in instants]
    np.testing.assert_allclose(np.diff(times), 1e-3, atol=1e-9)


def test_instants_are_even_where_arrivals_jitter_by_two_milliseconds() -> None:
    rng = np.random.default_rng(0)
    instants = stream(BoardClock(), 2000, delay=lambda i: rng.uniform(0.0, 0.002))
    errors = [instant.time - (50.0 + 1e-3 * i) for i, instant in enumerate(instants) if instant]
    assert len(errors) > 1000
    assert np.mean(errors) == pytest.approx(0.0, abs=2e-4)
    assert np.std(errors[100:]) < 2e-4


def test_instants_never_go_back() -> None:
    rng = np.random.default_rng(1)
    instants = stream(BoardClock(), 3000, delay=lambda i: rng.choice([0.0, 0.001, 0.012], p=[0.5, 0.4, 0.1]))
    times = [instant.time for instant in instants if instant]
    assert (np.diff(times) > 0.0).all()


def test_a_board_that_stood_still_with_its_machine_is_followed_at_once() -> None:
    clock = BoardClock()
    instants = stream(clock, 600, delay=lambda i: 0.2 if i >= 400 else 0.0)
    assert instants[399].time == pytest.approx(50.399)
    assert instants[400].time == pytest.approx(50.6)
    assert instants[599].time == pytest.approx(50.799)


def test_repeated_and_late_states_are_counted_and_give_nothing() -> None:
    clock = BoardClock()
    stream(clock, 300)
    assert clock.update(399, 50.3) is None
    assert clock.update(398, 50.3) is None
    assert (clock.repeated, clock.late, clock.restarts) == (1, 1, 0)
    assert clock.update(400, 50.3) == BoardTime(pytest.approx(50.3), 400)


def test_a_board_that_starts_anew_is_followed_anew_after_a_moment() -> None:
    clock = BoardClock()
    stream(clock, 300, first=50_000)
    later = [clock.update(1 + i, 50.31 + 1e-3 * i) for i in range(300)]
    assert clock.restarts == 1
    assert 0 < clock.late < 120
    assert later[-1] == BoardTime(pytest.approx(50.609), 300)

"""When a process that could not run excuses silence, and when it does no longer."""

from __future__ import annotations

import pytest

from quadvel_policy.stall_detector import StallDetector

PERIOD = 0.02


@pytest.fixture
def pauses() -> StallDetector:
    """Of a process that ran at 1.00 s and 1.02 s."""
    pauses = StallDetector(PERIOD, 0.005)
    for now in (1.0, 1.02):
        pauses.poll(now)
    return pauses


def test_a_process_that_runs_in_time_has_no_excuse(pauses: StallDetector) -> None:
    for now in (1.024, 1.044, 1.064):
        pauses.poll(now)
        assert not pauses.excuses_silence(now)
    assert (pauses.count, pauses.has_stalled) == (0, False)


def test_a_pause_excuses_one_period(pauses: StallDetector) -> None:
    pauses.poll(1.08)
    assert (pauses.count, pauses.has_stalled) == (1, True)
    assert pauses.excuses_silence(1.08)
    assert pauses.excuses_silence(1.099)
    assert not pauses.excuses_silence(1.101)


def test_pauses_without_a_message_between_excuse_no_more(pauses: StallDetector) -> None:
    for now in (1.08, 1.14, 1.2):
        pauses.poll(now)
    assert pauses.count == 3
    assert not pauses.excuses_silence(1.14)


def test_after_a_message_the_next_pause_is_excused_again(pauses: StallDetector) -> None:
    pauses.poll(1.08)
    pauses.on_message()
    assert not pauses.has_stalled
    assert not pauses.excuses_silence(1.08)
    pauses.poll(1.14)
    assert pauses.excuses_silence(1.15)

"""When a process that could not run excuses silence, and when it does no longer."""

from __future__ import annotations

import pytest

from quadvel_policy.pauses import Pauses

PERIOD = 0.02


@pytest.fixture
def pauses() -> Pauses:
    """Of a process that ran at 1.00 s and 1.02 s."""
    pauses = Pauses(PERIOD, 0.005)
    for now in (1.0, 1.02):
        pauses.look(now)
    return pauses


def test_a_process_that_runs_in_time_has_no_excuse(pauses: Pauses) -> None:
    for now in (1.024, 1.044, 1.064):
        pauses.look(now)
        assert not pauses.excuse(now)
    assert (pauses.count, pauses.since_heard) == (0, False)


def test_a_pause_excuses_one_period(pauses: Pauses) -> None:
    pauses.look(1.08)
    assert (pauses.count, pauses.since_heard) == (1, True)
    assert pauses.excuse(1.08)
    assert pauses.excuse(1.099)
    assert not pauses.excuse(1.101)


def test_pauses_without_a_message_between_excuse_no_more(pauses: Pauses) -> None:
    for now in (1.08, 1.14, 1.2):
        pauses.look(now)
    assert pauses.count == 3
    assert not pauses.excuse(1.14)


def test_after_a_message_the_next_pause_is_excused_again(pauses: Pauses) -> None:
    pauses.look(1.08)
    pauses.heard()
    assert not pauses.since_heard
    assert not pauses.excuse(1.08)
    pauses.look(1.14)
    assert pauses.excuse(1.15)

"""Tests of log lines about lasting and short states."""

from __future__ import annotations

from collections.abc import Iterable

from quadvel_follow.follow_planner import PERIOD_S
from quadvel_follow.state_log import FLAPPING_S, SETTLED_S, StateLog

BLIND, WAITING = "blind: the scan is silent", "waiting: no person selected"


def lines(texts: Iterable[str]) -> list[str]:
    log = StateLog()
    return [line for k, text in enumerate(texts) if (line := log.next_line(PERIOD_S * k, text))]


def lasting(text: str, seconds: float = 2.0 * SETTLED_S) -> list[str]:
    return round(seconds / PERIOD_S) * [text]


def test_each_state_that_lasts_has_a_line() -> None:
    assert lines([*lasting(WAITING), *lasting(BLIND), *lasting(WAITING)]) == [WAITING, BLIND, WAITING]


def test_a_state_that_lasts_has_one_line() -> None:
    assert lines(lasting(WAITING, 600.0)) == [WAITING]


def test_states_that_alternate_do_not_flood_the_log() -> None:
    minute = round(60.0 / PERIOD_S / 8) * [*lasting(BLIND, 0.2), *lasting(WAITING, 0.2)]
    found = lines(minute)
    assert 60.0 / FLAPPING_S - 2 <= len(found) <= 60.0 / FLAPPING_S
    assert all(BLIND in line and WAITING in line for line in found)


def test_a_moment_is_summed_up_once_a_state_lasts_again() -> None:
    found = lines([*lasting(WAITING), *lasting(BLIND, 0.2), *lasting(WAITING)])
    assert len(found) == 2
    assert found[1].startswith(WAITING)
    assert f"1x {BLIND}" in found[1]

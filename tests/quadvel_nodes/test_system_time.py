"""Stamps in the system's time of instants of the steady clock."""

from __future__ import annotations

import time
from typing import Any

import pytest

pytest.importorskip("builtin_interfaces.msg")

from quadvel_nodes import system_time
from quadvel_nodes.system_time import SystemTime

STARTED = 1_700_000_000_000_000_000  # ns, of the system's clock when the steady one was at 0


class Clocks:
    """Two clocks. pause: ns that the process does not run before the next reading of the steady one."""

    def __init__(self) -> None:
        self.now, self.pause, self.set_by = 0, 0, 0

    def time_ns(self) -> int:
        read, self.now, self.pause = STARTED + self.set_by + self.now, self.now + self.pause, 0
        return read

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    clocks = Clocks()
    monkeypatch.setattr(system_time, "time", clocks)
    return clocks


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def test_a_process_that_is_paused_between_the_clocks_shifts_no_stamp(clocks: Clocks) -> None:
    stamps = SystemTime()
    for pause in (0, 20_000_000, 0, 3_000_000, 0):
        clocks.now += 5_000_000
        instant, clocks.pause = clocks.now, pause
        assert nanoseconds(stamps.stamp(1e-9 * instant)) == STARTED + instant


def test_a_process_that_is_paused_at_the_start_is_right_at_the_next_stamp(clocks: Clocks) -> None:
    clocks.pause = 20_000_000
    stamps = SystemTime()
    assert nanoseconds(stamps.stamp(1e-9 * clocks.now)) == STARTED + clocks.now


def test_stamps_follow_a_clock_that_is_set(clocks: Clocks) -> None:
    stamps = SystemTime()
    clocks.set_by = -2_000_000_000
    assert nanoseconds(stamps.stamp(1e-9 * clocks.now)) == STARTED - 2_000_000_000


def test_stamps_are_in_the_time_of_this_system() -> None:
    before = time.time_ns()
    stamp = nanoseconds(SystemTime().stamp(time.monotonic()))
    assert before - system_time.DRIFT_TOLERANCE_NS <= stamp <= time.time_ns() + system_time.DRIFT_TOLERANCE_NS

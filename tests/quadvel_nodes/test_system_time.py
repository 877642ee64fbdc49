"""Stamps of a process that gets no time between two clocks."""

from __future__ import annotations

import time

import pytest

from quadvel_nodes.system_time import SystemTime


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_a_pause_between_two_clocks_moves_no_stamp(monkeypatch: pytest.MonkeyPatch, nth: int) -> None:
    now, left = 10**12, 0

    def read() -> int:
        nonlocal now, left
        left -= 1
        now += 10**9 if left == 0 else 0
        return now

    monkeypatch.setattr(time, "time_ns", read)
    monkeypatch.setattr(time, "monotonic_ns", read)
    times = SystemTime()
    left = nth
    stamp = times.stamp(5.0)
    assert (stamp.sec, stamp.nanosec) == (5, 0)

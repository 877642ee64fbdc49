"""What the loop makes of its clocks."""

from __future__ import annotations

from typing import Any

import pytest

from quadvel_policy.control_loop import ControlConfig, ControlLoop
from quadvel_policy.supervisor import Supervisor
from tests.helpers.robots import ALIENGO


class Clocks:
    """Of a process that gets no time for 30 ms just before it reads a clock for the nth time."""

    def __init__(self) -> None:
        self.now, self.left = 100.0, 0

    def read(self) -> float:
        self.left -= 1
        self.now += 0.03 if self.left == 0 else 0.0
        return self.now


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_a_process_that_gets_no_time_between_two_clocks_does_not_set_one(policy: Any, nth: int) -> None:
    clocks = Clocks()
    loop = ControlLoop(
        Supervisor(ALIENGO, policy), ControlConfig(), lambda answer: None, clocks.read, steady=clocks.read
    )
    clocks.left = nth
    loop.watch()
    assert loop.stalled == 0.0

"""What an operator reads of the controller, over a run with a fault in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadvel_description.state import RobotState
from quadvel_policy.operator_log import OperatorLog
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from tests.helpers.robots import ALIENGO

STILL, FORWARD = (0.0, 0.0, 0.0, 1.0), (0.5, 0.0, 0.0, 0.0)


class Run:
    """A standing robot and the log of its supervisor."""

    def __init__(self, policy: Any) -> None:
        self.supervisor = Supervisor(ALIENGO, policy)
        self.log = OperatorLog(self.supervisor)
        self._ticks = 0

    def tick(self, command: Any, count: int = 1) -> list[tuple[bool, str]]:
        """Return the log of some ticks."""
        sentences = []
        for _ in range(count):
            self._ticks += 1
            zeros, upright = np.zeros(12), np.array([1.0, 0.0, 0.0, 0.0])
            time = 0.005 * self._ticks
            state = RobotState(
                time,
                5 * self._ticks,
                ALIENGO.nominal_q,
                zeros,
                zeros,
                upright,
                zeros[:3],
                zeros[:3],
                zeros[:4],
            )
            self.supervisor.tick(TickInput(time, state, np.zeros(3), command))
            sentences += self.log.changes()
        return sentences


def test_each_change_is_logged_once_and_a_fault_with_its_recovery(policy: Any) -> None:
    run = Run(policy)
    assert run.tick(STILL, 20) == [(False, "passive: waiting for a mode request")]
    run.supervisor.request("stance")
    assert run.tick(STILL, 80) == [
        (False, "stance: requested"),
        (False, "ready; waiting for a velocity command"),
    ]
    assert run.tick(FORWARD, 20) == [(False, "walk: a velocity was commanded")]
    assert not list(run.log.walk_refusals())
    run.supervisor.fail("a test", "test")
    assert run.tick(FORWARD, 20) == [
        (True, "fault: a test; the joints are damped until passive is requested, then stand_up")
    ]


def test_the_reason_why_a_standing_robot_does_not_walk_is_logged_once(policy: Any) -> None:
    run = Run(policy)
    run.tick(FORWARD)
    run.supervisor.request("stance")
    run.tick(FORWARD, 80)
    expected = ["follows no velocity: a zero velocity has to be commanded first"]
    assert list(run.log.walk_refusals()) == expected
    assert list(run.log.walk_refusals()) == []
    assert run.tick(STILL) == [(False, "ready; waiting for a velocity command")]

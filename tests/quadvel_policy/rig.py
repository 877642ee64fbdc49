"""A robot without physics for the tests of the supervisor."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import attrs
import numpy as np

from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_nodes.parameters import make_record
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.guard import Guard
from quadvel_policy.guards import GUARDS
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from tests.helpers.robots import ALIENGO

PERIOD = 0.005
STILL = (0.0, 0.0, 0.0, 1.0)
FORWARD = (0.5, 0.0, 0.0, 0.0)


class Rig:
    """A robot whose joints follow their targets immediately, driven at 200 Hz."""

    def __init__(
        self, policy: Any, guards: Iterable[type[Guard]] = GUARDS, backup: Any = None, **config: Any
    ) -> None:
        self.policy = policy
        self.supervisor = Supervisor(ALIENGO, policy, make_record(SupervisorConfig, config), backup, guards)
        zeros = np.zeros(12)
        upright, down = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 9.81])
        self.state = RobotState(
            100.0, 0, ALIENGO.lie_q.copy(), zeros, zeros, upright, np.zeros(3), down, np.full(4, 60.0)
        )
        self.velocity: Any = np.zeros(3)
        self.inputs: dict[str, Any] = {}  # further fields of TickInput
        self.answer = JointCommand.damping()

    @property
    def mode(self) -> str:
        return self.supervisor.mode

    def tick(
        self, command: Any = STILL, age: float = 0.0, step: float = PERIOD, **changes: Any
    ) -> JointCommand:
        """One tick with the state changed for it alone."""
        time, tick = self.state.time + step, self.state.tick + round(1e3 * step)
        self.state = attrs.evolve(self.state, time=time, tick=tick)
        seen = attrs.evolve(self.state, **changes)
        self.answer = self.supervisor.tick(TickInput(time + age, seen, self.velocity, command, **self.inputs))
        if self.answer.kp.any():
            self.state.q = self.answer.q.copy()
        return self.answer

    def run(self, seconds: float, command: Any = STILL) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.tick(command)

    def stand(self) -> Rig:
        self.tick()
        assert self.supervisor.request("stand_up") == (True, "mode is stand_up")
        self.run(2.5)
        assert self.mode == "stance", self.supervisor.reason
        return self

    def walk(self) -> Rig:
        self.stand()
        self.run(0.3, FORWARD)
        assert self.mode == "walk", self.supervisor.reason
        return self


def assert_damping(command: JointCommand) -> None:
    assert command.mode == MODE_DAMPING
    np.testing.assert_array_equal(command.kp, np.zeros(12))
    np.testing.assert_array_equal(command.tau, np.zeros(12))
    assert (command.kd > 0).all()

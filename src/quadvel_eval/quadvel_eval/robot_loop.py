"""The nodes' classes in one process, a control tick at a time: what every evaluation runs.

Simulator, estimator, command mux and supervisor follow each other as the messages between the nodes make
them: estimator and supervisor take up a state at the same time, so that the supervisor works with the
velocity of the state before. Transport itself takes no time, the actuator model's input delay stands for it.
As fast as the machine allows, the same to the bit for equal seeds. What is made of the samples is the
caller's matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.state import JointCommand, RobotState
from quadvel_estimator.features import previous_action
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import LearnedEstimator
from quadvel_estimator.tracker import Estimator
from quadvel_policy.command_mux import CommandMux, MuxInput
from quadvel_policy.observation import RATE_HZ
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.simulator import DT, Simulator, Truth

Array = NDArray[np.float64]

PERIOD = 1.0 / RATE_HZ  # s
ESTIMATORS = ("learned", "kalman", "truth")
STEPS = round(PERIOD / DT)  # of the simulator, a tick
_PLANNER = MuxInput("planner", priority=0, timeout=1.0)


class TrueVelocity:
    """Stands in for an estimator and knows the answer: the simulator's."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """The true velocity (3,), m/s, body frame, and a covariance of zeros."""
        return self._simulator.truth().linear_velocity, np.zeros((3, 3))


def make_estimator(kind: str, simulator: Simulator, file: Path) -> Estimator:
    """One of ESTIMATORS; `file` is the learned one's network."""
    if kind == "learned":
        return LearnedEstimator(file)
    if kind == "kalman":
        return KalmanEstimator()
    if kind == "truth":
        return TrueVelocity(simulator)
    raise ValueError(f"estimator is '{kind}', expected one of {', '.join(ESTIMATORS)}")


@attrs.frozen
class Sample:
    """One tick: all quantities held at `truth.time`, `command` is the answer to them."""

    state: RobotState
    truth: Truth
    asked: Array
    """velocity (3,), vx, vy (m/s), wz (rad/s), that the mux asked the supervisor for"""
    estimates: dict[str, Array]
    """velocity (3,), m/s, body frame, of the estimators beside"""
    command: JointCommand
    mode: str
    fallen: bool


class RobotLoop:
    """Drives `simulator` by `supervisor` with the velocity that `estimator` tells.

    `beside`: further estimators that see the same and drive nothing. The loop starts with the simulator as it
    is; call `stand_up` or reset the simulator to "stand" first.
    """

    def __init__(
        self,
        simulator: Simulator,
        supervisor: Supervisor,
        estimator: Estimator,
        beside: Mapping[str, Estimator] = MappingProxyType({}),
    ) -> None:
        self.simulator = simulator
        self.supervisor = supervisor
        self._estimator = estimator
        self._beside = dict(beside)
        self._mux = CommandMux([_PLANNER])
        self._velocity: Array | None = None
        self._previous_action = np.zeros(12)

    def tick(self, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> Sample:
        """One control tick under the planner's `velocity`: vx, vy (m/s), wz (rad/s); zero means stand still.

        FloatingPointError where the physics or an estimate diverged.
        """
        simulator = self.simulator
        now, state, truth, fallen = simulator.time, simulator.state(), simulator.truth(), simulator.fallen
        estimates = {name: e.update(state, self._previous_action)[0] for name, e in self._beside.items()}
        self._mux.receive(_PLANNER.name, now, velocity)
        asked = self._mux.update(now)
        command = self.supervisor.tick(now, state, self._velocity, [*asked.velocity, asked.stance])
        self._velocity, _ = self._estimator.update(state, self._previous_action)
        self._previous_action = previous_action(command.q, command.mode)
        simulator.command(command)
        simulator.step(STEPS)
        return Sample(
            state, truth, np.array(asked.velocity), estimates, command, self.supervisor.mode, fallen
        )

    @property
    def velocity(self) -> Array | None:
        """The newest estimate (3,), m/s, body frame; None before the first."""
        return self._velocity

    def start_walking(self) -> None:
        """From a simulator reset to "stand": half a second in the standing posture, then the policy stands.

        RuntimeError where the supervisor refuses.
        """
        self.tick()
        self._request("stance")
        for _ in range(round(0.5 / PERIOD)):
            self.tick()
        self._request("walk")

    def _request(self, mode: str) -> None:
        taken, sentence = self.supervisor.request(mode)
        if not taken:
            raise RuntimeError(f"the supervisor refused {mode}: {sentence}")

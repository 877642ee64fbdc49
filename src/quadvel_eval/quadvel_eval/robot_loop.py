"""Runs the nodes' classes in one process, one control tick at a time; the base of every evaluation.

Simulator, estimator, command mux and supervisor run in the order of their messages. Estimator
and supervisor receive a state at the same time. Therefore the supervisor uses the velocity
estimated from the previous state. Transport takes no time here; the input delay of the actuator
model represents it. The loop runs as fast as the machine allows. Equal seeds give bitwise equal
results.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand, RobotState
from quadvel_estimator.features import previous_action
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import LearnedEstimator
from quadvel_estimator.tracker import Estimator
from quadvel_policy.command_mux import CommandMux, MuxInput
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from quadvel_sim.simulator import DT, Simulator, Truth

ESTIMATORS = ("learned", "kalman", "truth")
SIMULATOR_STEPS_PER_TICK = round(CONTROL_PERIOD_S / DT)
_PLANNER = MuxInput("planner", priority=0, timeout=1.0)


class TrueVelocity:
    """Velocity estimator that returns the true velocity of the simulator."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator

    def reset(self) -> None:
        """Do nothing: the estimator has no state."""

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """Return the true velocity.

        Args:
            state: Ignored.
            previous_action: Ignored.

        Returns:
            Velocity (3,), m/s, body frame, and a covariance of zeros (3, 3).
        """
        return self._simulator.truth().linear_velocity, np.zeros((3, 3))


def make_estimator(kind: str, simulator: Simulator, file: Path | None) -> Estimator:
    """Create a velocity estimator.

    Args:
        kind: One of ESTIMATORS.
        simulator: Source of the true velocity.
        file: ONNX file of the learned estimator.

    Returns:
        The estimator.

    Raises:
        ValueError: The kind is unknown.
    """
    if kind == "learned":
        return LearnedEstimator(simulator.config.robot, file)
    if kind == "kalman":
        return KalmanEstimator(simulator.config.robot)
    if kind == "truth":
        return TrueVelocity(simulator)
    raise ValueError(f"estimator is '{kind}', expected one of {', '.join(ESTIMATORS)}")


@attrs.frozen
class Sample:
    """State, truth and answer of one control tick, all at `truth.time`.

    Attributes:
        state: Measured state.
        truth: True state of the simulator.
        commanded: Velocity from the mux to the supervisor (3,): vx, vy (m/s), wz (rad/s).
        estimates: Velocity (3,), m/s, body frame, of each shadow estimator.
        command: Joint command that answers the state.
        mode: Mode of the supervisor.
        fallen: Whether the robot has fallen.
    """

    state: RobotState
    truth: Truth
    commanded: Array
    estimates: dict[str, Array]
    command: JointCommand
    mode: str
    fallen: bool


class RobotLoop:
    """Control loop of a simulated robot: estimator, command mux, supervisor and simulator.

    The loop starts from the present state of the simulator. Reset it to "stand" before
    `start_walking`.

    Args:
        simulator: The robot.
        supervisor: Checks and policy.
        estimator: Estimator whose velocity the supervisor uses.
        shadow_estimators: Estimators that receive the same input and influence nothing.
    """

    def __init__(
        self,
        simulator: Simulator,
        supervisor: Supervisor,
        estimator: Estimator,
        shadow_estimators: Mapping[str, Estimator] = MappingProxyType({}),
    ) -> None:
        self.simulator = simulator
        self.supervisor = supervisor
        self._estimator = estimator
        self._shadow_estimators = dict(shadow_estimators)
        self._mux = CommandMux([_PLANNER])
        self._velocity: Array | None = None
        self._previous_action = np.zeros(12)

    def tick(self, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> Sample:
        """Run one control tick under a planner's velocity.

        Args:
            velocity: Commanded vx, vy (m/s) and wz (rad/s); zero means stand still.

        Returns:
            The sample of this tick.

        Raises:
            FloatingPointError: Physics or an estimate diverged.
        """
        simulator = self.simulator
        now, state, truth, fallen = simulator.time, simulator.state(), simulator.truth(), simulator.fallen
        estimates = {
            name: e.update(state, self._previous_action)[0] for name, e in self._shadow_estimators.items()
        }
        self._mux.receive(_PLANNER.name, now, velocity)
        mux_output = self._mux.update(now)
        commanded = [*mux_output.velocity, mux_output.stance]
        command = self.supervisor.tick(TickInput(now, state, self._velocity, commanded))
        self._velocity, _ = self._estimator.update(state, self._previous_action)
        self._previous_action = previous_action(simulator.config.robot, command.q, command.mode)
        simulator.command(command)
        simulator.step(SIMULATOR_STEPS_PER_TICK)
        return Sample(
            state, truth, np.array(mux_output.velocity), estimates, command, self.supervisor.mode, fallen
        )

    @property
    def velocity(self) -> Array | None:
        """Newest estimate (3,), m/s, body frame; None before the first."""
        return self._velocity

    def start_walking(self) -> None:
        """Stand for half a second, then start the policy.

        The simulator must have been reset to "stand".

        Raises:
            RuntimeError: The supervisor refuses a mode.
        """
        self.tick()
        self._request("stance")
        for _ in range(round(0.5 / CONTROL_PERIOD_S)):
            self.tick()
        self._request("walk")

    def _request(self, mode: str) -> None:
        """Request a mode. Raises RuntimeError if the supervisor refuses."""
        accepted, sentence = self.supervisor.request(mode)
        if not accepted:
            raise RuntimeError(f"the supervisor refused {mode}: {sentence}")

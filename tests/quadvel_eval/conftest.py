"""Robot loop without a trained network: its policy holds a posture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from quadvel_description import mjcf
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_eval.robot_loop import RobotLoop, TrueVelocity
from quadvel_policy.observation import PolicyMetadata, default_observation
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO


class StandingPolicy:
    """Policy that always commands the standing posture."""

    def __init__(self) -> None:
        self.metadata = PolicyMetadata(
            robot=ALIENGO.name,
            nominal_q=tuple(ALIENGO.nominal_q),
            observation=default_observation(ALIENGO),
            action_offset=tuple(
                ALIENGO.nominal_q + mjcf.gravity_torque(mjcf.load_model(ALIENGO)) / ALIENGO.kp
            ),
            action_scale=1.0,
            kp=ALIENGO.kp,
            kd=ALIENGO.kd,
            command_limits={"vx": (-2.0, 2.0), "vy": (-1.0, 1.0), "wz": (-2.0, 2.0)},
            state_shape=(1, 1, 1),
        )

    def reset(self) -> None:
        """Do nothing: the policy has no state."""

    def step(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(12, np.float32)


@pytest.fixture
def standing_policy() -> StandingPolicy:
    return StandingPolicy()


@pytest.fixture(scope="session")
def make_loop() -> Callable[..., RobotLoop]:
    """make_loop(seed) -> a robot in walk mode under a policy that stands."""

    def make(seed: int = 0) -> RobotLoop:
        simulator = Simulator(SimulatorConfig(robot=ALIENGO, seed=seed))
        simulator.reset("stand")
        others = {"kalman": KalmanEstimator(ALIENGO)}
        loop = RobotLoop(simulator, Supervisor(ALIENGO, StandingPolicy()), TrueVelocity(simulator), others)
        loop.start_walking()
        return loop

    return make

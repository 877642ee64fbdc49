"""The shipped policy on drives that it never knew: the trim removes the steady error of the velocity."""

from __future__ import annotations

import numpy as np

from quadvel_estimator.kalman import KalmanEstimator
from quadvel_eval.paper.gap import drive_conditions
from quadvel_eval.robot_loop import RobotLoop, make_estimator
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO

AHEAD, WALK_S, EVALUATED_S = (1.0, 0.0, 0.0), 7.0, 3.0


def mean_velocity(max_trim: float) -> np.ndarray:
    """Return mean vx, vy (m/s) and wz (rad/s) at the end of a walk on drives with friction, (3,)."""
    plant = next(one.plant for one in drive_conditions(ALIENGO) if one.level == "friction")
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, seed=0, **plant))
    simulator.reset("stand")
    config = SupervisorConfig(max_velocity_trim=max_trim)
    supervisor = Supervisor(ALIENGO, PolicyFile(ALIENGO), config, KalmanEstimator(ALIENGO))
    loop = RobotLoop(simulator, supervisor, make_estimator("learned", simulator, None))
    loop.start_walking()
    truths = [loop.tick(AHEAD).truth for _ in range(round(WALK_S / CONTROL_PERIOD_S))]
    end = truths[-round(EVALUATED_S / CONTROL_PERIOD_S) :]
    return np.array([[*t.linear_velocity[:2], t.angular_velocity[2]] for t in end]).mean(axis=0)


def test_the_error_on_drives_with_friction_is_trimmed_away() -> None:
    errors = {trim: np.abs(mean_velocity(trim) - AHEAD) for trim in (0.0, 0.1)}
    assert errors[0.0][0] > 0.03
    assert errors[0.1][0] < 0.3 * errors[0.0][0]
    assert errors[0.1].max() < 0.02

"""Tests of a suspended robot: the trunk rests, the legs are free."""

from __future__ import annotations

import mujoco
import numpy as np

from quadvel_description.state import JointCommand
from quadvel_sim import SensorNoise, Simulator, SimulatorConfig, Terrain
from tests.helpers.robots import ALIENGO


def suspended_robot(**changes: object) -> Simulator:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, suspended=True, noise=SensorNoise.none(), **changes))
    simulator.reset("stand")
    return simulator


def test_the_trunk_stays_while_the_legs_swing() -> None:
    simulator = suspended_robot(terrain=Terrain("slope", slope=0.2))
    swing = np.tile([0.2, 0.4, -0.3], 4)
    feet = np.zeros(4, bool)
    for i in range(300):
        target = ALIENGO.nominal_q + swing * np.sin(2 * np.pi * 3.0 * i * 0.001)
        simulator.command(JointCommand(q=target, kp=np.full(12, 60.0), kd=np.full(12, 1.0)))
        simulator.step()
        feet |= simulator.truth().contact
    truth = simulator.truth()
    np.testing.assert_allclose(truth.position, [0.0, 0.0, ALIENGO.suspended_height], atol=2e-3)
    np.testing.assert_allclose(truth.quaternion, [1.0, 0.0, 0.0, 0.0], atol=2e-3)
    assert not feet.any()
    assert not simulator.fallen


def test_at_rest_the_drives_hold_the_legs_weight_alone() -> None:
    simulator = suspended_robot(joint_friction=np.zeros(12))
    command = JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, 300.0), kd=np.full(12, 5.0))
    for _ in range(150):
        simulator.command(command)
        simulator.step(10)
    torque = np.mean([_advanced(simulator, command) for _ in range(200)], axis=0)
    rest = mujoco.MjData(simulator.model)
    rest.qpos[:] = simulator.data.qpos
    mujoco.mj_forward(simulator.model, rest)
    np.testing.assert_allclose(
        torque, rest.qfrc_bias[6:], atol=0.08
    )  # the torque noise's mean over 200 samples


def _advanced(simulator: Simulator, command: JointCommand) -> np.ndarray:
    simulator.command(command)
    simulator.step()
    return simulator.state().tau

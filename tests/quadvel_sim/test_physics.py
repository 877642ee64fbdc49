"""Tests of the held-out plant: the same robot with other contacts and inertia."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from quadvel_sim.config import SimulatorConfig
from quadvel_sim.physics import HELD_OUT_PHYSICS, Physics
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO


def test_time_and_weight_are_right_at_any_number_of_steps_a_millisecond() -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, physics=HELD_OUT_PHYSICS))
    simulator.reset("lie")
    simulator.step(1000)
    assert simulator.data.time == pytest.approx(1.0)
    assert simulator.time == pytest.approx(1.0)
    weight = 9.81 * simulator.model.body_subtreemass[1]
    assert weight == pytest.approx(
        1.03 * 9.81 * Simulator(SimulatorConfig(robot=ALIENGO)).model.body_subtreemass[1]
    )
    up = np.zeros(6)
    total = 0.0
    for i in range(simulator.data.ncon):
        mujoco.mj_contactForce(simulator.model, simulator.data, i, up)
        total += float(up[:3] @ simulator.data.contact.frame[i].reshape(3, 3)[:, 2])
    assert total == pytest.approx(weight, rel=0.05)  # the robot lies, all of it


def test_the_usual_plant_is_what_the_model_says() -> None:
    runs = []
    for config in (SimulatorConfig(robot=ALIENGO), SimulatorConfig(robot=ALIENGO, physics=Physics())):
        simulator = Simulator(config)
        simulator.step(200)
        runs.append(simulator.data.qpos.copy())
    assert np.array_equal(*runs)


def test_what_no_plant_can_be_is_refused() -> None:
    with pytest.raises(ValueError, match="contact_time"):
        Physics(contact_time=0.0)
    with pytest.raises(ValueError, match="cone"):
        Physics(cone="round")

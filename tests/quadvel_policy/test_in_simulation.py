"""The supervisor on the simulated robot: it stands up, hands over to a policy that stands, and lies down."""

from __future__ import annotations

from typing import Any

import attrs
import mujoco
import numpy as np
import pytest

from quadvel_description import mjcf
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sim.terrain import Terrain
from tests.helpers.robots import ALIENGO

STILL, STEP_IN_PLACE = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.1, 0.0)


class Stand:
    """A simulated robot that lies, and a supervisor whose policy holds the nominal posture."""

    def __init__(
        self, make_policy: Any, slope: float = 0.0, heading: float = 0.0, auto_stand: bool = True
    ) -> None:
        """slope, heading: rad; where the heading is zero the robot looks uphill."""
        sag = mjcf.gravity_torque(mjcf.load_model(ALIENGO)) / ALIENGO.kp
        terrain = Terrain("slope", slope=slope)
        self.simulator = Simulator(SimulatorConfig(robot=ALIENGO, terrain=terrain))
        turned = np.array([np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)])
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, terrain.tilt, turned)
        self.simulator.set_state(
            attrs.evolve(self.simulator.truth(), quaternion=quaternion), ALIENGO.lie_q, np.zeros(12)
        )
        self.supervisor = Supervisor(
            ALIENGO,
            make_policy(action_offset=tuple(ALIENGO.nominal_q + sag)),
            SupervisorConfig(auto_stand=auto_stand),
        )
        self.torques: list[np.ndarray] = []

    def run(self, seconds: float, command: Any = STILL) -> None:
        for _ in range(round(seconds / 0.005)):
            state, velocity = self.simulator.state(), self.simulator.truth().linear_velocity
            asked = self.supervisor.tick(TickInput(self.simulator.time, state, velocity, command))
            self.torques.append(asked.kp * (asked.q - state.q) + asked.kd * (asked.dq - state.dq))
            self.simulator.command(asked)
            self.simulator.step(5)

    @property
    def height(self) -> float:
        return float(self.simulator.truth().position[2])


@pytest.fixture
def stand(make_policy: Any) -> Stand:
    return Stand(make_policy)


def test_it_stands_up_walks_on_command_and_lies_down_without_a_jump_of_torque(stand: Stand) -> None:
    stand.run(2.5)
    assert stand.supervisor.mode == "stance", stand.supervisor.reason
    assert stand.height == pytest.approx(ALIENGO.nominal_height, abs=0.03)
    stand.run(0.4, STEP_IN_PLACE)  # not longer: on soft gains a posture alone does not balance the robot
    assert stand.supervisor.mode == "walk", stand.supervisor.reason
    assert stand.height == pytest.approx(ALIENGO.nominal_height, abs=0.03)
    stand.run(0.1)
    assert stand.supervisor.request("lie_down") == (True, "mode is lie_down")
    stand.run(1.5)
    assert stand.supervisor.mode == "passive", stand.supervisor.reason
    assert stand.height < 0.2
    jumps = np.abs(np.diff(stand.torques[: -round(0.55 / 0.005)], axis=0))  # until it goes limp, lying
    assert jumps.max() < 4.0, f"{jumps.max():.1f} N m between two ticks"


@pytest.mark.parametrize("heading", [0.0, 90.0, 180.0], ids=["uphill", "across", "downhill"])
def test_it_stands_up_on_a_slope_of_15_degrees_stays_there_and_lies_down(
    make_policy: Any, heading: float
) -> None:
    stand = Stand(make_policy, np.radians(15.0), np.radians(heading))
    stand.run(2.5)
    stood = stand.simulator.truth()
    stand.run(4.0)
    assert stand.supervisor.mode == "stance", stand.supervisor.reason
    stays = stand.simulator.truth()
    np.testing.assert_allclose(stays.quaternion, stood.quaternion, atol=0.02)
    assert np.linalg.norm(stays.position - stood.position) < 0.1  # MuJoCo's feet creep downhill by 1.5 cm/s
    assert stand.supervisor.request("lie_down")[0]
    stand.run(1.5)
    assert stand.supervisor.mode == "passive", stand.supervisor.reason


@pytest.mark.parametrize("seed", range(3))
def test_it_comes_to_rest_in_stance_with_its_feet_somewhat_off_their_places(
    make_policy: Any, seed: int
) -> None:
    stand = Stand(make_policy, auto_stand=False)
    stand.simulator.reset("stand")
    off = np.random.default_rng(seed).uniform(-0.15, 0.15, 12)
    stand.simulator.set_state(stand.simulator.truth(), ALIENGO.nominal_q + off, np.zeros(12))
    stand.run(0.01)
    assert stand.supervisor.request("stance")[0]
    stand.run(2.0)
    tilts = []
    for _ in range(100):
        stand.run(0.01)
        tilts.append(2.0 * stand.simulator.truth().quaternion[1:3])
    assert stand.supervisor.mode == "stance", stand.supervisor.reason
    assert np.ptp(tilts, axis=0).max() < 0.05  # rad


def test_a_robot_that_is_pushed_over_goes_to_damping(stand: Stand) -> None:
    stand.run(2.5)
    stand.simulator.push("trunk", np.array([0.0, 500.0, 0.0]), np.zeros(3), 0.4)
    stand.run(1.5, STEP_IN_PLACE)
    assert stand.supervisor.mode == "fault"
    assert stand.supervisor.reason

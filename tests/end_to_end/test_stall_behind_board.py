"""Stalls between board and controller: board, link and control loop in one thread on a clock of the test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import pytest

from quadvel_description.state import JointCommand
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState
from quadvel_driver.decimator import Decimator
from quadvel_driver.link import Link
from quadvel_driver.udp import UdpConfig, UdpTransport
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.control_loop import WATCH_PERIOD_S, ControlConfig, ControlLoop
from quadvel_policy.observation import RATE_HZ
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.loop import SimulationLoop
from quadvel_sim.simulator import Simulator
from quadvel_sim.udp_board import UdpBoard
from tests.helpers.robots import ALIENGO


class StandingRobot:
    """A robot that stands behind a board, with the driver's link and the controller."""

    def __init__(self) -> None:
        self.now = 100.0  # s
        self._board = UdpBoard(("127.0.0.1", 0), NetworkConfig(), clock=self._clock)
        simulator = Simulator(SimulatorConfig(robot=ALIENGO))
        simulator.reset("stand")
        self._loop = SimulationLoop(
            simulator, self._board.publish, period=1, answer_timeout=0.0, clock=self._clock
        )
        self._loop._condition.wait = lambda timeout: False  # the test moves the clock
        self._board.loop, self._loop.receive = self._loop, self._board.receive
        config = UdpConfig(board_address="127.0.0.1", board_port=self._board.address[1], local_port=0)
        self._transport = UdpTransport(config)
        self._link = Link(ALIENGO, wire, self._transport, config, self._on_state, clock=self._clock)
        self._decimator = Decimator(RATE_HZ)
        self.supervisor = Supervisor(
            ALIENGO, PolicyFile(ALIENGO), SupervisorConfig(), KalmanEstimator(ALIENGO)
        )
        self._control = ControlLoop(
            self.supervisor, ControlConfig(), self._submit, self._clock, steady=self._clock
        )
        self.run(0.16)  # until the link knows the board's clock; the braked robot sags meanwhile
        assert self.supervisor.request("stance") == (True, "mode is stance")
        self.run(0.3)
        assert self.supervisor.mode == "stance"

    def _clock(self) -> float:
        return self.now

    def _on_state(self, state: BoardState) -> None:
        if self._decimator.accepts(state.robot.tick):
            self._control.on_state(state.robot)

    def _submit(self, command: JointCommand) -> None:
        with suppress(ValueError):  # it answers a state from before a stall
            self._link.submit(command)

    def run(self, seconds: float, controlled: bool = True) -> None:
        """Let time pass; if not `controlled`, link and controller do not run."""
        for k in range(round(1e3 * seconds)):
            self.now += 1e-3
            while self._loop._wait_until_ready():
                self._loop.advance()
            if controlled:
                self._link.serve()
            if controlled and k % round(1e3 * WATCH_PERIOD_S) == 0:
                self._control.watch()

    def close(self) -> None:
        self._transport.close()
        self._board.close()


@pytest.fixture
def robot() -> Iterator[StandingRobot]:
    robot = StandingRobot()
    yield robot
    robot.close()


def test_a_stall_of_the_whole_machine_is_no_fault(robot: StandingRobot) -> None:
    for _ in range(2):
        robot.now += 0.1
        robot.run(0.2)
        assert (robot.supervisor.mode, robot.supervisor.fault) == ("stance", "")


def test_a_stall_of_link_and_controller_is_named_as_one(robot: StandingRobot) -> None:
    robot.run(0.1, controlled=False)
    robot.run(0.1)
    assert robot.supervisor.fault == "controller_stopped"

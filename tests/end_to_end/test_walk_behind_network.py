"""How well the robot tracks a velocity through packets, network and the driver's link, against without: in simulated time.

Link, packets, network and clocks are the real ones; only sockets are not, so that a busy machine does not matter.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

import numpy as np
import pytest

from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand, RobotState
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState
from quadvel_driver.link import Link, LinkConfig, Transport
from quadvel_driver.unitree_dds import wire as dds_wire
from quadvel_estimator.learned import LearnedEstimator
from quadvel_eval.robot_loop import RobotLoop
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.bad_network import BadNetwork, NetworkConfig
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO, GO2

BAD = NetworkConfig(network_loss=0.02, network_jitter=0.002)
TURNS = 4  # of the link, a millisecond
SETTLE, MEASURE = 400, 800  # ticks of 5 ms


class Wire(Transport):
    """The link's end of the network."""

    def __init__(self) -> None:
        self.board, self.counts = "board", Counter()
        self.sent: deque[bytes] = deque()
        self.came: deque[bytes] = deque()

    def send(self, packet: bytes) -> None:
        self.sent.append(packet)

    def receive(self) -> bytes | None:
        return self.came.popleft() if self.came else None

    def wait(self, timeout: float) -> None:
        raise AssertionError("time is simulated")

    def close(self) -> None:
        pass


class BehindNetwork:
    """A simulator as its driver shows it: its reports and commands go through packets and a bad network."""

    def __init__(self, network: NetworkConfig, robot: Robot, packets: Any) -> None:
        self._packets, self._robot = packets, robot
        self._simulator = Simulator(SimulatorConfig(robot=robot))
        self.config = self._simulator.config
        self._simulator.reset("stand")
        self._there, self._back = BadNetwork(network, 0), BadNetwork(network, 1)
        self._wire = Wire()
        self._newest: RobotState | None = None
        self.time = 50.0
        self.link = Link(robot, packets, self._wire, LinkConfig(), self._on_state, clock=lambda: self.time)
        self._warming_up = True
        self.step(300)  # the link finds out in what unit the board counts
        self._warming_up = False

    def _on_state(self, state: BoardState) -> None:
        self._newest = state.robot

    def state(self) -> RobotState:
        assert self._newest is not None
        return self._newest

    def truth(self) -> Any:
        return self._simulator.truth()

    @property
    def fallen(self) -> bool:
        return self._simulator.fallen

    def command(self, command: JointCommand) -> None:
        self.link.submit(command)

    def step(self, n: int) -> None:
        for _ in range(n):
            if self._warming_up:
                self._simulator.command(
                    JointCommand(
                        q=np.array(self._robot.nominal_q), kp=np.full(12, 100.0), kd=np.full(12, 3.0)
                    )
                )
            self._simulator.step(1)
            self._report()
            for _ in range(TURNS):
                self.time += 1e-3 / TURNS
                self._exchange()

    def _report(self) -> None:
        state = self._simulator.state()
        state.tick = 1000 + self._simulator.steps
        twelve = np.full(12, 10)
        self._back.send(self._packets.encode_state(BoardState(state, twelve, twelve, twelve)), self.time)

    def _exchange(self) -> None:
        self._wire.came.extend(self._back.pop_arrived(self.time))
        self.link.serve()
        while self._wire.sent:
            self._there.send(self._wire.sent.popleft(), self.time)
        for packet in self._there.pop_arrived(self.time):
            if not self._warming_up:
                self._simulator.command(self._packets.decode_command(packet))


def walked(robot: Robot, simulator: Any, velocity: tuple[float, float, float]) -> np.ndarray:
    """Mean vx, vy (m/s), wz (rad/s) of a walk under a command."""
    loop = RobotLoop(simulator, Supervisor(robot, PolicyFile(robot)), LearnedEstimator(robot))
    loop.start_walking()
    truths = []
    for tick in range(SETTLE + MEASURE):
        sample = loop.tick(velocity)
        assert sample.mode == "walk", loop.supervisor.reason
        assert not sample.fallen
        if tick >= SETTLE:
            truths.append([*sample.truth.linear_velocity[:2], sample.truth.angular_velocity[2]])
    return np.mean(truths, axis=0)


@pytest.mark.parametrize(
    ("robot", "packets", "velocity"),
    [
        (ALIENGO, wire, (0.5, 0.0, 0.0)),
        pytest.param(ALIENGO, wire, (1.0, 0.0, 0.5), marks=pytest.mark.long),
        pytest.param(ALIENGO, wire, (0.0, 0.4, 0.0), marks=pytest.mark.long),
        (GO2, dds_wire, (0.5, 0.0, 0.0)),
        pytest.param(GO2, dds_wire, (1.0, 0.0, 0.5), marks=pytest.mark.long),
        pytest.param(GO2, dds_wire, (0.0, 0.4, 0.0), marks=pytest.mark.long),
    ],
)
def test_with_2_percent_loss_and_2_ms_jitter_tracking_is_within_2_cm_per_s(
    robot: Robot, packets: Any, velocity: tuple[float, float, float]
) -> None:
    plain = Simulator(SimulatorConfig(robot=robot))
    plain.reset("stand")
    behind = BehindNetwork(BAD, robot, packets)
    without, through = walked(robot, plain, velocity), walked(robot, behind, velocity)
    counts = behind.link.report().counts
    assert counts["late"] > 100
    assert counts["command_timeouts"] == 0
    np.testing.assert_allclose(through, without, atol=0.02)

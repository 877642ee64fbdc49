"""A Go2's board over DDS on loopback: driven by our own link, and by the vendor's client, unchanged."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from quadvel_description.robot import NOMINAL_Q
from quadvel_description.state import JointCommand
from quadvel_driver.board_state import BoardState
from quadvel_driver.link import Link, LinkConfig, LinkError
from quadvel_driver.takeover import Access
from quadvel_driver.unitree_dds import wire
from quadvel_driver.unitree_dds.bus import Bus
from quadvel_driver.unitree_dds.go2 import GO2
from quadvel_driver.unitree_dds.motion_switcher import MotionSwitcher
from quadvel_driver.unitree_dds.takeover import DdsTakeover
from quadvel_driver.unitree_dds.transport import COMMAND_TOPIC, DdsTransport
from quadvel_driver.unitree_dds.types import LOW_CMD
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.dds_board import DdsBoard
from quadvel_sim.loop import SimulationLoop
from quadvel_sim.simulator import Simulator

DOMAIN, INTERFACE = int(os.environ["ROS_DOMAIN_ID"]), "lo"
PATIENCE_S = 40.0
TARGET = np.array(NOMINAL_Q) + np.where(np.arange(12) == 3, 0.2, 0.0)  # the hip FL moves outward


def wait_for(condition: Callable[[], object], board: DdsBoard) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"time is up; {board.counts}, {board.last_refusal}"
        time.sleep(0.005)


@pytest.fixture
def serve() -> Iterator[Callable[..., DdsBoard]]:
    """Runs a robot that hangs in the air behind a board."""
    ends: list[Callable[[], None]] = []

    def begin(**network: float) -> DdsBoard:
        board = DdsBoard(Bus(DOMAIN, INTERFACE), NetworkConfig(**network))
        simulator = Simulator(SimulatorConfig(suspended=True, watchdog=0.5))
        simulator.reset("stand")
        board.loop = SimulationLoop(simulator, board.publish, period=2, answer_timeout=0.0)
        threads = [threading.Thread(target=run) for run in (board.run, board.loop.run)]
        for thread in threads:
            thread.start()
        ends.extend((board.loop.stop, board.stop, *(thread.join for thread in threads)))
        return board

    yield begin
    for end in ends:
        end()


class Driven:
    """The driver's link on the bus; it holds the joints at a target once it has them."""

    def __init__(self) -> None:
        bus = Bus(DOMAIN, INTERFACE)
        transport = DdsTransport(bus)
        self.takeover = DdsTakeover(transport, MotionSwitcher(bus), min_battery=20)
        self.states: list[BoardState] = []
        config = LinkConfig(command_timeout=0.5)
        self.link = Link(GO2, wire, transport, config, self._hold, takeover=self.takeover)
        self._thread = threading.Thread(target=self.link.run)
        self._thread.start()

    def _hold(self, state: BoardState) -> None:
        self.states.append(state)
        gains = {"kp": np.full(12, 100.0), "kd": np.full(12, 3.0)}
        self.link.submit(JointCommand(q=TARGET, tick=state.robot.tick, **gains))

    def has_the_joints(self) -> bool:
        return self.takeover.access is Access.FULL

    def stop(self) -> None:
        self.link.stop()
        self._thread.join()


@pytest.fixture
def drive() -> Iterator[Callable[[], Driven]]:
    made: list[Driven] = []

    def begin() -> Driven:
        made.append(Driven())
        return made[-1]

    yield begin
    for driven in made:
        driven.stop()


Serve = Callable[..., DdsBoard]
Drive = Callable[[], Driven]


def test_the_link_takes_the_joints_from_the_robots_own_controller_and_moves_one(
    serve: Serve, drive: Drive
) -> None:
    board = serve()
    assert board.mode == "mcf"
    driven = drive()
    wait_for(lambda: driven.states and abs(driven.states[-1].robot.q[3] - TARGET[3]) < 0.05, board)
    assert board.mode == ""
    state = driven.states[-1]
    assert (state.motor_mode == wire.MOTOR_SERVO).all()
    assert state.battery is not None
    assert state.battery.charge == 90
    assert driven.link.report().takeover == ""


def test_a_network_that_loses_delays_and_corrupts_does_not_stop_it(serve: Serve, drive: Drive) -> None:
    board = serve(network_loss=0.05, network_jitter=0.002, network_corruption=0.05)
    driven = drive()
    wait_for(lambda: driven.states and abs(driven.states[-1].robot.q[3] - TARGET[3]) < 0.05, board)
    wait_for(lambda: board.counts["wrong_crc"], board)
    wait_for(lambda: driven.link.report().counts["wrong_crc"], board)
    assert driven.has_the_joints()


@pytest.mark.parametrize("writes", [True, False])
def test_a_second_writer_stops_the_joints_whether_it_writes_or_not(
    serve: Serve, drive: Drive, writes: bool
) -> None:
    board = serve()
    driven = drive()
    wait_for(driven.has_the_joints, board)
    other = Bus(DOMAIN, INTERFACE)
    writer = other.writer(COMMAND_TOPIC, LOW_CMD)
    if writes:
        writer.write(wire.encode_command(JointCommand()))
    wait_for(lambda: not driven.has_the_joints(), board)
    assert "another program" in driven.link.report().takeover
    wait_for(lambda: driven.takeover.access is Access.NONE, board)
    other.close()


def test_a_second_driver_does_not_take_the_joints(serve: Serve, drive: Drive) -> None:
    board = serve()
    first = drive()
    wait_for(first.has_the_joints, board)
    second = drive()
    wait_for(lambda: "another program" in second.link.report().takeover, board)
    assert first.has_the_joints()
    assert second.link.report().counts["sent"] == 0


def test_the_robots_own_controller_that_comes_back_stops_the_joints(serve: Serve, drive: Drive) -> None:
    board = serve()
    driven = drive()
    wait_for(driven.has_the_joints, board)
    board.select("normal")
    wait_for(lambda: not driven.has_the_joints(), board)
    wait_for(lambda: board.counts["held"], board)


def test_an_interface_that_does_not_exist_is_told_in_one_sentence() -> None:
    with pytest.raises(LinkError, match="no link to DDS domain 7 on nosuch0: "):
        Bus(7, "nosuch0")


class Vendor:
    """The vendor's client: unitree_sdk2py, unchanged."""

    def __init__(self) -> None:
        channel = pytest.importorskip("unitree_sdk2py.core.channel", reason="pip install --no-deps it")
        from unitree_sdk2py.comm.motion_switcher.motion_switcher_client import MotionSwitcherClient
        from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_
        from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_
        from unitree_sdk2py.utils.crc import CRC

        channel.ChannelFactoryInitialize(DOMAIN, INTERFACE)
        self.crc = CRC().Crc
        self.states: list[Any] = []
        self.command = unitree_go_msg_dds__LowCmd_()
        self.command.head[:], self.command.level_flag = (0xFE, 0xEF), 0xFF
        self._reader = channel.ChannelSubscriber("rt/lowstate", LowState_)
        self._reader.Init(self.states.append, 10)
        self.writer = channel.ChannelPublisher("rt/lowcmd", LowCmd_)
        self.switcher = MotionSwitcherClient()

    def start(self) -> None:
        self.writer.Init()
        self.switcher.SetTimeout(10.0)
        self.switcher.Init()

    def send(self, kp: float = 100.0, crc_error: int = 0) -> None:
        for i, motor in enumerate(self.command.motor_cmd[:12]):
            motor.mode, motor.q, motor.kp, motor.kd = 1, float(TARGET[i]), kp, 3.0
        self.command.crc = self.crc(self.command) ^ crc_error
        self.writer.Write(self.command)

    def close(self) -> None:
        self._reader.Close()
        self.writer.Close()


@pytest.fixture
def vendor() -> Iterator[Vendor]:
    vendor = Vendor()
    yield vendor
    vendor.close()


def test_the_vendors_client_reads_states_releases_the_controller_and_moves_a_joint(
    serve: Serve, vendor: Vendor
) -> None:
    board = serve()
    vendor.start()
    wait_for(lambda: vendor.states, board)
    state = vendor.states[-1]
    assert state.crc == vendor.crc(state)
    np.testing.assert_allclose([motor.q for motor in state.motor_state[:12]], NOMINAL_Q, atol=0.2)
    assert state.bms_state.soc == 90

    vendor.send()
    wait_for(lambda: board.counts["held"], board)
    assert vendor.switcher.CheckMode() == (0, {"form": "0", "name": "mcf"})
    assert vendor.switcher.ReleaseMode() == (0, None)
    assert vendor.switcher.CheckMode() == (0, {"form": "0", "name": ""})

    def moved() -> bool:
        vendor.send()
        return abs(vendor.states[-1].motor_state[3].q - TARGET[3]) < 0.05

    wait_for(moved, board)


def test_the_vendors_client_is_refused_with_a_wrong_crc(serve: Serve, vendor: Vendor) -> None:
    board = serve()
    board.select("")
    vendor.start()

    def refused() -> bool:
        vendor.send(crc_error=1)
        return board.counts["wrong_crc"] > 3

    wait_for(refused, board)
    assert board.counts["commands"] == 0
    assert board.last_refusal.startswith("command: CRC is 0x")

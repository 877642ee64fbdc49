"""A Go2's board over DDS on loopback: driven by our own link, and by the vendor's client, unchanged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.state import JointCommand
from quadvel_driver.board_state import BoardState
from quadvel_driver.link import Link, LinkConfig, LinkError
from quadvel_driver.takeover import Access
from quadvel_driver.unitree_dds import wire
from quadvel_driver.unitree_dds.bus import Bus
from quadvel_driver.unitree_dds.motion_switcher import MotionSwitcher
from quadvel_driver.unitree_dds.takeover import DdsTakeover
from quadvel_driver.unitree_dds.transport import COMMAND_TOPIC, DdsTransport
from quadvel_driver.unitree_dds.types import LOW_CMD
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.dds_board import DdsBoard
from quadvel_sim.simulator import Simulator
from tests.helpers import boards
from tests.helpers.robots import ALIENGO, GO2

DOMAIN, INTERFACE = int(os.environ["ROS_DOMAIN_ID"]), "lo"
PATIENCE_S = 40.0
VENDOR_CLIENT = Path(__file__).with_name("vendor_client.py")
TARGET = np.array(ALIENGO.nominal_q) + np.where(np.arange(12) == 3, 0.2, 0.0)  # the hip FL moves outward


wait_for = partial(boards.wait_for, patience=PATIENCE_S)


@pytest.fixture
def serve() -> Iterator[Callable[..., DdsBoard]]:
    """Runs a robot that hangs in the air behind a board."""
    with ExitStack() as ends:

        def begin(**network: float) -> DdsBoard:
            board = DdsBoard(Bus(DOMAIN, INTERFACE), NetworkConfig(**network))
            simulator = Simulator(SimulatorConfig(robot=ALIENGO, suspended=True, watchdog=0.5))
            ends.enter_context(boards.running(board, simulator))
            return board

        yield begin


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
    """The vendor's client in a process of its own."""

    def __init__(self, crc_error: int = 0) -> None:
        command = [sys.executable, str(VENDOR_CLIENT), str(DOMAIN), INTERFACE]
        self._process = subprocess.Popen(
            [*command, json.dumps(TARGET.tolist()), str(crc_error)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def says(self) -> Any:
        """The next value that it prints."""
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def go_on(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture
def vendor() -> Iterator[Callable[..., Vendor]]:
    made: list[Vendor] = []

    def begin(**options: int) -> Vendor:
        if not find_spec("unitree_sdk2py"):
            pytest.skip("needs unitree-sdk2py-dimos, which `make test` installs")
        made.append(Vendor(**options))
        return made[-1]

    yield begin
    for client in made:
        client.end()


def test_the_vendors_client_reads_states_releases_the_controller_and_moves_a_joint(
    serve: Serve, vendor: Callable[..., Vendor]
) -> None:
    board = serve()
    client = vendor()
    state = client.says()
    np.testing.assert_allclose(state["q"], ALIENGO.nominal_q, atol=0.2)
    assert (state["crc"], state["soc"]) == (0, 90)
    wait_for(lambda: board.counts["held"], board)
    assert board.counts["commands"] == 0
    client.go_on()
    before, released, after = client.says()
    assert before == [0, {"form": "0", "name": "mcf"}]
    assert released == [0, None]
    assert after == [0, {"form": "0", "name": ""}]
    assert board.loop is not None
    q = board.loop.simulator.data.qpos[7:]
    wait_for(lambda: abs(q[3] - TARGET[3]) < 0.05, board)


def test_the_vendors_client_is_refused_with_a_wrong_crc(serve: Serve, vendor: Callable[..., Vendor]) -> None:
    board = serve()
    board.select("")
    vendor(crc_error=1)
    wait_for(lambda: board.counts["wrong_crc"] > 3, board)
    assert board.counts["commands"] == 0
    assert board.last_refusal.startswith("command: CRC is 0x")

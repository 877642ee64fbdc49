"""The other end of the link: a plain socket on loopback that is used as a board would use it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
import pytest

from quadvel_description.state import JointCommand, RobotState
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState, Remote
from quadvel_driver.link import Link
from quadvel_driver.udp import UdpConfig, UdpTransport
from tests.helpers.robots import ALIENGO

NO_REMOTE = Remote()


def standing(tick: int, remote: Remote = NO_REMOTE) -> BoardState:
    """A robot that stands, as its board reports it."""
    robot = RobotState(
        time=0.0,
        tick=tick,
        q=np.array(ALIENGO.nominal_q),
        dq=np.zeros(12),
        tau=np.zeros(12),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
        linear_acceleration=np.array([0.0, 0.0, 9.81]),
        foot_force=np.full(4, 60.0),
    )
    return BoardState(
        robot, np.full(12, 10, np.uint8), np.zeros(12, np.uint32), np.full(12, 35, np.int8), 40, remote
    )


class TestBoard:
    """One end of a link: hears the commands of a driver and sends states. Not a robot: nothing moves."""

    __test__ = False

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(20.0)
        self.port = self.socket.getsockname()[1]
        self.client: tuple[str, int] | None = None

    def hear(self) -> JointCommand:
        """The next command that comes."""
        data, self.client = self.socket.recvfrom(2048)
        return wire.decode_command(data)

    def hear_until(self, condition: Callable[[JointCommand], bool]) -> JointCommand:
        """The first command that fulfils a condition."""
        deadline = time.monotonic() + 20.0
        while time.monotonic() < deadline:
            command = self.hear()
            if condition(command):
                return command
        raise AssertionError("no such command came")

    def forget(self) -> None:
        """Throw away what came and was not heard yet."""
        self.socket.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                self.socket.recv(2048)
        self.socket.settimeout(20.0)

    def send(self, data: bytes) -> None:
        """Send a datagram to whom a command came from last."""
        if self.client is None:
            self.hear()
        assert self.client is not None
        self.socket.sendto(data, self.client)

    def report(self, states: int = 400, first: int = 1000, remote: Remote = NO_REMOTE) -> int:
        """Send that many states, one each ms, counted in ms; the tick after the last."""
        begin = time.monotonic()
        for i in range(states):
            time.sleep(max(begin + 1e-3 * i - time.monotonic(), 0.0))
            tick = max(first + i, first + round(1e3 * (time.monotonic() - begin)))
            self.send(wire.encode_state(standing(tick, remote)))
        return first + round(1e3 * (time.monotonic() - begin)) + 1

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def board() -> Iterator[TestBoard]:
    board = TestBoard()
    yield board
    board.close()


class Linked:
    """A link that runs in a thread, and the states that it handed on."""

    def __init__(self, config: UdpConfig) -> None:
        self.states: list[BoardState] = []
        self.transport = UdpTransport(config)
        self.link = Link(ALIENGO, wire, self.transport, config, self.states.append)
        self._thread = threading.Thread(target=self.link.run)

    def start(self) -> Link:
        self._thread.start()
        return self.link

    def stop(self) -> None:
        self.link.stop()
        if self._thread.ident:
            self._thread.join()
        else:
            self.link.run()

    def wait_for(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline, f"time is up; {self.link.report()}"
            time.sleep(0.005)


@pytest.fixture
def connect(board: TestBoard) -> Iterator[Callable[..., Linked]]:
    """Makes a link to the board; it ends with the test."""
    made: list[Linked] = []

    def make(**changes: object) -> Linked:
        values = {"board_address": "127.0.0.1", "board_port": board.port, "local_port": 0}
        made.append(Linked(UdpConfig(**{**values, **changes})))
        return made[-1]

    yield make
    for linked in made:
        linked.stop()

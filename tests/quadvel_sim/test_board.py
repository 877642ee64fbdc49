"""Tests of the simulated board over UDP on loopback with the link of the real driver."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from quadvel_description.kinematics import roll_pitch
from quadvel_description.state import JointCommand
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState
from quadvel_driver.calibration import Calibration
from quadvel_driver.link import NO_CALIBRATION, Link
from quadvel_driver.udp import UdpConfig, UdpTransport
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.board import Board, BoardError
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.loop import SimulationLoop
from quadvel_sim.simulator import Simulator
from quadvel_sim.udp_board import UdpBoard
from tests.helpers.boards import running, wait_for
from tests.helpers.robots import ALIENGO

Wait = Callable[[Callable[[], object]], None]


@pytest.fixture
def serve() -> Iterator[Callable[..., Board]]:
    """Runs a robot that stands behind a board on any free port."""
    with ExitStack() as ends:

        def begin(off: Calibration = NO_CALIBRATION, **network: float) -> Board:
            board = UdpBoard(("127.0.0.1", 0), NetworkConfig(**network), off)
            ends.enter_context(running(board, Simulator(SimulatorConfig(robot=ALIENGO))))
            return board

        yield begin


@pytest.fixture
def link() -> Iterator[Callable[[Board], tuple[Link, list[BoardState]]]]:
    """Connects the driver's link to a board; it holds the robot up."""
    ends: list[Callable[[], None]] = []

    def begin(board: Board, calibration: Calibration = NO_CALIBRATION) -> tuple[Link, list[BoardState]]:
        states: list[BoardState] = []
        host, port = board.address
        config = UdpConfig(board_address=host, board_port=port, local_port=0, command_timeout=0.5)

        def hold(state: BoardState) -> None:
            states.append(state)
            gains = {"kp": np.full(12, 150.0), "kd": np.full(12, 4.0)}
            made.submit(JointCommand(q=np.array(ALIENGO.nominal_q), tick=state.robot.tick, **gains))

        made = Link(ALIENGO, wire, UdpTransport(config), config, hold, calibration)
        thread = threading.Thread(target=made.run)
        thread.start()
        ends.extend((made.stop, thread.join))
        return made, states

    yield begin
    for end in ends:
        end()


Serve = Callable[..., Board]
Connect = Callable[..., Any]


def test_the_real_link_holds_the_simulated_robot_up(serve: Serve, link: Connect) -> None:
    board = serve()
    _, states = link(board)
    wait_for(lambda: len(states) > 300, board)
    robot = states[-1].robot
    np.testing.assert_allclose(robot.q, ALIENGO.nominal_q, atol=0.15)
    assert robot.linear_acceleration[2] == pytest.approx(9.81, abs=2.0)
    assert (states[-1].motor_mode == 10).all()
    assert not board.loop.simulator.fallen
    assert board.counts["commands"] > 0


def test_a_robot_whose_sensors_are_off_is_set_right_by_its_calibration(serve: Serve, link: Connect) -> None:
    off = Calibration(joint_zeros=np.tile([0.1, -0.1, 0.15], 4), imu_mounting=np.array([0.03, -0.02]))
    board = serve(off)
    _, states = link(board, off)
    wait_for(lambda: len(states) > 500, board)
    robot, truth = states[-1].robot, board.loop.simulator
    np.testing.assert_allclose(truth.data.qpos[7:], ALIENGO.nominal_q, atol=0.12)
    np.testing.assert_allclose(robot.q, truth.data.qpos[7:], atol=0.02)
    assert np.abs(roll_pitch(robot.quaternion) - roll_pitch(truth.data.qpos[3:7])).max() < 0.01


def test_a_network_that_does_everything_wrong_does_not_let_it_fall(serve: Serve, link: Connect) -> None:
    board = serve(
        network_loss=0.1,
        network_jitter=0.002,
        network_duplicates=0.1,
        network_reordering=0.1,
        network_corruption=0.05,
    )
    made, states = link(board)
    wait_for(lambda: len(states) > 300, board)
    counts = made.report().counts
    assert counts["wrong_crc"] + counts["unusable"] > 0
    assert counts["late"] > 0
    assert counts["repeated"] > 0
    assert board.counts["wrong_crc"] > 0
    assert not board.loop.simulator.fallen
    ticks = [state.robot.tick for state in states]
    assert ticks == sorted({*ticks})


def test_it_reports_the_mode_that_each_motor_was_asked_for(serve: Serve) -> None:
    board = serve()
    packet = bytearray(
        wire.encode_command(JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, 150.0)))
    )
    packet[10 + 27 * 4] = 0
    packet[-4:] = wire.crc(bytes(packet[:604])).to_bytes(4, "little")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(board.address)
        client.settimeout(20.0)
        modes: list[int] = [0]
        while not any(modes):
            client.send(bytes(packet))
            modes = wire.decode_state(client.recv(2048)).motor_mode.tolist()
    assert modes == [0 if joint == 4 else 10 for joint in range(12)]


def test_of_commands_that_waited_during_a_stall_the_newest_is_executed_at_once() -> None:
    board = UdpBoard(("127.0.0.1", 0), NetworkConfig())
    board.loop = SimulationLoop(
        Simulator(SimulatorConfig(robot=ALIENGO)), board.publish, period=1, answer_timeout=0.0
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(board.address)
        for kp in range(100):
            client.send(
                wire.encode_command(JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, float(kp))))
            )
        command = board.receive()
    assert command is not None
    np.testing.assert_array_equal(command.kp, 99.0)
    assert board.receive() is None
    assert board.counts == {"commands": 1}
    board.close()


def test_it_names_the_reason_of_the_last_datagram_that_it_could_not_use(serve: Serve) -> None:
    board = serve()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second,
    ):
        for client in (first, second):
            client.connect(board.address)
        first.send(b"short")
        wait_for(lambda: board.counts["wrong_length"], board)
        assert "5 bytes, expected 610" in board.last_refusal
        second.send(b"short")
        wait_for(lambda: board.counts["from_others"], board)
        assert f"{second.getsockname()[1]} is not served" in board.last_refusal


def test_the_drives_brake_by_themselves_once_the_link_is_gone(serve: Serve) -> None:
    board = serve()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(board.address)
        client.settimeout(20.0)
        client.send(wire.encode_command(JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, 150.0))))
        modes = [int(wire.decode_state(client.recv(2048)).motor_mode[0])]
        while modes[-1] != 10:
            modes.append(int(wire.decode_state(client.recv(2048)).motor_mode[0]))
        while modes[-1] != 0:
            modes.append(int(wire.decode_state(client.recv(2048)).motor_mode[0]))


def test_one_client_is_served_and_after_its_silence_the_next(serve: Serve) -> None:
    board = serve()
    packet = wire.encode_command(JointCommand.damping())
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for client in clients:
        client.connect(board.address)
        client.settimeout(20.0)
    clients[0].send(packet)
    clients[0].recv(2048)
    clients[1].send(packet)
    wait_for(lambda: board.counts["from_others"] == 1, board)

    def is_served() -> bool:
        clients[1].send(packet)
        clients[1].settimeout(0.1)
        try:
            return len(clients[1].recv(2048)) == wire.STATE_BYTES
        except TimeoutError:
            return False

    wait_for(is_served, board)
    for client in clients:
        client.close()


@pytest.mark.parametrize(
    ("datagram", "counted"),
    [
        (bytes(540), "wrong_length"),
        (bytes(609) + b"\1", "wrong_crc"),
        (b"", "wrong_length"),
    ],
)
def test_what_is_no_command_is_counted_and_moves_nothing(serve: Serve, datagram: bytes, counted: str) -> None:
    board = serve()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect(board.address)
        client.send(datagram)
        wait_for(lambda: board.counts[counted] == 1, board)
    assert board.loop.simulator.braking
    assert "expected" in board.last_refusal


def test_a_port_that_is_taken_is_told_in_one_sentence(serve: Serve) -> None:
    host, port = serve().address
    with pytest.raises(BoardError, match=rf"the board can't listen on {host}:{port}: .*in use"):
        UdpBoard((host, port), NetworkConfig())

"""The link over real UDP on loopback: what it sends, what it takes, and when it brakes."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from quadvel_description.state import MODE_SERVO, JointCommand
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState
from quadvel_driver.link import SHUTDOWN_PACKETS, LinkError, clamp_for_board
from quadvel_driver.udp import UdpConfig, UdpTransport
from tests.helpers.robots import ALIENGO

from .conftest import TestBoard, standing

Connect = Callable[..., Any]
HELD = {"command_timeout": 0.5}  # long enough for a machine that is busy


def hold(tick: int = 0, kp: float = 100.0) -> JointCommand:
    return JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, kp), kd=np.full(12, 3.0), tick=tick)


def brakes(command: JointCommand, kd: float = 5.0) -> bool:
    """Whether the joints are damped in so many words: as a servo without stiffness."""
    return (
        command.mode == MODE_SERVO
        and not command.kp.any()
        and not command.tau.any()
        and (command.kd == kd).all()
    )


def test_a_link_without_commands_brakes_and_so_has_the_board_report(
    board: TestBoard, connect: Connect
) -> None:
    connect().start()
    for _ in range(5):
        assert brakes(board.hear())


def test_the_last_command_is_sent_again_and_again(board: TestBoard, connect: Connect) -> None:
    link = connect(**HELD).start()
    link.submit(hold())
    board.hear_until(lambda command: command.kp[0] == 100.0)
    for _ in range(10):
        assert board.hear().kp[0] == 100.0


def test_the_link_brakes_where_commands_stop_and_follows_where_they_come_again(
    board: TestBoard, connect: Connect
) -> None:
    linked = connect(command_timeout=0.05)
    link = linked.start()
    link.submit(hold())
    board.hear_until(lambda command: command.kp[0] == 100.0)
    board.hear_until(brakes)
    assert link.report().counts["command_timeouts"] == 1
    link.submit(hold(kp=80.0))
    board.hear_until(lambda command: command.kp[0] == 80.0)


def test_the_gain_of_its_brake_is_a_setting(board: TestBoard, connect: Connect) -> None:
    connect(damping_kd=2.0).start()
    assert brakes(board.hear(), kd=2.0)


def test_at_the_end_the_robot_is_left_braking(board: TestBoard, connect: Connect) -> None:
    linked = connect(**HELD)
    link = linked.start()
    link.submit(hold())
    board.hear_until(lambda command: command.kp[0] == 100.0)
    linked.stop()
    board.hear_until(brakes)
    for _ in range(SHUTDOWN_PACKETS - 1):
        assert brakes(board.hear())


def test_states_arrive_with_their_instant_and_the_boards_tick(board: TestBoard, connect: Connect) -> None:
    linked = connect()
    linked.start()
    board.report()
    linked.wait_for(lambda: len(linked.states) > 50)
    ticks = [state.robot.tick for state in linked.states]
    assert ticks == sorted({*ticks})
    assert ticks[0] > 1000
    times = np.array([state.robot.time for state in linked.states])
    assert (np.diff(times) > 0.0).all()
    assert linked.link.report().tick_unit == "ms"
    np.testing.assert_array_equal(linked.states[-1].temperature, 35)


def test_of_states_that_wait_the_newest_wins(board: TestBoard, connect: Connect) -> None:
    linked = connect()
    link = linked.start()
    after = board.report()
    linked.wait_for(lambda: linked.states)
    linked.stop()
    before = link.report().counts
    board.forget()
    again = connect()
    again.link._board_clock = link._board_clock
    again.link.brake()  # lets the board know it
    board.hear_until(lambda command: board.client[1] == again.transport.local_port)
    for tick in (after, after + 1, after + 4, after + 3, after + 4):
        board.send(wire.encode_state(standing(tick)))
    again.start()
    again.wait_for(lambda: again.states)
    assert [state.robot.tick for state in again.states] == [after + 4]
    counts = again.link.report().counts
    more = [counts[name] - before[name] for name in ("late", "repeated")]
    assert (counts["superseded"], *more) == (2, 1, 1)


def test_after_a_stall_only_the_newest_states_are_decoded(
    board: TestBoard, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked = connect()
    linked.link.brake()  # lets the board know the link
    decode, ticks = wire.decode_state, []

    def note(data: bytes) -> BoardState:
        state = decode(data)
        ticks.append(state.robot.tick)
        return state

    monkeypatch.setattr(wire, "decode_state", note)
    for tick in range(1000, 1060):
        board.send(wire.encode_state(standing(tick)))
    linked.link.serve()
    assert ticks[-1] == 1059
    assert len(ticks) <= 10


def corrupted(data: bytes) -> bytes:
    return data[:100] + bytes([data[100] ^ 1]) + data[101:]


@pytest.mark.parametrize(
    ("datagram", "counted", "reason"),
    [
        (bytes(684), "wrong_length", "684 bytes, the state of firmware 3.1 (aliengo_sdk 1.2), expected 771"),
        (b"", "wrong_length", "0 bytes, expected 771"),
        (corrupted(wire.encode_state(standing(7))), "wrong_crc", "CRC is 0x"),
        (wire.encode_state(standing(0)), "unusable", "tick is 0, expected a counter that runs"),
    ],
)
def test_what_is_no_state_is_counted_named_and_dropped(
    board: TestBoard, connect: Connect, datagram: bytes, counted: str, reason: str
) -> None:
    linked = connect()
    link = linked.start()
    board.send(datagram)
    reports = []
    linked.wait_for(lambda: reports.append(link.report()) or reports[-1].counts[counted] == 1)
    assert reason in reports[-1].last_refusal
    board.report()
    linked.wait_for(lambda: linked.states)
    assert all(state.robot.tick >= 1000 for state in linked.states)


def test_a_state_of_nothing_but_zeros_is_refused(board: TestBoard, connect: Connect) -> None:
    nothing = standing(5)
    nothing.robot.q[:] = nothing.robot.quaternion[:] = 0.0
    linked = connect()
    link = linked.start()
    board.send(wire.encode_state(nothing))
    linked.wait_for(
        lambda: "quaternion has length 0, expected 1, and all joints are at 0" in link.report().last_refusal
    )


def test_nobody_but_the_board_is_heard(board: TestBoard, connect: Connect) -> None:
    linked = connect()
    linked.start()
    board.report()
    linked.wait_for(lambda: linked.states)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.1", 0))
        for i in range(50):
            stranger.sendto(
                wire.encode_state(standing(2_000_000 + i)), ("127.0.0.1", linked.transport.local_port)
            )
    board.report(50, first=9000)
    linked.wait_for(lambda: linked.states[-1].robot.tick >= 9000)
    assert max(state.robot.tick for state in linked.states) < 100_000


def test_a_brake_holds_whatever_is_commanded_until_it_is_released(board: TestBoard, connect: Connect) -> None:
    link = connect(**HELD).start()
    link.submit(hold())
    board.hear_until(lambda command: command.kp[0] == 100.0)
    link.brake()
    board.hear_until(brakes)
    link.submit(hold())
    for _ in range(5):
        assert brakes(board.hear())
    assert not link.report().commanded
    assert link.release() == "the controller still drives the joints; it has to be passive first"
    assert brakes(board.hear())
    link.submit(JointCommand.damping())
    assert link.release() == ""
    link.submit(hold())
    board.hear_until(lambda command: command.kp[0] == 100.0)
    assert link.report().commanded


def test_commands_that_are_not_fit_are_refused_and_not_sent(board: TestBoard, connect: Connect) -> None:
    linked = connect(**HELD)
    link = linked.start()
    board.report()
    linked.wait_for(lambda: linked.states)
    newest = linked.states[-1].robot.tick
    broken = hold(newest)
    broken.kp[3] = np.nan
    with pytest.raises(ValueError, match="kp of FL_hip_joint is nan, expected a finite number"):
        link.submit(broken)
    with pytest.raises(ValueError, match=r"it answers tick .*, 150 ms ago: expected at most 100 ms"):
        link.submit(hold((newest - 150) % 2**32))
    with pytest.raises(ValueError, match="which is to come"):
        link.submit(hold(newest + 1))
    for _ in range(20):
        assert brakes(board.hear())


def test_a_board_that_is_not_there_is_told_and_found_once_it_is(connect: Connect) -> None:
    late = TestBoard()
    late.close()
    linked = connect(board_port=late.port)
    link = linked.start()
    reports = []
    linked.wait_for(lambda: reports.append(link.report()) or reports[-1].counts["network_errors"] > 0)
    assert "refused" in reports[-1].last_error
    late.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    late.socket.bind(("127.0.0.1", late.port))
    late.report()
    linked.wait_for(lambda: linked.states)
    late.close()


def test_a_port_that_is_taken_is_told_in_one_sentence(board: TestBoard) -> None:
    config = UdpConfig(board_address="127.0.0.1", local_address="127.0.0.1", local_port=board.port)
    with pytest.raises(LinkError, match=rf"no link from 127.0.0.1:{board.port} to 127.0.0.1:8007: .*in use"):
        UdpTransport(config)


def test_an_empty_address_is_refused() -> None:
    with pytest.raises(ValueError, match="board_address: found '', expected"):
        UdpConfig(board_address="")


def test_an_address_that_is_none_is_told_in_one_sentence() -> None:
    with pytest.raises(LinkError, match=r"no link from any address:0 to 300\.1\.1\.1:8007: "):
        UdpTransport(UdpConfig(board_address="300.1.1.1", local_port=0))


def test_nothing_beyond_the_robots_limits_is_sent() -> None:
    wild = JointCommand(*(np.full(12, 1e6) for _ in range(3)), kp=np.full(12, 50.0), kd=np.ones(12))
    sent = clamp_for_board(wild, ALIENGO)
    np.testing.assert_array_equal(sent.q, ALIENGO.command_upper)
    np.testing.assert_array_equal(sent.dq, ALIENGO.velocity_limit)
    np.testing.assert_array_equal(sent.tau, ALIENGO.torque_limit)

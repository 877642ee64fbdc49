"""Orders to a simulated robot, whichever node simulates it, and what is said where none does."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

import quadvel_dds

quadvel_dds.install()

from std_srvs.srv import SetBool  # noqa: E402

from quadvel_bringup import operator_commands, session  # noqa: E402
from quadvel_bringup.nodes import process_command  # noqa: E402


@pytest.fixture
def board() -> Iterator[None]:
    """A simulated robot behind the AlienGo's UDP interface. sim_node is in tests/end_to_end/test_operator.py."""
    process = subprocess.Popen(process_command("board", ["--ros-args", "-p", "port:=0"]))
    yield
    process.send_signal(signal.SIGINT)
    assert process.wait(40.0) == 0


def test_a_robot_behind_the_board_takes_the_same_orders_as_any_simulated_one(
    board: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "DISCOVERY_TIMEOUT_S", 40.0)  # it is only starting
    assert operator_commands.pause(True) == 0
    assert operator_commands.step(20) == 0
    assert operator_commands.push((0.0, 60.0, 0.0), 0.2, "trunk") == 0
    assert operator_commands.reset("stand") == 0
    done = ["paused", "advances by 20 ms", "trunk is pushed", "the robot is back in posture stand"]
    assert capsys.readouterr().out.splitlines() == done


def test_without_a_simulator_it_is_said_how_to_start_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "DISCOVERY_TIMEOUT_S", 0.2)
    text = (
        "sim_node/reset or board/reset: service not available; there is no simulator; start one: quadvel up"
    )
    with pytest.raises(session.NotRunningError, match=re.escape(text)):
        operator_commands.reset("lie")


DRIVER = """
import quadvel_dds
quadvel_dds.install()
import rclpy
from quadvel_msgs.msg import LowState
rclpy.init(args=[])
node = rclpy.create_node("driver")
node.create_publisher(LowState, "low_state", 1)
print("ready", flush=True)
input()
rclpy.shutdown()
"""


def test_a_push_without_a_force_is_refused() -> None:
    with pytest.raises(ValueError, match="--fx"):
        operator_commands.push((0.0, 0.0, 0.0), 0.2, "trunk")


def test_a_robot_that_nobody_simulates_is_not_pushed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "DISCOVERY_TIMEOUT_S", 2.0)
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert driver.stdout is not None
    assert driver.stdout.readline() == "ready\n"
    try:
        with pytest.raises(session.NotRunningError, match="a real one does not support this command"):
            operator_commands.push((0.0, 60.0, 0.0), 0.2, "trunk")
    finally:
        driver.communicate("\n", timeout=40.0)


class Deaf:
    """A client whose first requests are lost, and how often it was asked."""

    def __init__(self, lost: int, answer: object) -> None:
        self.lost, self.asked, self._answer = lost, 0, answer
        self.service_name = "/deaf"

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: object) -> Deaf:
        self.asked += 1
        return self

    def done(self) -> bool:
        return self.asked > self.lost

    def result(self) -> object:
        return self._answer


@pytest.mark.parametrize("repeats", [True, False])
def test_an_order_without_an_answer_is_given_again_if_that_does_no_harm(
    repeats: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "SERVICE_TIMEOUT_S", 0.5)
    monkeypatch.setattr(session, "SERVICE_RETRY_S", 0.1)
    client = Deaf(2, answer := SetBool.Response(success=True))
    with session.Session("test") as node:
        monkeypatch.setattr(node.node, "create_client", lambda kind, service: client)
        if repeats:
            assert node.call(SetBool, ["deaf"], str, data=True) is answer
            assert client.asked == 3
        else:
            with pytest.raises(session.NotRunningError, match=r"/deaf: no answer within 0\.5 s"):
                node.call(SetBool, ["deaf"], str, may_retry=False, data=True)
            assert client.asked == 1

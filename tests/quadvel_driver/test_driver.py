"""The node as a process: topics over DDS on one side, packets over UDP on the other."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import groupby
from typing import Any

import numpy as np
import pytest

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import Twist  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import Bool  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

from quadvel_bringup.nodes import process_command as node_command  # noqa: E402
from quadvel_description.state import JointCommand  # noqa: E402
from quadvel_driver import wire  # noqa: E402
from quadvel_driver.board_state import Button, Remote  # noqa: E402
from quadvel_driver.remote import BUTTONS, OperatorCommand  # noqa: E402
from quadvel_msgs.msg import LowCmd, LowState  # noqa: E402
from quadvel_msgs.srv import SetMode  # noqa: E402
from quadvel_nodes.messages import write_low_cmd  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

from .conftest import NO_REMOTE, TestBoard, standing  # noqa: E402

TOPICS = {
    "low_state": LowState,
    "imu": Imu,
    "joint_states": JointState,
    "cmd_vel_teleop": Twist,
    "command_lock": Bool,
    "/diagnostics": DiagnosticArray,
}


class Controller:
    """Stands where the controller does: hears the driver's topics, sends low_cmd, offers the services."""

    def __init__(self) -> None:
        self.node = Node("controller")
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.asked: list[object] = []
        self.kp: float | None = None  # of the commands with which states are answered; None: not at all
        self._low_cmd = self.node.create_publisher(LowCmd, "low_cmd", 1)
        for topic, kind in TOPICS.items():
            self.node.create_subscription(kind, topic, lambda message, t=topic: self._hear(t, message), 100)
        self.node.create_service(SetMode, "controller/set_mode", self._on_mode)
        self.node.create_service(SetBool, "controller/enable_walking", self._on_enable)

    def _hear(self, topic: str, message: Any) -> None:
        self.heard[topic].append(message)
        if topic == "low_state" and self.kp is not None:
            twelve = np.full(12, self.kp)
            command = JointCommand(
                q=np.array(ALIENGO.nominal_q), kp=twelve, kd=np.full(12, 3.0), tick=message.tick
            )
            answer = LowCmd()
            write_low_cmd(command if self.kp else JointCommand.damping(tick=message.tick), answer)
            self._low_cmd.publish(answer)

    def _on_mode(self, request: Any, response: Any) -> Any:
        self.asked.append(request.mode)
        if request.mode == "passive":
            self.kp = 0.0
        response.success, response.message = True, f"mode is {request.mode}"
        return response

    def _on_enable(self, request: Any, response: Any) -> Any:
        self.asked.append(request.data)
        response.success = True
        return response

    def spin_until(self, condition: Callable[[], object], seconds: float = 40.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            heard = {topic: len(messages) for topic, messages in self.heard.items()}
            assert time.monotonic() < deadline, (
                f"time is up; heard {heard}, asked {self.asked}, {self.diagnosed()}"
            )
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def diagnosed(self) -> tuple[str, dict[str, str]]:
        """Summary and values of the driver's last report."""
        statuses = [status for message in self.heard["/diagnostics"] for status in message.status]
        if not statuses:
            return "", {}
        return statuses[-1].message, {pair.key: pair.value for pair in statuses[-1].values}


class RunningBoard:
    """A board that reports each ms in a thread, until it is stopped, and records the commands."""

    def __init__(self, board: TestBoard) -> None:
        self.remote = NO_REMOTE
        self.silent = False
        self.commands: list[JointCommand] = []
        self._board = board
        self._board.socket.settimeout(0.001)
        self._ended = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        begin = time.monotonic()
        while not self._ended:
            with suppress(TimeoutError):
                self.commands.append(self._board.hear())
            if self._board.client and not self.silent:
                tick = 1000 + round(1e3 * (time.monotonic() - begin))
                self._board.send(wire.encode_state(standing(tick, self.remote)))

    def last(self) -> float:
        """Stiffness of the last command."""
        return float(self.commands[-1].kp[0]) if self.commands else -1.0

    def stop(self) -> None:
        self._ended = True
        self._thread.join()


@pytest.fixture
def controller() -> Iterator[Controller]:
    rclpy.init(args=["test"])
    controller = Controller()
    yield controller
    controller.node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def running(board: TestBoard) -> Iterator[RunningBoard]:
    running = RunningBoard(board)
    yield running
    running.stop()


@pytest.fixture
def start(board: TestBoard) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the node with the address of the board; it ends with the test."""
    started: list[subprocess.Popen[str]] = []

    def begin(**parameters: object) -> subprocess.Popen[str]:
        values = {"board_address": "127.0.0.1", "board_port": board.port, "local_port": 0}
        values |= {"command_timeout": 0.5, **parameters}
        arguments = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
        started.append(
            subprocess.Popen(
                node_command("driver", ["--ros-args", *arguments]), stderr=subprocess.PIPE, text=True
            )
        )
        return started[-1]

    yield begin
    for process in started:
        process.send_signal(signal.SIGINT)  # cleanly, so that its topics disappear
        process.communicate(timeout=40.0)


Start = Callable[..., "subprocess.Popen[str]"]


def test_states_and_commands_pass_through(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start()
    states = controller.heard["low_state"]
    controller.spin_until(lambda: len(states) > 20)
    np.testing.assert_allclose(states[-1].q, ALIENGO.nominal_q, atol=1e-6)
    stamps = [state.stamp.sec + 1e-9 * state.stamp.nanosec for state in states]
    assert abs(stamps[-1] - time.time()) < 5.0
    assert (np.diff(stamps) > 0.0).all()
    controller.kp = 70.0
    controller.spin_until(lambda: running.last() == 70.0)
    controller.spin_until(lambda: controller.heard["imu"] and controller.heard["joint_states"])
    assert controller.heard["imu"][-1].header.frame_id == "imu_link"
    controller.spin_until(lambda: controller.diagnosed()[0] == "commands are followed")
    values = controller.diagnosed()[1]
    assert values["robot"] == "aliengo"
    assert values["tick_unit"] == "ms"
    assert values["RL_calf_joint temperature"] == "35"
    assert values["RL_calf_joint mode"] == "10"


def test_the_rate_of_states_is_a_parameter(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start(state_rate=50)
    states = controller.heard["low_state"]
    controller.spin_until(lambda: len(states) > 30)
    ticks = np.array([state.tick for state in states], float)
    assert np.median(np.diff(ticks)) == pytest.approx(20.0, abs=4.0)


def test_without_a_board_it_says_what_to_look_at(
    start: Start, board: TestBoard, controller: Controller
) -> None:
    process = start()
    controller.spin_until(lambda: "no state from 127.0.0.1" in controller.diagnosed()[0])
    assert "yet: is the robot on and in low-level mode" in controller.diagnosed()[0]
    board.send(bytes(684))
    controller.spin_until(lambda: "684 bytes, the state of firmware 3.1" in controller.diagnosed()[0])
    controller.spin_until(lambda: len(controller.heard["/diagnostics"]) > 4)
    process.send_signal(signal.SIGINT)
    assert "no state from 127.0.0.1" in process.communicate(timeout=40.0)[1]  # in the log too


def test_a_controller_that_dies_leaves_the_joints_damped(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start(command_timeout=0.1)
    controller.kp = 70.0
    controller.spin_until(lambda: running.last() == 70.0)
    controller.kp = None
    controller.spin_until(lambda: running.last() == 0.0)
    assert running.commands[-1].kd[0] == 5.0
    controller.spin_until(lambda: int(controller.diagnosed()[1].get("command_timeouts", 0)) >= 1)


def test_commands_that_are_not_fit_are_refused_and_named(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start()
    controller.spin_until(lambda: controller.heard["low_state"])
    broken = LowCmd()
    write_low_cmd(JointCommand(kd=np.full(12, np.nan)), broken)
    controller._low_cmd.publish(broken)
    controller.spin_until(lambda: "kd holds nan" in controller.diagnosed()[1].get("refused low_cmd", ""))
    assert running.last() == 0.0


def press(running: RunningBoard, controller: Controller, order: OperatorCommand) -> None:
    """Press the buttons of a command for a moment."""
    for remote in (Remote(BUTTONS[order]), NO_REMOTE):
        running.remote = remote
        seen = len(controller.heard["low_state"])
        controller.spin_until(lambda: len(controller.heard["low_state"]) > seen + 40)  # noqa: B023


def test_the_remote_drives_stands_the_robot_up_and_lets_it_walk(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start()
    for order, asked in (
        (OperatorCommand.STAND_UP, "stand_up"),
        (OperatorCommand.ALLOW_WALKING, True),
        (OperatorCommand.FORBID_WALKING, False),
        (OperatorCommand.LIE_DOWN, "lie_down"),
    ):
        while not (controller.asked and controller.asked[-1] == asked):
            press(running, controller, order)  # and again where the driver had not found the controller yet
    assert [asked for asked, _ in groupby(controller.asked)] == ["stand_up", True, False, "lie_down"]
    running.remote = Remote(ly=1.0)
    controller.spin_until(lambda: controller.heard["cmd_vel_teleop"])
    assert controller.heard["cmd_vel_teleop"][-1].linear.x == pytest.approx(0.8)


def test_a_stop_damps_locks_and_asks_for_passive_and_holds_until_it_is_released(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start()
    controller.kp = 70.0
    controller.spin_until(lambda: running.last() == 70.0)
    running.remote = Remote(Button.B)
    controller.spin_until(lambda: {*controller.asked} == {"passive"} and running.last() == 0.0)
    controller.spin_until(lambda: len(controller.heard["command_lock"]) > 3)
    assert all(message.data for message in controller.heard["command_lock"])
    controller.kp = 70.0  # a controller that does not listen
    running.remote = NO_REMOTE
    controller.spin_until(lambda: "stopped by the remote" in controller.diagnosed()[0])
    running.remote = Remote(BUTTONS[OperatorCommand.RELEASE])
    seen = len(running.commands)
    controller.spin_until(lambda: len(running.commands) > seen + 100)
    assert running.last() == 0.0
    running.remote = NO_REMOTE
    controller.kp = 0.0
    controller.spin_until(lambda: len(running.commands) > seen + 200)
    running.remote = Remote(BUTTONS[OperatorCommand.RELEASE])
    controller.spin_until(lambda: not controller.heard["command_lock"][-1].data)
    controller.kp = 70.0
    controller.spin_until(lambda: running.last() == 70.0)


def test_a_dry_run_sends_nothing_and_shows_what_it_would_send(
    start: Start, board: TestBoard, controller: Controller
) -> None:
    process = start(dry_run=True)
    message = LowCmd()
    write_low_cmd(JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, 55.0)), message)

    controller.spin_until(lambda: controller._low_cmd.get_subscription_count() > 0)
    until = time.monotonic() + 2.5
    while time.monotonic() < until:
        controller._low_cmd.publish(message)
        rclpy.spin_once(controller.node, timeout_sec=0.05)
    assert controller.node.count_publishers("low_state") == 0
    process.send_signal(signal.SIGINT)
    _, text = process.communicate(timeout=40.0)
    assert process.returncode == 0
    assert "packets would have been sent, the last: mode servo, 610 bytes, ff" in text
    assert "hip q +0.000 dq +0.00 tau +0.00 kp 55 kd 0" in text
    board.socket.setblocking(False)
    with pytest.raises(BlockingIOError):
        board.hear()


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_ends_it_cleanly_and_leaves_the_joints_damped(
    start: Start, running: RunningBoard, controller: Controller, times: int
) -> None:
    process = start()
    controller.kp = 70.0
    controller.spin_until(lambda: running.last() == 70.0)
    for _ in range(times):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    _, text = process.communicate(timeout=40.0)
    assert (process.returncode, "Traceback" in text) == (0, False), text
    controller.spin_until(lambda: running.last() == 0.0)


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"board_address": "300.1.1.1"}, "no link from any address:0 to 300.1.1.1:"),
        ({"interface": "nosuch0"}, "no link from any address:0 on nosuch0 to 127.0.0.1:"),
        ({"robot": "go2", "interface": "nosuch0"}, "no link to DDS domain 0 on nosuch0: "),
        ({"calibration": "/nowhere.yaml"}, "cannot read /nowhere.yaml: No such file"),
        ({"state_rate": 2000}, "state_rate: found 2000, expected a whole number, 50 to 1000"),
        ({"command_timeout": 2.0}, "command_timeout: found 2.0, expected above 0 and at most 0.5"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_one_sentence(
    start: Start, parameters: dict, sentence: str
) -> None:
    process = start(**parameters)
    _, text = process.communicate(timeout=40.0)
    assert process.returncode == 2
    assert sentence in text
    assert len(text.strip().splitlines()) == 1


@pytest.mark.long  # Fast DDS may need longer than the driver looks for others
def test_a_second_driver_refuses_to_start(
    start: Start, running: RunningBoard, controller: Controller
) -> None:
    start()
    controller.spin_until(lambda: controller.heard["low_state"])
    second = start()
    _, text = second.communicate(timeout=40.0)
    assert second.returncode == 2
    assert "driver: low_state is already published, by another driver or" in text


DYING_LINK = """
import quadvel_dds
quadvel_dds.install()
from quadvel_driver import driver, link
def die(self):
    raise OSError("the network card is gone")
link.Link.run = die
driver.main()
"""


def test_a_dry_run_whose_link_dies_ends_with_the_cause() -> None:
    command = [sys.executable, "-c", DYING_LINK, "--ros-args", "-p", "dry_run:=true"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert ended.returncode != 0
    assert "the network card is gone" in ended.stdout + ended.stderr

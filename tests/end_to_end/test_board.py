"""The robot behind the AlienGo's interface: `quadvel up --low-level board`, driven by its remote alone.

Board, driver, estimator, controller and mux are processes; packets go over UDP on loopback, the rest over DDS. The operator's
remote is a joystick at the board, so that all it does comes through the packets. A board does not wait, so this needs a
machine with time to spare: pytest -m realtime.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import Joy  # noqa: E402

from quadvel_bringup.stack import PARAMETERS  # noqa: E402
from quadvel_driver.board_state import Button  # noqa: E402
from quadvel_driver.remote import BUTTONS, OperatorCommand  # noqa: E402
from quadvel_msgs.msg import ControllerState  # noqa: E402

pytestmark = pytest.mark.realtime

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")
NO_BUTTON = Button(0)
PATIENT = {
    "board": {"watchdog": 0.5, "network_loss": 0.02, "network_jitter": 0.001},
    "driver": {"command_timeout": 0.5},
    "controller": {
        "max_state_age": 3.0,
        "max_velocity_age": 3.0,
        "max_overruns": 1000,
        "require_operator": True,
    },
}


class Operator:
    """Holds the remote, and sees the robot."""

    def __init__(self) -> None:
        self.node = Node("operator")
        self.states: list[Any] = []
        self.speeds: list[float] = []
        self._held = Joy(axes=[0.0, 0.0, 0.0, 0.0], buttons=[0] * 16)
        self._joy = self.node.create_publisher(Joy, "board/remote", 10)
        self.node.create_subscription(ControllerState, "controller/state", self.states.append, 10)
        self.node.create_subscription(Odometry, "ground_truth/odom", self._on_truth, 10)
        self.node.create_timer(0.02, lambda: self._joy.publish(self._held))

    def _on_truth(self, message: Any) -> None:
        self.speeds.append(message.twist.twist.linear.x)

    def hold(self, buttons: Button = NO_BUTTON, ly: float = 0.0) -> None:
        self._held = Joy(axes=[0.0, ly, 0.0, 0.0], buttons=[int(bool(buttons & bit)) for bit in Button])

    @property
    def mode(self) -> str:
        return self.states[-1].mode_name if self.states else ""

    def speed(self) -> float:
        """Of the last half second, m/s."""
        return sum(self.speeds[-100:]) / 100.0

    def spin_until(self, condition: Callable[[], object], seconds: float = 60.0) -> None:
        until = time.monotonic() + seconds
        while not condition():
            reason = self.states[-1].reason if self.states else "no controller"
            assert time.monotonic() < until, f"time is up; {self.mode}: {reason}, {self.speed():.2f} m/s"
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def press(self, order: OperatorCommand) -> None:
        """Buttons down for a moment."""
        self.hold(BUTTONS[order])
        self.spin(0.3)
        self.hold()

    def order(self, order: OperatorCommand, condition: Callable[[], object]) -> None:
        """Press until it has its effect: on a busy machine the robot may need a while until it can follow."""
        until = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < until, (
                f"{order.value}: time is up; {self.mode}: {self.states[-1].reason}"
            )
            self.press(order)
            self.spin(1.0)

    def spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(self.node, timeout_sec=0.01)


@pytest.fixture
def operator() -> Iterator[Operator]:
    rclpy.init(args=["test"])
    operator = Operator()
    yield operator
    operator.node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Path]:
    """The running stack; the file that holds what it says."""
    parameters = yaml.safe_load(PARAMETERS.read_text())
    for node, values in PATIENT.items():
        parameters[node]["ros__parameters"] |= values
    file, log = tmp_path / "params.yaml", tmp_path / "log"
    file.write_text(yaml.safe_dump(parameters))
    with log.open("w") as output:
        process = subprocess.Popen(
            [*QUADVEL, "up", "--low-level", "board", "--params", str(file)],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        yield log
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 0, log.read_text()


def test_the_remote_stands_the_robot_up_walks_it_stops_it_and_lays_it_down(
    up: Path, operator: Operator
) -> None:
    operator.spin_until(lambda: operator.mode == "stance")
    operator.hold(ly=0.6)
    operator.spin(1.5)
    assert operator.mode == "stance"  # it was not allowed to walk
    operator.hold()
    operator.spin(1.0)
    operator.order(OperatorCommand.ALLOW_WALKING, lambda: operator.states[-1].walk_allowed)
    operator.spin(1.0)
    operator.hold(ly=0.6)
    operator.spin_until(lambda: operator.mode == "walk" and operator.speed() > 0.3)
    operator.hold()
    operator.spin_until(lambda: operator.states[-1].stance and abs(operator.speed()) < 0.05)

    operator.order(OperatorCommand.STOP, lambda: operator.mode == "passive")
    operator.press(OperatorCommand.STAND_UP)
    operator.spin(1.0)
    assert operator.mode == "passive"
    operator.order(OperatorCommand.RELEASE, lambda: "remote: release the stop" in up.read_text())
    operator.order(OperatorCommand.STAND_UP, lambda: operator.mode == "stance")
    operator.order(OperatorCommand.LIE_DOWN, lambda: operator.mode == "passive")
    assert "remote: stand up" in up.read_text()

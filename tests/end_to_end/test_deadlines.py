"""Ten minutes of walking at 200 Hz next to a loop that only sleeps: who misses more deadlines?

`quadvel up` simulates in real time, with the priority that the nodes of a robot have; the plain loop has the same one, and runs
next to it. Starting is left out: what counts begins when the robot walks. Wants a machine with nothing else to do:
pytest -m realtime tests/end_to_end/test_deadlines.py -s
"""

from __future__ import annotations

import os
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
from geometry_msgs.msg import Twist  # noqa: E402
from rclpy.node import Node  # noqa: E402

from quadvel_bringup.stack import URGENT  # noqa: E402
from quadvel_msgs.msg import ControllerState  # noqa: E402

pytestmark = pytest.mark.realtime

QUADVEL = (sys.executable, "-m", "quadvel_bringup")
SECONDS = 600
PLAIN_LOOP = f"""
import os, time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({URGENT["realtime_priority"]}))
missed, due = 0, time.monotonic()
for _ in range({200 * SECONDS}):
    due += 0.005
    time.sleep(max(due - time.monotonic(), 0.0))
    if (late := time.monotonic() - due) > 0.005:
        missed += int(late / 0.005)
        due += 0.005 * int(late / 0.005)
print(missed)
"""


class Operator:
    """Commands a velocity, and hears what the controller says of itself."""

    def __init__(self) -> None:
        self.node = Node("operator")
        self.state: Any = None
        self.speed = 0.0
        self._velocity = self.node.create_publisher(Twist, "cmd_vel_teleop", 1)
        self.node.create_subscription(ControllerState, "controller/state", self._on_state, 1)
        self.node.create_timer(0.05, self._command)

    def _on_state(self, message: Any) -> None:
        self.state = message

    def _command(self) -> None:
        twist = Twist()
        twist.linear.x = self.speed
        self._velocity.publish(twist)

    def spin_until(self, condition: Callable[[], object], seconds: float) -> None:
        until = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < until, f"time is up; {self.state}"
            rclpy.spin_once(self.node, timeout_sec=0.05)


@pytest.fixture
def up(tmp_path: Path) -> Iterator[None]:
    urgent = {node: {"ros__parameters": dict(URGENT)} for node in ("sim_node", "estimator", "controller")}
    file, log = tmp_path / "params.yaml", tmp_path / "log"
    file.write_text(yaml.safe_dump(urgent))
    with log.open("w") as output:
        process = subprocess.Popen(
            [*QUADVEL, "up", "--params", str(file)], stdout=output, stderr=subprocess.STDOUT
        )
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 0, log.read_text()


@pytest.fixture
def operator() -> Iterator[Operator]:
    rclpy.init(args=["test"])
    operator = Operator()
    yield operator
    operator.node.destroy_node()
    rclpy.try_shutdown()


def test_it_misses_no_more_deadlines_than_a_loop_that_sleeps(up: None, operator: Operator) -> None:
    if os.geteuid():
        pytest.skip("needs the right to real-time priority")
    operator.spin_until(lambda: operator.state and operator.state.walk_allowed, 60.0)
    operator.speed = 0.5
    operator.spin_until(lambda: operator.state.mode_name == "walk", 10.0)
    plain = subprocess.Popen([sys.executable, "-c", PLAIN_LOOP], stdout=subprocess.PIPE, text=True)
    before = operator.state.overruns
    operator.spin_until(lambda: plain.poll() is not None, SECONDS + 60.0)
    missed = operator.state.overruns - before
    assert plain.stdout
    of_plain_loop = int(plain.stdout.read())
    print(f"deadlines missed in {SECONDS} s at 200 Hz: {missed}, by a plain loop {of_plain_loop}")
    assert operator.state.mode_name == "walk"
    assert missed <= of_plain_loop

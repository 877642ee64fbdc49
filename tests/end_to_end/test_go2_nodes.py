"""The nodes `board` and `driver` with a Go2's interface between them, in the DDS domain of the ROS nodes themselves.

A board does not wait, so this needs a machine with time to spare: pytest -m realtime.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.node import Node  # noqa: E402

from quadvel_bringup.nodes import process_command  # noqa: E402
from quadvel_msgs.msg import LowState  # noqa: E402

pytestmark = pytest.mark.realtime

GO2 = (
    "--ros-args",
    "-p",
    "robot:=go2",
    "-p",
    "interface:=lo",
    "-p",
    f"dds_domain:={os.environ['ROS_DOMAIN_ID']}",
)
NODES = {"board": ("-p", "state_rate:=500", "-p", "hung:=true"), "driver": ()}


@pytest.fixture
def operator() -> Iterator[Node]:
    rclpy.init(args=["test"])
    processes = [subprocess.Popen(process_command(name, [*GO2, *more])) for name, more in NODES.items()]
    node = Node("operator")
    yield node
    for process in processes:
        process.send_signal(signal.SIGINT)
    codes = [process.wait(timeout=40.0) for process in processes]
    node.destroy_node()
    rclpy.try_shutdown()
    assert codes == [0, 0]


def test_the_driver_takes_the_joints_and_reports_states_and_battery(operator: Node) -> None:
    states: list[Any] = []
    said: dict[str, tuple[str, dict[str, str]]] = {}

    def on_diagnostics(message: Any) -> None:
        for status in message.status:
            said[status.name] = status.message, {pair.key: pair.value for pair in status.values}

    operator.create_subscription(LowState, "low_state", states.append, 10)
    operator.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
    until = time.monotonic() + 60.0
    while said.get("driver", ("",))[0] != "no low_cmd: the joints are damped":
        assert time.monotonic() < until, f"time is up; {len(states)} states, {said}"
        rclpy.spin_once(operator, timeout_sec=0.1)
    assert len(states) > 100
    assert said["driver"][1]["battery"].startswith("90 %, 29.0 V")
    assert said["driver"][1]["tick_unit"] == "ms"

"""The page on the robot that runs."""

from __future__ import annotations

import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from typing import Any

import pytest
from rich.console import Console

import quadvel_dds

quadvel_dds.install()

from geometry_msgs.msg import TwistWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402

from quadvel_bringup.status import STATUS_TOPICS, NodeReport, _equipment, _lines, running_nodes, status  # noqa: E402
from quadvel_lab.demo import _report  # noqa: E402
from quadvel_msgs.msg import ControllerState  # noqa: E402

NAN = float("nan")

ROBOT = """
import sys, threading, time
import quadvel_dds
quadvel_dds.install()
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
rclpy.init(args=[])
node = rclpy.create_node("robot")
threading.Thread(target=lambda: (sys.stdin.read(), rclpy.shutdown()), daemon=True).start()

def report(name):
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    array = DiagnosticArray(status=[DiagnosticStatus(name=name)])
    node.create_timer(0.2, lambda: publisher.publish(array))

report("sim_node")
late = node.create_timer(3.5, lambda: (late.cancel(), *map(report, ("controller", "estimator", "command_mux"))))
print("ready", flush=True)
try:
    rclpy.spin(node)
except rclpy.executors.ExternalShutdownException:
    pass
"""


@contextmanager
def running(program: str) -> Iterator[None]:
    """The program from its line "ready" on, until its input closes."""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as robot:
        assert robot.stdin is not None
        assert robot.stdout is not None
        robot.stdout.readline()
        yield
        robot.stdin.close()


def test_nodes_of_the_control_loop_that_are_found_seconds_after_the_first_are_waited_for() -> None:
    with running(ROBOT):
        nodes = running_nodes()
    assert list(nodes) == ["command_mux", "controller", "estimator", "sim_node"]


def test_a_second_robot_on_the_domain_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    two = """
from quadvel_msgs.msg import LowState
states = [node.create_publisher(LowState, "low_state", 10) for _ in range(2)]
print("ready", flush=True)
"""
    program = ROBOT.replace('print("ready", flush=True)\n', two).replace("3.5", "0.2")
    with running(program):
        assert status() == 1
    assert "low_state has 2 publishers, expected 1" in capsys.readouterr().out


def test_status_of_a_robot_that_has_not_ticked_yet_shows_dashes() -> None:
    state = ControllerState(mode_name="passive", period_p99_ms=NAN, compute_p50_us=NAN)
    odom, estimate = Odometry(), TwistWithCovarianceStamped()
    odom.pose.pose.position.z = estimate.twist.twist.linear.x = NAN
    heard: dict[str, deque[Any]] = {topic: deque() for topic in STATUS_TOPICS}
    heard["controller/state"].append(state)
    heard["odom"].append(odom)
    heard["velocity_estimate"].append(estimate)
    text = "\n".join(f"{name} {line}" for name, line in _lines(heard))
    assert "nan" not in text
    assert "period – ms, – us" in text
    assert "estimate vx – m/s" in text
    assert "x 0.00, y 0.00 m since" in text


def test_the_summary_of_a_demo_shows_dashes() -> None:
    loop = dict.fromkeys(("period_p99_ms", "compute_p50_us", "compute_p99_us", "inference_p50_us", "rate_hz"))
    errors = dict.fromkeys(("mean_error_xy", "max_error_xy", "mean_error_wz", "max_error_wz"), 0.1)
    shown = StringIO()
    _report(
        {"segments": [], "falls": 0, "loop": {**loop, "overruns": 0}, "realtime_factor": None, **errors}
        | {"estimator": {"rmse": [None, None, None]}},
        Console(file=shown, width=200),
    )
    assert "RMSE –, –, – m/s" in shown.getvalue()
    assert "loop – Hz, period p99 – ms" in shown.getvalue()


def test_the_hottest_temperatures_are_shown() -> None:
    values = {f"joint {k} temperature": str(20 + k) for k in range(9)} | {"fan temperature": "unknown"}
    shown = dict(_equipment({"driver": NodeReport(b"\0", "ok", values)}))["temperatures"]
    assert shown == "joint 8 28, joint 7 27, joint 6 26 degrees C, the hottest of 9 sensors"

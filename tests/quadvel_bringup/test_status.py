"""The page on the robot that runs."""

from __future__ import annotations

import subprocess
import sys

import quadvel_dds

quadvel_dds.install()

from quadvel_bringup.status import look  # noqa: E402

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


def test_nodes_of_the_control_loop_that_are_found_seconds_after_the_first_are_waited_for() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", ROBOT], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as robot:
        assert robot.stdin is not None
        assert robot.stdout is not None
        robot.stdout.readline()
        nodes = look()
        robot.stdin.close()
    assert list(nodes) == ["command_mux", "controller", "estimator", "sim_node"]

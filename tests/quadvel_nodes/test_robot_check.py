"""A node of another robot than the one on the topics ends with a sentence."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
import quadvel_dds
quadvel_dds.install()
from rclpy.node import Node
from std_msgs.msg import String
from quadvel_description.robot import load_robot
from quadvel_nodes.node import request_exit, run
from quadvel_nodes.robot_check import RobotCheck
from quadvel_nodes.robot_view import LATCHED

class Checking(Node):
    def __init__(self):
        super().__init__("controller")
        self.served = self.create_publisher(String, "robot_description", LATCHED)
        self.served.publish(String(data=load_robot(sys.argv[1]).urdf_file.read_text()))
        self.check = RobotCheck(self, load_robot("aliengo"))
        self.create_timer(float(sys.argv[2]), lambda: request_exit(self))

run(Checking, [])
"""


def run(described: str, seconds: str) -> tuple[int, str]:
    """Exit code and error of a node for the AlienGo that runs for a time at most."""
    command = [sys.executable, "-c", PROGRAM, described, seconds]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    return ended.returncode, ended.stderr


def test_a_node_of_another_robot_ends_and_says_why() -> None:
    code, error = run("go2", "30")
    assert code == 1
    assert "controller: robot_description is that of 'go2', expected 'aliengo'" in error


def test_a_node_of_the_same_robot_goes_on() -> None:
    assert run("aliengo", "0.5") == (0, "")

"""The program docs/examples/remote.py holds buttons of the simulated board's remote."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import Joy  # noqa: E402

PROGRAM = Path(__file__).parents[2] / "docs" / "examples" / "remote.py"
BUTTONS = (
    "R1",
    "L1",
    "start",
    "select",
    "R2",
    "L2",
    "F1",
    "F2",
    "A",
    "B",
    "X",
    "Y",
    "up",
    "right",
    "down",
    "left",
)


def test_the_remote_of_the_page_holds_its_buttons_and_lets_them_go() -> None:
    rclpy.init(args=["test"])
    node, seen = Node("board_stand_in"), []
    node.create_subscription(Joy, "board/remote", seen.append, 10)
    remote = subprocess.Popen([sys.executable, str(PROGRAM), "L1", "up"])
    try:
        end = time.monotonic() + 60.0
        while remote.poll() is None and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        remote.kill()
        node.destroy_node()
        rclpy.shutdown()
    assert remote.wait() == 0
    held = [{name for name, down in zip(BUTTONS, joy.buttons, strict=True) if down} for joy in seen]
    assert held[0] == {"L1", "up"}
    assert held[-1] == set(), "the buttons are let go at the end"

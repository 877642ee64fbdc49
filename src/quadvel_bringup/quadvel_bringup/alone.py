"""Whether another robot or simulator is there already: two on one domain would wreck each other."""

from __future__ import annotations

import os
import time
from typing import Any

import quadvel_dds

TOPIC = "low_state"
LOOK = 0.5  # s; who is there answers a newcomer at once


class NotAlone(ConnectionError):
    """Somebody else serves the robot's topics."""


def ensure_alone(node: Any) -> None:
    """Raises NotAlone where somebody publishes low_state beside what this command is about to start."""
    until = time.monotonic() + LOOK
    while time.monotonic() < until:
        if node.count_publishers(TOPIC):
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            raise NotAlone(
                f"{TOPIC}: somebody publishes it already on ROS domain {domain}: another simulator or a robot. Stop it (one "
                "that was killed is forgotten after some 10 s), or set ROS_DOMAIN_ID to another number"
            )
        time.sleep(0.02)


def look_for_others() -> None:
    """The same for a command that has no node of its own."""
    quadvel_dds.install()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("look_for_others")
    try:
        ensure_alone(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()

"""Search for other publishers of a topic that must have one only. Needs no rclpy of its own."""

from __future__ import annotations

import time
from typing import Any

DISCOVERY_TIME_S = 0.5
"""Time to discover other publishers."""


def has_publisher(node: Any, topic: str, seconds: float | None = None) -> bool:
    """Wait for a publisher of a topic to be discovered.

    Args:
        node: A node that does not publish the topic itself.
        topic: Name of the topic. rclpy does not remap it: pass `resolve_topic_name(topic)`.
        seconds: Longest time to wait, s; None: `DISCOVERY_TIME_S`.

    Returns:
        Whether there is one.
    """
    deadline = time.monotonic() + (DISCOVERY_TIME_S if seconds is None else seconds)
    while time.monotonic() < deadline:
        if node.count_publishers(topic):
            return True
        time.sleep(0.02)
    return False

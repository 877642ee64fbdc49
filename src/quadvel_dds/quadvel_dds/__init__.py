"""Embedded middleware: the part of rclpy that quadvel's nodes use, over Eclipse Cyclone DDS.

`install()` makes `import rclpy` and the message packages resolve to it if ROS 2 is not available.
So the same node files run with and without ROS 2. Not supported: lifecycle nodes, actions,
security, content filters, coroutines, types that `rosbags` does not know. They raise
`UnsupportedError`.
"""

from quadvel_dds.errors import UnsupportedError
from quadvel_dds.finder import install, is_installed, ros2_fault

__all__ = ["UnsupportedError", "install", "is_installed", "ros2_fault"]

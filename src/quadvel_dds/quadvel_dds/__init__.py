"""The embedded default middleware: the part of rclpy that quadvel's nodes use, over Eclipse Cyclone DDS.

`install()` makes `import rclpy` and the message packages resolve to it where ROS 2 is not there, so that the
same node files run with and without ROS 2. Not for: lifecycle nodes, actions, security, content filters,
coroutines, types that `rosbags` does not know; what is not offered raises `UnsupportedError`.
"""

from quadvel_dds.errors import UnsupportedError
from quadvel_dds.finder import install, is_installed, ros2_fault

__all__ = ["UnsupportedError", "install", "is_installed", "ros2_fault"]

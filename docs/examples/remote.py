"""Holds buttons of the simulated board's remote for a second: python remote.py L1 up."""

import sys
import time

import quadvel_dds

quadvel_dds.install()  # without ROS 2: the embedded middleware

import rclpy  # noqa: E402
from sensor_msgs.msg import Joy  # noqa: E402

BUTTONS = [
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
]

rclpy.init()
node = rclpy.create_node("remote")
remote = node.create_publisher(Joy, "board/remote", 10)
held = Joy(axes=[0.0] * 4, buttons=[int(name in sys.argv[1:]) for name in BUTTONS])
end = time.monotonic() + 1.0
while time.monotonic() < end or not remote.get_subscription_count():
    remote.publish(held)
    rclpy.spin_once(node, timeout_sec=0.02)
remote.publish(Joy(axes=[0.0] * 4, buttons=[0] * 16))
rclpy.spin_once(node, timeout_sec=0.1)
node.destroy_node()
rclpy.shutdown()

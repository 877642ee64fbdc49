"""Holds buttons of the simulated board's remote for a second: python remote.py L1 up."""

import sys
import time

import quadvel_dds

quadvel_dds.install()  # without ROS 2: the embedded middleware

import rclpy  # noqa: E402
from sensor_msgs.msg import Joy  # noqa: E402

from quadvel_driver.board_state import Button  # noqa: E402

rclpy.init()
node = rclpy.create_node("remote")
remote = node.create_publisher(Joy, "board/remote", 10)
names = [name.upper() for name in sys.argv[1:]]
held = Joy(axes=[0.0] * 4, buttons=[int(button.name in names) for button in Button])
end = time.monotonic() + 1.0
while time.monotonic() < end or not remote.get_subscription_count():
    remote.publish(held)
    rclpy.spin_once(node, timeout_sec=0.02)
remote.publish(Joy(axes=[0.0] * 4, buttons=[0] * 16))
rclpy.spin_once(node, timeout_sec=0.1)
node.destroy_node()
rclpy.shutdown()

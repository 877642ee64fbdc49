"""`quadvel drive`: one velocity on a topic, again and again, then zero."""

from __future__ import annotations

import time

from .processes import StopSignals

PERIOD = 0.05  # s, between two messages; the command mux forgets a source after 0.5 s


def drive(vx: float, vy: float, wz: float, seconds: float, topic: str) -> None:
    """Publish a Twist (m/s, m/s, rad/s, body frame) for some seconds or until Ctrl-C, then one of zeros."""
    import quadvel_dds

    quadvel_dds.install()
    import rclpy
    from geometry_msgs.msg import Twist
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("drive")
    publisher = node.create_publisher(Twist, topic, 10)
    twist = Twist()
    twist.linear.x, twist.linear.y, twist.angular.z = vx, vy, wz
    with StopSignals() as signals:
        until = time.monotonic() + seconds
        while time.monotonic() < until and not signals.wait(PERIOD):
            publisher.publish(twist)
    publisher.publish(Twist())
    node.destroy_node()
    rclpy.try_shutdown()

"""ROS topics of a world: laser scans, mounting of the laser, true positions of people.

`surroundings` computes what is published here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseArray
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from quadvel_description.frames import BASE, LASER, ODOM, FramePose
from quadvel_nodes.robot_view import LATCHED, transform_messages
from quadvel_sim.simulator import Simulator
from quadvel_sim.world import World


class WorldView:
    """Publishes scan, ground_truth/persons and the static transform of the laser for a node."""

    def __init__(self, node: Node, world: World) -> None:
        """Create the publishers and publish the laser's mounting.

        Args:
            node: Node that publishes.
            world: World with the laser.
        """
        laser, scanner = world.laser, world.laser.scanner
        self._scan = node.create_publisher(LaserScan, "scan", 10)
        self._persons = node.create_publisher(PoseArray, "ground_truth/persons", 10)
        self._static = node.create_publisher(TFMessage, "/tf_static", LATCHED)
        mounted = FramePose(BASE, LASER, laser.position, laser.quaternion)
        self._static.publish(
            TFMessage(transforms=transform_messages(node.get_clock().now().to_msg(), [mounted]))
        )
        self._message = LaserScan(
            angle_min=scanner.angle_min,
            angle_max=float(scanner.angles[-1]),
            angle_increment=scanner.angle_increment,
            scan_time=1.0 / laser.rate,
            range_min=0.0,
            range_max=scanner.range_max,
        )
        self._message.header.frame_id = LASER

    def publish(self, stamp: Any, simulator: Simulator, view: bool) -> None:
        """Publish the scan if one is due, and the people if display topics are due.

        Args:
            stamp: Time of the sample, builtin_interfaces/Time.
            simulator: Simulation of the world.
            view: Whether topics for display are due.
        """
        scan = simulator.scan()
        if scan is not None:
            self._message.header.stamp = stamp
            self._message.ranges = scan.ranges.astype(np.float32)
            self._scan.publish(self._message)
        if view:
            message = PoseArray(poses=[_pose(*person) for person in simulator.persons()])
            message.header.stamp = stamp
            message.header.frame_id = ODOM
            self._persons.publish(message)


def _pose(x: float, y: float, yaw: float) -> Any:
    """Return a geometry_msgs/Pose at x, y (m) with a heading (rad)."""
    pose = Pose()
    pose.position.x, pose.position.y = float(x), float(y)
    pose.orientation.w, pose.orientation.z = float(np.cos(0.5 * yaw)), float(np.sin(0.5 * yaw))
    return pose

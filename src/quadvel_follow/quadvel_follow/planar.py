"""Planar poses, velocities and ranges from ROS messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import yaw


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """Extract the planar pose.

    Args:
        pose: A geometry_msgs/Pose.

    Returns:
        x, y in m, yaw in rad.
    """
    turn = pose.orientation
    return pose.position.x, pose.position.y, float(yaw(np.array([turn.w, turn.x, turn.y, turn.z])))


def planar_twist(twist: Any) -> tuple[float, float, float]:
    """Extract the planar velocity.

    Args:
        twist: A geometry_msgs/Twist.

    Returns:
        vx, vy in m/s, wz in rad/s.
    """
    return twist.linear.x, twist.linear.y, twist.angular.z


def scan_ranges(message: Any) -> Array:
    """Extract the ranges.

    Args:
        message: A sensor_msgs/LaserScan.

    Returns:
        Ranges, (rays,), m; inf outside the limits of the scanner.
    """
    ranges = np.array(message.ranges, float)
    ranges[~((ranges >= message.range_min) & (ranges < message.range_max))] = np.inf
    return ranges

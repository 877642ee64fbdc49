"""What messages say of poses, velocities and scans in the plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_description.kinematics import yaw

Array = NDArray[np.float64]


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """x, y (m) and yaw (rad) of a geometry_msgs/Pose."""
    turn = pose.orientation
    return pose.position.x, pose.position.y, float(yaw(np.array([turn.w, turn.x, turn.y, turn.z])))


def planar_twist(twist: Any) -> tuple[float, float, float]:
    """vx, vy (m/s) and wz (rad/s) of a geometry_msgs/Twist."""
    return twist.linear.x, twist.linear.y, twist.angular.z


def scan_ranges(message: Any) -> Array:
    """Of a sensor_msgs/LaserScan, (rays,) m; inf where a range is none within the scanner's limits."""
    ranges = np.array(message.ranges, float)
    ranges[~((ranges >= message.range_min) & (ranges < message.range_max))] = np.inf
    return ranges

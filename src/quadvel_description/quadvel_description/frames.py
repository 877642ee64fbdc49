"""Coordinate frames of the robot, named as in REP 105, and their poses in their parents.

    odom -> base_link -> base_footprint            floor below the robot, level, with its heading
                      -> trunk -> imu_link, links of the legs
                      -> laser                     if there is one; its publisher knows the pose

`base_link` and `trunk` coincide. The trunk carries the mass, and KDL requires a root link of the
URDF without inertia.

This module only computes poses, from the links of the robot's URDF (`robot.Robot.links`). The
estimator publishes `base_link` and `base_footprint`, and `quadvel_nodes.robot_view` the other
links.
"""

from __future__ import annotations

import attrs
import numpy as np

from .arrays import Array
from .kinematics import foot_positions, rotate, rotate_inverse, yaw
from .robot import Robot
from .urdf import ROOT

ODOM = "odom"
BASE = ROOT
FOOTPRINT = "base_footprint"
IMU = "imu_link"
LASER = "laser"

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}


@attrs.frozen
class FramePose:
    """Pose of a frame in its parent frame.

    Attributes:
        parent: Name of the parent frame.
        child: Name of the frame.
        position: Origin of the child in the parent, (3,), m.
        quaternion: Orientation, child to parent, (4,), (w, x, y, z).
    """

    parent: str
    child: str
    position: Array
    quaternion: Array


def fixed_links(robot: Robot) -> list[FramePose]:
    """Return the poses of the links that never move in their parents.

    Args:
        robot: The robot.

    Returns:
        Poses, the trunk in `base_link` first.
    """
    links = [link for link in robot.links if not link.axis]
    return [FramePose(link.parent or BASE, link.name, np.array(link.origin), _IDENTITY) for link in links]


def moving_links(robot: Robot, q: Array) -> list[FramePose]:
    """Compute the poses of hips, thighs and calves in their parent links.

    Args:
        robot: The robot.
        q: Joint positions, (12,), rad.

    Returns:
        A pose per joint.
    """
    moving = robot.joint_links
    axes = np.array([_AXES[str(link.axis)] for link in moving])
    quaternions = np.column_stack([np.cos(0.5 * q), np.sin(0.5 * q)[:, None] * axes])
    return [
        FramePose(str(link.parent), link.name, np.array(link.origin), quaternion)
        for link, quaternion in zip(moving, quaternions, strict=True)
    ]


def footprint(robot: Robot, q: Array, quaternion: Array) -> FramePose:
    """Compute the pose of `base_footprint` in `base_link`.

    It lies below the robot on a level floor that the lowest foot touches, and has the robot's
    heading.

    Args:
        robot: The robot.
        q: Joint positions, (12,), rad.
        quaternion: Orientation of the trunk, body to world, (4,), (w, x, y, z).

    Returns:
        The pose.
    """
    # Tilt of the trunk without its heading: q_tilt = q_yaw^-1 q. The footprint has its inverse.
    half = 0.5 * float(yaw(quaternion))
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = quaternion
    tilt = np.array([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w])
    floor = rotate(tilt, foot_positions(robot, q))[..., 2].min() - robot.foot_radius
    below = rotate_inverse(tilt, np.array([0.0, 0.0, floor]))
    return FramePose(BASE, FOOTPRINT, below, tilt * [1.0, -1.0, -1.0, -1.0])

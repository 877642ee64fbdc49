"""The robot's coordinate frames, named as REP 105 and Nav2 expect them, and where each lies in its parent.

    odom -> base_link -> base_footprint                 the floor below the robot, level, with its heading
                      -> trunk -> imu_link, the links of the legs
                      -> laser                         where there is one; who serves it says where

`base_link` and `trunk` are the same place: the trunk carries the mass, and KDL wants a root of the URDF without any.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from . import robot
from .kinematics import foot_positions, rotate, rotate_inverse, yaw

Array = NDArray[np.float64]

ODOM = "odom"
BASE = "base_link"
FOOTPRINT = "base_footprint"
IMU = "imu_link"
LASER = "laser"

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_MOVING = tuple(link for link in robot.LINKS if link.axis)
_AXES = np.array([{"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}[link.axis] for link in _MOVING if link.axis])


@attrs.frozen
class Placed:
    """Where the frame `child` lies in the frame `parent`: its origin (3,) m and its orientation (4,), wxyz."""

    parent: str
    child: str
    position: Array
    quaternion: Array


def fixed_links() -> list[Placed]:
    """The links that never move in their parents, the trunk in `base_link` first."""
    links = [link for link in robot.LINKS if not link.axis]
    return [Placed(link.parent or BASE, link.name, np.array(link.origin), _IDENTITY) for link in links]


def moving_links(q: Array) -> list[Placed]:
    """Hips, thighs and calves at the joint angles q, (12,) rad."""
    quaternions = np.column_stack([np.cos(0.5 * q), np.sin(0.5 * q)[:, None] * _AXES])
    return [
        Placed(str(link.parent), link.name, np.array(link.origin), quaternion)
        for link, quaternion in zip(_MOVING, quaternions, strict=True)
    ]


def footprint(q: Array, quaternion: Array) -> Placed:
    """`base_footprint` in `base_link`: below it on the floor that the lowest foot touches, level, with its heading.

    q: (12,) rad. quaternion: the trunk's orientation (4,), wxyz.
    """
    half = 0.5 * float(yaw(quaternion))
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = quaternion
    tilt = np.array([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w])  # less the heading
    floor = rotate(tilt, foot_positions(q))[..., 2].min() - robot.FOOT_RADIUS
    below = rotate_inverse(tilt, np.array([0.0, 0.0, floor]))
    return Placed(BASE, FOOTPRINT, below, tilt * [1.0, -1.0, -1.0, -1.0])

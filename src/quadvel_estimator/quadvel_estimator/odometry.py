"""Leg odometry: the trunk's velocity from a planted foot that rolls on level ground.

Both estimators use it and decide themselves which foot is planted. Arrays may have leading axes
(...); legs are FR, FL, RR, RL.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import foot_kinematics
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState

# (a @ CROSS).reshape(3, 3) is the matrix by which a row vector b becomes a x b.
CROSS_PRODUCT_TENSOR = np.cross(np.eye(3)[:, None], np.eye(3)).reshape(3, 9)


def leg_velocity(robot: Robot, state: RobotState, rotation: Array) -> Array:
    """Compute the velocity of the trunk's origin from each leg, as if its foot were planted.

        v = v_roll - (w x s + J dq)

    Args:
        robot: The robot.
        state: The measured state, arrays (..., 12), (..., 4), (..., 3).
        rotation: Rotation matrix from body to world, (..., 3, 3).

    Returns:
        Velocity in the body frame, (..., 4, 3), m/s.
    """
    return rolling_velocity(robot, state, rotation) - foot_velocity_in_trunk(
        state, *foot_kinematics(robot, state.q)
    )


def rolling_velocity(robot: Robot, state: RobotState, rotation: Array) -> Array:
    """Compute the velocity of the centre of each foot that rolls on level ground without slip.

        v_roll = w_calf x (r e_up)

    In a brisk walk, this is about 6 % of the trunk's velocity.

    Args:
        robot: The robot.
        state: The measured state.
        rotation: Rotation matrix from body to world, (..., 3, 3).

    Returns:
        Velocity in the body frame, (..., 4, 3), m/s.
    """
    # Angular velocity of the calf: the hip joint turns about x, thigh and calf about the tilted y axis:
    # w_calf = w + (dq_hip, (dq_thigh + dq_calf) cos q_hip, (dq_thigh + dq_calf) sin q_hip).
    dq = np.reshape(state.dq, (*np.shape(state.dq)[:-1], 4, 3))
    hip = np.asarray(state.q)[..., ::3]
    knee = dq[..., 1] + dq[..., 2]
    calf = np.empty(dq.shape)
    calf[..., 0], calf[..., 1], calf[..., 2] = dq[..., 0], knee * np.cos(hip), knee * np.sin(hip)
    calf += np.asarray(state.angular_velocity)[..., None, :]
    velocity: Array = -calf @ _cross_matrix(robot.foot_radius * rotation[..., 2, :])
    return velocity


def foot_velocity_in_trunk(state: RobotState, feet: Array, jacobians: Array) -> Array:
    """Compute the velocity of the centre of each foot relative to the trunk's origin: w x s + J dq.

    Args:
        state: The measured state.
        feet: Foot centres s in the trunk frame, (..., 4, 3), m.
        jacobians: Foot Jacobians J, (..., 4, 3, 3), m/rad.

    Returns:
        Velocity in the body frame, (..., 4, 3), m/s.
    """
    dq = np.reshape(state.dq, (*feet.shape, 1))
    return feet @ _cross_matrix(np.asarray(state.angular_velocity)) + (jacobians @ dq)[..., 0]


def _cross_matrix(a: Array) -> Array:
    """Return the matrix (..., 3, 3) that maps a row vector b to a x b."""
    return (a @ CROSS_PRODUCT_TENSOR).reshape(*a.shape[:-1], 3, 3)

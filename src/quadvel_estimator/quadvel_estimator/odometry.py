"""What the legs say of the trunk's velocity: a foot that is planted and rolls on level ground gives it away.

For both estimators; which foot is planted is their matter. Arrays carry leading axes (...), legs FR, FL, RR, RL.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadvel_description.kinematics import foot_kinematics, rotation_matrix
from quadvel_description.robot import FOOT_RADIUS
from quadvel_description.state import RobotState

Array = NDArray[np.float64]

# (a @ CROSS).reshape(3, 3) is the matrix by which a row vector b becomes a x b.
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).reshape(3, 9)


def leg_velocity(state: RobotState) -> Array:
    """Velocity (..., 4, 3) of the trunk's origin, m/s, body frame, if the foot of that leg is planted."""
    return rolling(state, rotation_matrix(state.quaternion)) - against_trunk(state, *foot_kinematics(state.q))


def rolling(state: RobotState, rotation: Array) -> Array:
    """Velocity (..., 4, 3), body frame, of each foot's centre that rolls on level ground: w_calf x (r up).

    At a brisk walk this makes some six per cent of the trunk's velocity.
    """
    dq = np.reshape(state.dq, (*np.shape(state.dq)[:-1], 4, 3))
    hip = np.asarray(state.q)[..., ::3]
    knee = dq[..., 1] + dq[..., 2]
    calf = np.empty(dq.shape)
    calf[..., 0], calf[..., 1], calf[..., 2] = dq[..., 0], knee * np.cos(hip), knee * np.sin(hip)
    calf += np.asarray(state.angular_velocity)[..., None, :]
    velocity: Array = -calf @ _cross(FOOT_RADIUS * rotation[..., 2, :])
    return velocity


def against_trunk(state: RobotState, feet: Array, jacobians: Array) -> Array:
    """Velocity (..., 4, 3), body frame, of each foot's centre against the trunk's origin: w x s + J dq."""
    dq = np.reshape(state.dq, (*feet.shape, 1))
    return feet @ _cross(np.asarray(state.angular_velocity)) + (jacobians @ dq)[..., 0]


def _cross(a: Array) -> Array:
    """The matrix (..., 3, 3) by which a row vector b becomes a x b."""
    return (a @ CROSS).reshape(*a.shape[:-1], 3, 3)

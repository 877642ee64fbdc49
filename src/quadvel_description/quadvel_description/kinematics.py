"""Leg kinematics and rotations in closed form, over any leading axes. Frames: facts in `robot`; no dynamics here."""

from __future__ import annotations

import numpy as np

from .robot import CALF_LENGTH, FRONT, HIP_OFFSET, LEFT, LEGS, THIGH_LENGTH, THIGH_OFFSET

_SIDE = np.array([LEFT[leg] for leg in LEGS], float)
HIPS = np.array([[HIP_OFFSET[0] * FRONT[leg], HIP_OFFSET[1] * LEFT[leg], 0.0] for leg in LEGS])
"""Hip joints in the trunk frame, (4, 3), m."""


def _leg_plane(q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Foot in the frame of each leg's own plane: x, depth z (negative), their derivatives' parts, hip sine, cosine."""
    legs = np.asarray(q).reshape(*np.shape(q)[:-1], 4, 3)
    hip, thigh, knee = legs[..., 0], legs[..., 1], legs[..., 1] + legs[..., 2]
    thigh_x, thigh_z = -THIGH_LENGTH * np.sin(thigh), -THIGH_LENGTH * np.cos(thigh)
    calf_x, calf_z = -CALF_LENGTH * np.sin(knee), -CALF_LENGTH * np.cos(knee)
    return thigh_x + calf_x, thigh_z + calf_z, calf_x, calf_z, np.sin(hip), np.cos(hip)


def foot_positions(q: np.ndarray) -> np.ndarray:
    """Centres of the foot spheres in the trunk frame, (..., 12) rad -> (..., 4, 3) m."""
    x, z, _, _, s, c = _leg_plane(q)
    y = THIGH_OFFSET * _SIDE
    return np.stack([x, y * c - z * s, y * s + z * c], axis=-1) + HIPS


def foot_jacobians(q: np.ndarray) -> np.ndarray:
    """d foot / d (hip, thigh, calf) in the trunk frame, (..., 12) -> (..., 4, 3, 3), m/rad; columns are joints."""
    x, z, calf_x, calf_z, s, c = _leg_plane(q)
    y = THIGH_OFFSET * _SIDE
    jacobians = np.zeros((*x.shape, 3, 3))
    jacobians[..., 1, 0], jacobians[..., 2, 0] = -y * s - z * c, y * c - z * s
    for joint, forward, down in ((1, z, x), (2, calf_z, calf_x)):
        jacobians[..., 0, joint] = forward
        jacobians[..., 1, joint], jacobians[..., 2, joint] = down * s, -down * c
    return jacobians


def inverse_kinematics(feet: np.ndarray) -> np.ndarray:
    """Joint angles that put the foot centres at `feet`, trunk frame, (..., 4, 3) m -> (..., 12) rad.

    Knees bend backward (calf negative). A foot out of reach is placed at the nearest reachable distance.
    """
    p = np.asarray(feet, float) - HIPS
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    offset = THIGH_OFFSET * _SIDE
    depth = np.sqrt(
        np.maximum(y**2 + z**2 - THIGH_OFFSET**2, 1e-8)
    )  # leg plane: foot at depth below the thigh joint
    hip = np.arctan2(z, y) - np.arctan2(-depth, offset)
    hip = np.arctan2(np.sin(hip), np.cos(hip))
    reach = np.clip(np.hypot(x, depth), abs(THIGH_LENGTH - CALF_LENGTH) + 1e-6, THIGH_LENGTH + CALF_LENGTH)
    cos_knee = (reach**2 - THIGH_LENGTH**2 - CALF_LENGTH**2) / (2 * THIGH_LENGTH * CALF_LENGTH)
    calf = -np.arccos(np.clip(cos_knee, -1.0, 1.0))
    lead = np.arctan2(CALF_LENGTH * np.sin(-calf), THIGH_LENGTH + CALF_LENGTH * np.cos(calf))
    thigh = np.arctan2(-x, depth) + lead
    return np.stack([hip, thigh, calf], axis=-1).reshape(*p.shape[:-2], 12)


def _rotation_tensor() -> np.ndarray:
    """R as a quadratic form in q = (w, u), (16, 9): R_ab = (w^2 - u.u) delta_ab + 2 u_a u_b - 2 w eps_abc u_c."""
    eye = np.eye(3)
    tensor = np.zeros((4, 4, 3, 3))
    tensor[0, 0] = eye
    tensor[0, 1:] = -2.0 * np.moveaxis(np.cross(eye[:, None], eye), -1, 0)
    tensor[1:, 1:] = 2.0 * np.einsum("ia,jb->ijab", eye, eye) - np.einsum("ij,ab->ijab", eye, eye)
    return tensor.reshape(16, 9)


_ROTATION = _rotation_tensor()


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Body to world of a unit quaternion wxyz, (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quaternion)
    squares = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 16)
    return (squares @ _ROTATION).reshape(*q.shape[:-1], 3, 3)


def rotate(quaternion: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Body vector to world: R(quaternion wxyz) v, (..., 4), (..., 3) -> (..., 3)."""
    return (rotation_matrix(quaternion) @ np.asarray(v)[..., None])[..., 0]


def rotate_inverse(quaternion: np.ndarray, v: np.ndarray) -> np.ndarray:
    """World vector to body: R(quaternion wxyz)^T v."""
    return (np.asarray(v)[..., None, :] @ rotation_matrix(quaternion))[..., 0, :]


def roll_pitch(quaternion: np.ndarray) -> np.ndarray:
    """Roll and pitch (rad) of R = Rz(yaw) Ry(pitch) Rx(roll), (..., 4) -> (..., 2)."""
    q = np.asarray(quaternion)
    w, x, y, z = (q[..., i] for i in range(4))
    angles = np.empty((*q.shape[:-1], 2), np.result_type(q, np.float32))
    angles[..., 0] = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    angles[..., 1] = np.arcsin(np.minimum(np.maximum(2 * (w * y - z * x), -1.0), 1.0))
    return angles


def yaw(quaternion: np.ndarray) -> np.ndarray:
    """Yaw (rad), (..., 4) -> (...)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion), -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

"""Leg kinematics and rotations in closed form, over any leading axes. Frames: facts in `robot`; no dynamics here."""

from __future__ import annotations

import numpy as np

from .robot import CALF_LENGTH, FRONT, HIP_OFFSET, LEFT, LEGS, THIGH_LENGTH, THIGH_OFFSET

_SIDEWAYS = THIGH_OFFSET * np.array([LEFT[leg] for leg in LEGS], float)
_LINKS = -np.array([THIGH_LENGTH, CALF_LENGTH])
HIPS = np.array([[HIP_OFFSET[0] * FRONT[leg], HIP_OFFSET[1] * LEFT[leg], 0.0] for leg in LEGS])
"""Hip joints in the trunk frame, (4, 3), m."""


def _leg_planes(q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of each leg's own plane: thigh's and calf's way forward and up, (..., 4, 2) each, sine and cosine of the hip."""
    angles = np.array(q, float).reshape(*np.shape(q)[:-1], 4, 3)
    angles[..., 2] += angles[..., 1]
    sines, cosines = np.sin(angles), np.cos(angles)
    return sines[..., 1:] * _LINKS, cosines[..., 1:] * _LINKS, sines[..., 0], cosines[..., 0]


def _from_hips(forward: np.ndarray, up: np.ndarray, s: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The feet as seen from the hip joints, (..., 4, 3)."""
    feet, z = np.empty((*s.shape, 3)), up[..., 0] + up[..., 1]
    feet[..., 0] = forward[..., 0] + forward[..., 1]
    feet[..., 1], feet[..., 2] = _SIDEWAYS * c - z * s, _SIDEWAYS * s + z * c
    return feet


def foot_positions(q: np.ndarray) -> np.ndarray:
    """Centres of the foot spheres in the trunk frame, (..., 12) rad -> (..., 4, 3) m."""
    return _from_hips(*_leg_planes(q)) + HIPS


def foot_jacobians(q: np.ndarray) -> np.ndarray:
    """d foot / d (hip, thigh, calf) in the trunk frame, (..., 12) -> (..., 4, 3, 3), m/rad; columns are joints."""
    return foot_kinematics(q)[1]


def foot_kinematics(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`foot_positions` and `foot_jacobians` at once."""
    forward, up, s, c = _leg_planes(q)
    feet = _from_hips(forward, up, s, c)
    jacobians = np.zeros((*feet.shape, 3))
    jacobians[..., 1, 0], jacobians[..., 2, 0] = -feet[..., 2], feet[..., 1]
    for joint, x, z in ((1, feet[..., 0], up[..., 0] + up[..., 1]), (2, forward[..., 1], up[..., 1])):
        jacobians[..., 0, joint] = z
        jacobians[..., 1, joint], jacobians[..., 2, joint] = x * s, -x * c
    return feet + HIPS, jacobians


def inverse_kinematics(feet: np.ndarray) -> np.ndarray:
    """Joint angles that put the foot centres at `feet`, trunk frame, (..., 4, 3) m -> (..., 12) rad.

    Knees bend backward (calf negative). A foot out of reach is placed at the nearest reachable distance.
    """
    p = np.asarray(feet, float) - HIPS
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    depth = np.sqrt(
        np.maximum(y**2 + z**2 - THIGH_OFFSET**2, 1e-8)
    )  # leg plane: foot at depth below the thigh joint
    hip = np.arctan2(z, y) - np.arctan2(-depth, _SIDEWAYS)
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
    w, x, y, z = np.asarray(quaternion).T  # plain numbers for one robot, in which case these are quick
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.minimum(np.maximum(2 * (w * y - z * x), -1.0), 1.0))
    return np.array((roll, pitch)).T


def yaw(quaternion: np.ndarray) -> np.ndarray:
    """Yaw (rad), (..., 4) -> (...)."""
    w, x, y, z = np.asarray(quaternion).T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)).T

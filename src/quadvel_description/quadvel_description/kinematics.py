"""Leg kinematics and rotations in closed form, with any leading batch axes.

Feet are in the trunk frame, m, and joint angles in rad, unless stated otherwise. Quaternions are
(w, x, y, z), body to world. `frames` computes the poses of all links.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .robot import LegGeometry, Robot


def _leg_planes(legs: LegGeometry, q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the links of each leg in its own plane.

    Returns forward and up components of thigh and calf, (..., 4, 2) each, and sine and cosine of
    the hip, (..., 4) each.
    """
    angles = np.array(q, float).reshape(*np.shape(q)[:-1], 4, 3)
    angles[..., 2] += angles[..., 1]  # the calf relative to the trunk
    sines, cosines = np.sin(angles), np.cos(angles)
    links = legs.links  # along -z at zero angles
    return sines[..., 1:] * links, cosines[..., 1:] * links, sines[..., 0], cosines[..., 0]


def _feet_from_hips(
    legs: LegGeometry, forward: np.ndarray, up: np.ndarray, s: np.ndarray, c: np.ndarray
) -> np.ndarray:
    """Return the foot positions relative to the hip joints, (..., 4, 3)."""
    lateral = legs.lateral
    feet, z = np.empty((*s.shape, 3)), up[..., 0] + up[..., 1]
    feet[..., 0] = forward[..., 0] + forward[..., 1]
    feet[..., 1], feet[..., 2] = lateral * c - z * s, lateral * s + z * c
    return feet


def foot_positions(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Compute the centres of the foot spheres in the trunk frame.

    Args:
        robot: The robot.
        q: Joint positions, (..., 12), rad.

    Returns:
        Positions, (..., 4, 3), m.
    """
    legs = robot.legs
    return _feet_from_hips(legs, *_leg_planes(legs, q)) + legs.hips


def foot_jacobians(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Compute the Jacobians of the foot positions.

    Args:
        robot: The robot.
        q: Joint positions, (..., 12), rad.

    Returns:
        d foot / d (hip, thigh, calf) in the trunk frame, (..., 4, 3, 3), m/rad; columns are joints.
    """
    return foot_kinematics(robot, q)[1]


def foot_kinematics(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute foot positions and Jacobians together.

    Args:
        robot: The robot.
        q: Joint positions, (..., 12), rad.

    Returns:
        Positions, (..., 4, 3), m, and Jacobians, (..., 4, 3, 3), m/rad; columns are joints.
    """
    legs = robot.legs
    forward, up, s, c = _leg_planes(legs, q)
    feet = _feet_from_hips(legs, forward, up, s, c)
    # Hip about x: d foot / d hip = (0, -z, y). Thigh and calf turn in the leg's plane about their
    # joint: with x forward and z up of the foot relative to the joint, d foot / d angle is
    # (z, x sin(hip), -x cos(hip)).
    jacobians = np.zeros((*feet.shape, 3))
    jacobians[..., 1, 0], jacobians[..., 2, 0] = -feet[..., 2], feet[..., 1]
    for joint, x, z in ((1, feet[..., 0], up[..., 0] + up[..., 1]), (2, forward[..., 1], up[..., 1])):
        jacobians[..., 0, joint] = z
        jacobians[..., 1, joint], jacobians[..., 2, joint] = x * s, -x * c
    return feet + legs.hips, jacobians


def inverse_kinematics(robot: Robot, feet: np.ndarray) -> np.ndarray:
    """Compute the joint positions that reach given foot positions; knees bend as in the stance.

    Args:
        robot: The robot.
        feet: Foot centres in the trunk frame, (..., 4, 3), m.

    Returns:
        Joint positions, (..., 12), rad; a foot out of reach goes to the nearest reachable distance.
    """
    legs = robot.legs
    l1, l2 = legs.thigh, legs.calf
    p = np.asarray(feet, float) - legs.hips
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    # The hip turns the leg's plane until the foot lies at `depth` below the thigh joint in it:
    # depth^2 = y^2 + z^2 - offset^2. In the plane the law of cosines gives the knee:
    # cos(calf) = (reach^2 - l1^2 - l2^2) / (2 l1 l2).
    depth = np.sqrt(np.maximum(y**2 + z**2 - legs.lateral**2, 1e-8))
    hip = np.arctan2(z, y) - np.arctan2(-depth, legs.lateral)
    hip = np.arctan2(np.sin(hip), np.cos(hip))
    reach = np.clip(np.hypot(x, depth), abs(l1 - l2) + 1e-6, l1 + l2)
    cos_knee = (reach**2 - l1**2 - l2**2) / (2 * l1 * l2)
    calf = legs.knees * np.arccos(np.clip(cos_knee, -1.0, 1.0))
    lead = np.arctan2(l2 * np.sin(-calf), l1 + l2 * np.cos(calf))
    thigh = np.arctan2(-x, depth) + lead
    return np.stack([hip, thigh, calf], axis=-1).reshape(*p.shape[:-2], 12)


def _rotation_tensor() -> np.ndarray:
    """Return R as a quadratic form in q = (w, u), (16, 9).

    R_ab = (w^2 - u.u) delta_ab + 2 u_a u_b - 2 w eps_abc u_c.
    """
    eye = np.eye(3)
    tensor = np.zeros((4, 4, 3, 3))
    tensor[0, 0] = eye
    tensor[0, 1:] = -2.0 * np.moveaxis(np.cross(eye[:, None], eye), -1, 0)
    tensor[1:, 1:] = 2.0 * np.einsum("ia,jb->ijab", eye, eye) - np.einsum("ij,ab->ijab", eye, eye)
    return tensor.reshape(16, 9)


_ROTATION = _rotation_tensor()


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Compute the rotation matrix of a unit quaternion.

    Args:
        quaternion: Orientation, body to world, (..., 4), (w, x, y, z).

    Returns:
        Matrix that rotates body vectors to the world frame, (..., 3, 3).
    """
    q = np.asarray(quaternion)
    squares = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 16)
    return (squares @ _ROTATION).reshape(*q.shape[:-1], 3, 3)


def rotate(quaternion: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate body vectors to the world frame: R(q) v.

    Args:
        quaternion: Orientation, body to world, (..., 4), (w, x, y, z).
        v: Vectors in the body frame, (..., 3).

    Returns:
        Vectors in the world frame, (..., 3).
    """
    return (rotation_matrix(quaternion) @ np.asarray(v)[..., None])[..., 0]


def rotate_one(quaternion: Sequence[float], v: Sequence[float]) -> tuple[float, float, float]:
    """Rotate one body vector to the world frame; faster than `rotate`.

        v' = v + w t + u x t  with  t = 2 u x v  for a quaternion (w, u)

    Args:
        quaternion: Orientation, body to world, (w, x, y, z).
        v: Vector in the body frame.

    Returns:
        Vector in the world frame.
    """
    w, x, y, z = quaternion
    a, b, c = v
    r, s, t = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * r + y * t - z * s, b + w * s + z * r - x * t, c + w * t + x * s - y * r


def rotate_inverse(quaternion: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate world vectors to the body frame: R(q)^T v.

    Args:
        quaternion: Orientation, body to world, (..., 4), (w, x, y, z).
        v: Vectors in the world frame, (..., 3).

    Returns:
        Vectors in the body frame, (..., 3).
    """
    return (np.asarray(v)[..., None, :] @ rotation_matrix(quaternion))[..., 0, :]


def roll_pitch(quaternion: np.ndarray) -> np.ndarray:
    """Compute roll and pitch of R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        quaternion: Orientation, body to world, (..., 4), (w, x, y, z).

    Returns:
        Roll and pitch, (..., 2), rad.
    """
    w, x, y, z = np.asarray(quaternion).T  # for one robot these are scalars, which is fast
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.minimum(np.maximum(2 * (w * y - z * x), -1.0), 1.0))
    return np.array((roll, pitch)).T


def yaw(quaternion: np.ndarray) -> np.ndarray:
    """Compute the yaw angle of R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        quaternion: Orientation, body to world, (..., 4), (w, x, y, z).

    Returns:
        Yaw, (...), rad.
    """
    w, x, y, z = np.asarray(quaternion).T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)).T

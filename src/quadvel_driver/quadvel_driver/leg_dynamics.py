"""Torques that a suspended robot's joints need: against gravity, and for the legs' inertia.

The trunk is at rest. All vectors are in the trunk frame.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.quadruped import GRAVITY, KINDS, LEGS
from quadvel_description.robot import Robot


def leg_torque(robot: Robot, leg: int, q: Array, dq: Array, ddq: Array, down: Array) -> Array:
    """Compute the joint torques that move one leg in the air (Newton and Euler).

        tau_j = a_j . sum over bodies b beyond j of [(c_b - p_j) x f_b + n_b] + armature_j ddq_j
        f_b = m_b (acceleration of c_b - g e_down),   n_b = I_b alpha_b + omega_b x I_b omega_b

    with joint axis a_j, joint position p_j, and centre of mass c_b.

    Args:
        robot: The robot.
        leg: Index of the leg.
        q: Joint angles, (n, 3), rad.
        dq: Joint speeds, (n, 3), rad/s.
        ddq: Joint accelerations, (n, 3), rad/s^2.
        down: Direction of gravity in the trunk frame, unit vectors, (n, 3).

    Returns:
        Torques, (n, 3), N m, without friction.
    """
    bodies = _moved_bodies(robot, leg, q, dq, ddq, down)
    torque = robot.armature[3 * leg : 3 * leg + 3] * ddq
    for joint, carrier in enumerate(bodies):
        for body in bodies[joint:]:
            moment = np.cross(body.centre - carrier.joint, body.force) + body.moment
            torque[:, joint] += (carrier.axis * moment).sum(axis=1)
    return torque


@attrs.frozen(eq=False)
class _Body:
    """A link of a leg in motion.

    Attributes:
        joint: Position of the joint that carries it, (n, 3), m.
        axis: Axis of that joint, (n, 3).
        centre: Centre of mass, (n, 3), m.
        force: Force that carries and accelerates it, (n, 3), N.
        moment: Moment about its centre of mass that turns it, (n, 3), N m.
    """

    joint: Array
    axis: Array
    centre: Array
    force: Array
    moment: Array


def _moved_bodies(robot: Robot, leg: int, q: Array, dq: Array, ddq: Array, down: Array) -> list[_Body]:
    """Return hip, thigh and calf of a leg; arguments as of `leg_torque`."""
    turn = np.broadcast_to(np.eye(3), (len(q), 3, 3))
    position, speed, spin_up = (np.zeros((len(q), 3)) for _ in range(3))  # speed and spin_up are angular
    acceleration = -GRAVITY * down  # gravity acts like a trunk that accelerates upwards
    bodies = []
    for k, kind in enumerate(KINDS):
        link = next(link for link in robot.links if link.name == f"{LEGS[leg]}_{kind}")
        inertial, along = robot.combined_inertial(link.name), 0 if link.axis == "x" else 1
        arm = turn @ np.array(link.origin)
        position, acceleration = position + arm, acceleration + _swing(speed, spin_up, arm)
        turn = turn @ _rotation_about(q[:, k], along)
        axis = turn[:, :, along]
        spin_up = spin_up + axis * ddq[:, k, None] + np.cross(speed, axis * dq[:, k, None])
        speed = speed + axis * dq[:, k, None]
        centre = turn @ inertial.com
        tensor = turn @ inertial.tensor @ turn.transpose(0, 2, 1)
        force = inertial.mass * (acceleration + _swing(speed, spin_up, centre))
        moment = _times(tensor, spin_up) + np.cross(speed, _times(tensor, speed))
        bodies.append(_Body(position, axis, position + centre, force, moment))
    return bodies


def _swing(speed: Array, spin_up: Array, arm: Array) -> Array:
    """Return the acceleration (n, 3) of the end of an arm that turns with an angular speed and acceleration."""
    return np.cross(spin_up, arm) + np.cross(speed, np.cross(speed, arm))


def _times(matrices: Array, vectors: Array) -> Array:
    """Return the products (n, 3) of matrices (n, 3, 3) and vectors (n, 3)."""
    product: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return product


def _rotation_about(angle: Array, axis: int) -> Array:
    """Return the rotation matrices (n, 3, 3) about x (0) or y (1)."""
    matrices = np.zeros((len(angle), 3, 3))
    a, b = [i for i in range(3) if i != axis]
    sign = 1.0 if axis == 0 else -1.0
    matrices[:, axis, axis] = 1.0
    matrices[:, a, a] = matrices[:, b, b] = np.cos(angle)
    matrices[:, b, a], matrices[:, a, b] = sign * np.sin(angle), -sign * np.sin(angle)
    return matrices

"""Tests of kinematics against MuJoCo, finite differences and SciPy's rotations."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadvel_description import kinematics, mjcf
from quadvel_description.quadruped import LEGS
from tests.helpers.robots import ALIENGO


def _random_q(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(ALIENGO.lower, ALIENGO.upper, size=(count, 12))


def _standing_q(count: int, seed: int) -> np.ndarray:
    """Random postures with every foot at least 5 cm below its thigh joint, in the plane of the leg."""
    q = np.random.default_rng(seed).uniform([-1.0, -0.5, -2.7] * 4, [1.0, 1.5, -0.7] * 4, size=(count, 12))
    legs = q.reshape(count, 4, 3)
    depth = 0.25 * (np.cos(legs[..., 1]) + np.cos(legs[..., 1] + legs[..., 2]))
    return q[(depth > 0.05).all(axis=1)]


def _random_rotations(count: int, seed: int) -> Rotation:
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(count, 4)))


def _wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def test_foot_positions_are_those_of_mujoco():
    model = mjcf.load_model(ALIENGO)
    data = mujoco.MjData(model)
    for q in _random_q(50, 0):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q]
        mujoco.mj_kinematics(model, data)
        feet = [data.geom(f"{leg}_foot").xpos for leg in LEGS]
        np.testing.assert_allclose(kinematics.foot_positions(ALIENGO, q), feet, atol=1e-12)


def test_foot_jacobians_are_the_derivatives_of_the_positions():
    step = 1e-6
    for q in _random_q(20, 1):
        numeric = np.zeros((4, 3, 3))
        for i in range(12):
            change = np.eye(12)[i] * step
            slope = kinematics.foot_positions(ALIENGO, q + change) - kinematics.foot_positions(
                ALIENGO, q - change
            )
            numeric[i // 3, :, i % 3] = slope[i // 3] / (2 * step)
        np.testing.assert_allclose(kinematics.foot_jacobians(ALIENGO, q), numeric, atol=1e-9)


def test_inverse_kinematics_undoes_the_forward_one():
    q = _standing_q(500, 2)
    assert len(q) > 100
    np.testing.assert_allclose(
        kinematics.inverse_kinematics(ALIENGO, kinematics.foot_positions(ALIENGO, q)), q, atol=1e-6
    )


def test_a_foot_out_of_reach_is_placed_in_its_direction_on_a_straight_leg():
    feet = kinematics.foot_positions(ALIENGO, ALIENGO.nominal_q)
    far = feet - np.array([0.0, 0.0, 1.0])
    reached = kinematics.foot_positions(ALIENGO, kinematics.inverse_kinematics(ALIENGO, far))
    assert np.isfinite(reached).all()
    np.testing.assert_allclose(reached, np.column_stack([feet[:, :2], np.full(4, -0.5)]), atol=1e-6)


def test_the_stance_has_its_feet_below_the_hips():
    feet = kinematics.foot_positions(ALIENGO, ALIENGO.nominal_q)
    np.testing.assert_allclose(feet[:, 2], ALIENGO.foot_radius - ALIENGO.nominal_height, atol=1e-4)
    np.testing.assert_allclose(feet[:, 0], ALIENGO.legs.hips[:, 0], atol=1e-4)


def test_leading_axes_are_kept():
    q = _standing_q(500, 3)[:6].reshape(2, 3, 12)
    feet = kinematics.foot_positions(ALIENGO, q)
    assert feet.shape == (2, 3, 4, 3)
    assert kinematics.foot_jacobians(ALIENGO, q).shape == (2, 3, 4, 3, 3)
    np.testing.assert_array_equal(
        kinematics.inverse_kinematics(ALIENGO, feet)[1, 2], kinematics.inverse_kinematics(ALIENGO, feet[1, 2])
    )
    quaternions = _wxyz(_random_rotations(6, 4)).reshape(2, 3, 4)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    for angles in (kinematics.roll_pitch, kinematics.yaw):
        np.testing.assert_allclose(angles(quaternions)[1, 2], angles(quaternions[1, 2]), atol=1e-15)


def test_vectors_turn_as_the_quaternion_says():
    rotation = _random_rotations(100, 4)
    v = np.random.default_rng(5).normal(size=(100, 3))
    turned = kinematics.rotate(_wxyz(rotation), v)
    np.testing.assert_allclose(turned, rotation.apply(v), atol=1e-12)
    np.testing.assert_allclose(kinematics.rotate_inverse(_wxyz(rotation), turned), v, atol=1e-12)


def test_roll_pitch_and_yaw_are_the_angles_about_moving_z_y_x():
    rotation = _random_rotations(100, 6)
    yaw, pitch, roll = rotation.as_euler("ZYX").T
    np.testing.assert_allclose(kinematics.roll_pitch(_wxyz(rotation)), np.stack([roll, pitch], -1), atol=1e-9)
    np.testing.assert_allclose(kinematics.yaw(_wxyz(rotation)), yaw, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_pitch_of_an_upright_robot_is_a_number(sign):
    half = np.sqrt(0.5) * (1 + 1e-12)  # round-off that leaves the range of the arc sine
    assert kinematics.roll_pitch(np.array([half, 0.0, sign * half, 0.0]))[1] == pytest.approx(
        sign * np.pi / 2
    )

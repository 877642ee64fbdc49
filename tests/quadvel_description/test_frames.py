"""Tests of the frame tree: one parent each, and the poses of MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from quadvel_description import mjcf
from quadvel_description.frames import BASE, FOOTPRINT, FramePose, fixed_links, footprint, moving_links
from quadvel_description.kinematics import foot_positions, rotate, yaw
from quadvel_description.quadruped import JOINT_NAMES
from tests.helpers.robots import ALIENGO


def in_base(frames: list[FramePose], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation matrix of a frame in base_link, up the tree."""
    parents = {frame.child: frame for frame in frames}
    position, rotation = np.zeros(3), np.eye(3)
    while name != BASE:
        frame = parents[name]
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, frame.quaternion)
        position = frame.position + matrix.reshape(3, 3) @ position
        rotation = matrix.reshape(3, 3) @ rotation
        name = frame.parent
    return position, rotation


def quaternion(roll: float, pitch: float, heading: float) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_euler2Quat(result, [roll, pitch, heading], "XYZ")
    return result


def test_every_frame_has_one_parent_and_hangs_below_base_link() -> None:
    frames = [
        *fixed_links(ALIENGO),
        *moving_links(ALIENGO, ALIENGO.nominal_q),
        footprint(ALIENGO, ALIENGO.nominal_q, quaternion(0, 0, 0)),
    ]
    children = [frame.child for frame in frames]
    assert len(set(children)) == len(children)
    assert set(children) == {FOOTPRINT, *(link.name for link in ALIENGO.links)}
    for name in children:
        in_base(frames, name)


def test_links_are_where_mujoco_has_them() -> None:
    model = mjcf.load_model(ALIENGO, mjcf.Plant(plane=False))
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(ALIENGO.lower, ALIENGO.upper, (10, 12)):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q]
        mujoco.mj_kinematics(model, data)
        frames = [*fixed_links(ALIENGO), *moving_links(ALIENGO, q)]
        for joint in JOINT_NAMES:
            body = joint.removesuffix("_joint")
            position, rotation = in_base(frames, body)
            np.testing.assert_allclose(position, data.body(body).xpos, atol=1e-12)
            np.testing.assert_allclose(rotation.ravel(), data.body(body).xmat, atol=1e-12)


@pytest.mark.parametrize(("roll", "pitch", "heading"), [(0, 0, 0), (0.2, -0.3, 2.5), (-0.4, 0.1, -1.0)])
def test_the_footprint_is_level_below_the_robot_where_its_lowest_foot_touches(
    roll: float, pitch: float, heading: float
) -> None:
    trunk = quaternion(roll, pitch, heading)
    q = ALIENGO.nominal_q + np.linspace(-0.1, 0.1, 12)
    position, rotation = in_base([footprint(ALIENGO, q, trunk)], FOOTPRINT)
    trunk_matrix = np.zeros(9)
    mujoco.mju_quat2Mat(trunk_matrix, trunk)
    in_world = trunk_matrix.reshape(3, 3) @ rotation
    c, s = np.cos(yaw(trunk)), np.sin(yaw(trunk))
    np.testing.assert_allclose(in_world, [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-12)
    lowest = rotate(trunk, foot_positions(ALIENGO, q))[:, 2].min() - ALIENGO.foot_radius
    np.testing.assert_allclose(rotate(trunk, position), [0.0, 0.0, lowest], atol=1e-12)

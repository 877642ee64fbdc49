"""Tests of the mirror of Table 1: an involution that matches the mirror image in MuJoCo."""

import mujoco
import numpy as np
import pytest

from quadvel_description import kinematics, mjcf, symmetry
from quadvel_description.quadruped import LEGS
from tests.helpers.robots import ALIENGO

MIRROR = np.array([1.0, -1.0, 1.0])  # across the sagittal plane
OPPOSITE = {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}


def _opposite(body: str) -> str:
    return OPPOSITE.get(body[:2], body[:2]) + body[2:]


def _mirrored_model(plant: mjcf.Plant) -> mujoco.MjModel:
    """The robot whose every link has the inertia of its opposite's mirror image."""
    original = mjcf.build_spec(ALIENGO, plant)
    spec = mjcf.build_spec(ALIENGO, plant)
    for body in spec.bodies:
        if body.name == "world":
            continue
        twin = original.body(_opposite(body.name))
        ixx, iyy, izz, ixy, ixz, iyz = twin.fullinertia
        body.ipos = twin.ipos * MIRROR
        body.fullinertia = [ixx, iyy, izz, -ixy, ixz, -iyz]
    return spec.compile()


def _mirror_state(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """qpos and qvel of the mirror image: a polar vector keeps x and z, an axial one y."""
    w, x, y, z = data.qpos[3:7]
    qpos = np.concatenate([data.qpos[:3] * MIRROR, [w, -x, y, -z], symmetry.mirror_joints(data.qpos[7:])])
    qvel = np.concatenate(
        [data.qvel[:3] * MIRROR, -data.qvel[3:6] * MIRROR, symmetry.mirror_joints(data.qvel[6:])]
    )
    return qpos, qvel


def _observation(data: mujoco.MjData, command: np.ndarray, action: np.ndarray) -> np.ndarray:
    """The paper's 48-vector, unscaled, of the robot in `data`."""
    quaternion = data.qpos[3:7]
    linear_velocity = kinematics.rotate_inverse(quaternion, data.qvel[:3])
    roll_pitch = kinematics.roll_pitch(quaternion)
    state = [roll_pitch, data.qpos[7:], data.qvel[6:], linear_velocity, data.qvel[3:6]]
    return np.concatenate([command, *state, action])


@pytest.mark.parametrize(
    "mirror", [symmetry.OBSERVATION, symmetry.JOINTS, symmetry.FEET, *symmetry.MIRRORS.values()]
)
def test_mirroring_twice_is_the_identity(mirror):
    x = np.random.default_rng(0).normal(size=(5, len(mirror.index)))
    np.testing.assert_array_equal(mirror(mirror(x)), x)
    np.testing.assert_array_equal(mirror.matrix() @ mirror.matrix(), np.eye(len(mirror.index)))
    np.testing.assert_array_equal(x @ mirror.matrix().T, mirror(x))


def test_the_observation_has_the_48_numbers_of_the_paper():
    assert len(symmetry.OBSERVATION.index) == 48


def test_a_mirrored_command_turns_and_steps_the_other_way():
    observation = np.zeros(48)
    observation[:4] = [1.0, 0.5, -0.7, 1.0]  # forward, lateral, turn, stance
    np.testing.assert_array_equal(symmetry.mirror_observation(observation)[:4], [1.0, -0.5, 0.7, 1.0])


def test_mirrored_joints_put_the_feet_at_mirrored_places():
    q = np.random.default_rng(1).uniform(ALIENGO.lower, ALIENGO.upper, size=(20, 12))
    feet = kinematics.foot_positions(ALIENGO, q)
    mirrored = kinematics.foot_positions(ALIENGO, symmetry.mirror_joints(q))
    np.testing.assert_allclose(mirrored, feet[:, symmetry.FEET.index] * MIRROR, atol=1e-12)


def test_stances_and_limits_are_their_own_mirror_image():
    for q in (ALIENGO.nominal_q, ALIENGO.lie_q):
        np.testing.assert_array_equal(symmetry.mirror_joints(q), q)
    for lower, upper in ((ALIENGO.lower, ALIENGO.upper), (ALIENGO.command_lower, ALIENGO.command_upper)):
        ends = np.sort(symmetry.mirror_joints(np.stack([lower, upper])), axis=0)
        np.testing.assert_array_equal(ends, [lower, upper])


def test_only_trunk_and_calves_are_a_little_asymmetric():
    plant = mjcf.Plant()
    model, mirrored = mjcf.load_model(ALIENGO, plant), _mirrored_model(plant)
    shift = np.abs(model.body_ipos - mirrored.body_ipos).max(axis=1)
    moved = {model.body(i).name for i in np.flatnonzero(shift > 1e-9)}
    assert moved == {"trunk", *(f"{leg}_calf" for leg in LEGS)}
    assert shift.max() < 0.008  # m, twice the lateral offset of the trunk's centre of mass


@pytest.mark.parametrize("seed", range(3))
def test_the_mirrored_robot_moves_as_the_mirror_image(seed):
    plant = mjcf.Plant()
    model, mirrored = mjcf.load_model(ALIENGO, plant), _mirrored_model(plant)
    rng = np.random.default_rng(seed)
    data, image = mujoco.MjData(model), mujoco.MjData(mirrored)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    data.qvel[:] = rng.normal(size=18) * 0.5
    image.qpos[:], image.qvel[:] = _mirror_state(model, data)
    touching = 0
    for k in range(400):
        if k % 20 == 0:
            torque = rng.uniform(-0.4, 0.4, 12) * ALIENGO.torque_limit
        data.ctrl[:] = torque
        image.ctrl[:] = symmetry.mirror_joints(torque)
        mujoco.mj_step(model, data)
        mujoco.mj_step(mirrored, image)
        touching += data.ncon > 0
        qpos, qvel = _mirror_state(model, data)
        np.testing.assert_allclose(image.qpos, qpos, atol=1e-9)
        np.testing.assert_allclose(image.qvel, qvel, atol=1e-7)
        seen = _observation(image, np.array([1.0, 0.5, -0.7, 0.0]), symmetry.mirror_action(torque))
        expected = symmetry.mirror_observation(_observation(data, np.array([1.0, -0.5, 0.7, 0.0]), torque))
        np.testing.assert_allclose(seen, expected, atol=1e-7)
    assert touching > 200
    assert np.abs(data.qpos[1]) > 1e-3  # it did not stay in the plane of symmetry

"""Tests of the MJCF: postures, and the parameters of its plant."""

import mujoco
import numpy as np
import pytest

from quadvel_description import kinematics, mjcf
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES, LEGS
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import shipped_robots


@pytest.fixture(params=shipped_robots())
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


def _in(model: mujoco.MjModel, keyframe: str) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize(("keyframe", "posture"), [("stand", "nominal_q"), ("lie", "lie_q")])
def test_in_a_keyframe_the_feet_touch_the_ground_and_nothing_reaches_below_it(robot, keyframe, posture):
    model = mjcf.load_model(robot)
    data = _in(model, keyframe)
    np.testing.assert_array_equal(data.qpos[7:], getattr(robot, posture))
    soles = [data.geom(f"{leg}_foot").xpos[2] - robot.foot_radius for leg in LEGS]
    np.testing.assert_allclose(soles, 0.0, atol=5e-4)
    assert (data.contact.dist > -5e-4).all()
    assert all(model.geom(geom).name.endswith("_foot") for geom in data.contact.geom2)


def test_the_robot_stands_on_its_gains_and_the_torque_against_gravity(robot):
    model = mjcf.load_model(robot)
    data = _in(model, "stand")
    feedforward = mjcf.gravity_torque(model)
    assert (np.abs(feedforward) < 0.5 * robot.torque_limit).all()
    for _ in range(1000):
        servo = robot.kp * (robot.nominal_q - data.qpos[7:]) - robot.kd * data.qvel[6:]
        data.ctrl[:] = servo + feedforward
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos[:3], [0, 0, robot.nominal_height], atol=5e-3)
    np.testing.assert_allclose(kinematics.roll_pitch(data.qpos[3:7]), 0.0, atol=np.radians(0.5))
    np.testing.assert_allclose(data.qpos[7:], robot.nominal_q, atol=0.01)


def test_the_torque_against_gravity_carries_the_weight_of_the_trunk_on_the_feet(robot):
    model = mjcf.load_model(robot)
    feet = kinematics.foot_jacobians(robot, robot.nominal_q)
    data = _in(model, "stand")
    legs = data.qfrc_bias[6:].reshape(4, 3)  # the legs' weight on a fixed trunk
    torque = mjcf.gravity_torque(model).reshape(4, 3)
    force = np.linalg.solve(np.swapaxes(feet, 1, 2), (legs - torque)[..., None])[..., 0]
    np.testing.assert_allclose(force, np.tile([0, 0, robot.mass * GRAVITY / 4], (4, 1)), atol=1e-6)


def test_the_lying_robot_sinks_on_its_belly_upright_and_rests(robot):
    model = mjcf.load_model(robot)
    data = _in(model, "lie")
    for _ in range(12000):  # legs folded below it, it stays up for some seconds
        data.ctrl[:] = -2.0 * data.qvel[6:]
        mujoco.mj_step(model, data)
    assert 0.05 < data.qpos[2] <= robot.lie_height
    assert np.abs(data.qvel).max() < 0.01
    np.testing.assert_allclose(kinematics.roll_pitch(data.qpos[3:7]), 0.0, atol=np.radians(2))


def test_motors_stand_in_the_order_of_the_joint_table_and_keep_its_limits(robot):
    model = mjcf.load_model(robot)
    assert [model.actuator(i).name for i in range(model.nu)] == list(JOINT_NAMES)
    np.testing.assert_array_equal(
        model.actuator_ctrlrange, np.stack([-robot.torque_limit, robot.torque_limit], 1)
    )
    np.testing.assert_array_equal(model.jnt_range[1:], np.stack([robot.lower, robot.upper], 1))


def test_the_plant_varies_the_robot(robot):
    armature = np.linspace(0.01, 0.03, 12)
    model = mjcf.load_model(robot, mjcf.Plant(timestep=0.002, armature=armature, plane=False))
    assert model.opt.timestep == 0.002
    np.testing.assert_array_equal(model.dof_armature[6:], armature)
    assert "ground" not in [model.geom(i).name for i in range(model.ngeom)]


def test_without_leg_shapes_only_feet_and_trunk_collide(robot):
    model = mjcf.load_model(robot, mjcf.Plant(only_feet_and_trunk=True))
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_conaffinity[i]}
    assert colliding == {"trunk", *(f"{leg}_foot" for leg in LEGS)}


def test_the_imu_of_a_robot_at_rest_feels_gravity(robot):
    model = mjcf.load_model(robot)
    data = _in(model, "lie")
    for _ in range(2500):
        data.ctrl[:] = -2.0 * data.qvel[6:]
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.sensor("accelerometer").data, [0, 0, GRAVITY], atol=0.05)
    np.testing.assert_allclose(data.sensor("gyro").data, 0.0, atol=0.01)
    np.testing.assert_allclose(data.sensor("orientation").data, data.qpos[3:7], atol=1e-3)

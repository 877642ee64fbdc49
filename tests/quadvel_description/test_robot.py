"""Tests of the joint and link tables against Unitree's numbers."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from quadvel_description.quadruped import JOINT_NAMES, joint_index
from quadvel_description.robot import load_robot, robot_of_file
from tests.helpers.robots import ALIENGO, GO2

# mass (kg), centre of mass (m) and inertia (ixx iyy izz ixy ixz iyz, kg mm^2), worked out apart
LUMPED = {
    "FL_hip": (
        2.139,
        (-0.020676, 0.016144, -0.000014),
        (2559.307, 4131.567, 4327.706, -642.293, 1.900, 1.254),
    ),
    "FL_thigh": (
        0.771,
        (-0.004647, -0.020282, -0.039947),
        (5577.995, 4734.426, 1493.562, 69.063, -348.440, 614.508),
    ),
    "FL_calf": (0.267, (0.002156, 0.000049, -0.166671), (2683.514, 2696.057, 54.797, 0.031, -8.147, -0.831)),
}


def test_the_robot_weighs_what_its_links_weigh():
    assert abs(ALIENGO.mass - (24.936 + 0.001)) < 1e-9  # the IMU is the last gram


def test_the_trunk_carries_its_hip_rotors_and_the_imu():
    trunk = ALIENGO.combined_inertial("trunk")
    assert trunk.mass == pytest.approx(12.228 + 0.001)
    np.testing.assert_allclose(trunk.com, (0.008390, 0.003656, 0.000260), atol=1e-6)
    inertia = (0.054026921, 0.258759810, 0.284296015, 0.001684806, 0.000234603, 0.000119200)
    imu = (1e-4, 1e-4, 1e-4, 0, 0, 0)
    np.testing.assert_allclose(trunk.fullinertia(), np.add(inertia, imu), atol=2e-7)


@pytest.mark.parametrize("name", LUMPED)
def test_links_carry_their_rotors(name):
    mass, com, micro = LUMPED[name]
    lumped = ALIENGO.combined_inertial(name)
    assert lumped.mass == pytest.approx(mass, abs=1e-9)
    np.testing.assert_allclose(lumped.com, com, atol=1e-6)
    np.testing.assert_allclose(np.array(lumped.fullinertia()) * 1e6, micro, atol=1e-3)


def test_every_inertia_is_that_of_a_real_body():
    for link in ALIENGO.links:
        moments = np.linalg.eigvalsh(link.inertial.tensor)
        assert (moments > 0).all(), link.name
        assert moments[2] <= moments[0] + moments[1] + 1e-12, link.name


def test_joints_stand_in_the_order_of_the_robot():
    assert JOINT_NAMES[:4] == ("FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint")
    assert [name[:2] for name in JOINT_NAMES[::3]] == ["FR", "FL", "RR", "RL"]
    assert joint_index(JOINT_NAMES) == list(range(12))
    assert joint_index(["RL_calf", "FR_hip_joint"]) == [11, 0]


def test_an_unknown_joint_is_refused_by_name():
    with pytest.raises(ValueError, match="found 'FR_knee', expected one of FR_hip_joint"):
        joint_index(["FR_hip", "FR_knee"])


def test_postures_and_commands_lie_within_the_mechanical_range():
    for q in (ALIENGO.nominal_q, ALIENGO.lie_q, ALIENGO.command_lower, ALIENGO.command_upper):
        assert (q >= ALIENGO.lower).all()
        assert (q <= ALIENGO.upper).all()


def test_hips_may_be_commanded_further_outward_than_inward():
    hips = joint_index(["FR_hip", "FL_hip"])  # positive: right foot inward, left foot outward
    np.testing.assert_array_equal(ALIENGO.command_lower[hips], [-1.047, -0.873])
    np.testing.assert_array_equal(ALIENGO.command_upper[hips], [0.873, 1.047])


def test_tables_cannot_be_changed_by_accident():
    with pytest.raises(ValueError, match="read-only"):
        ALIENGO.nominal_q[0] = 1.0


@pytest.mark.parametrize(
    "change",
    [
        {"kp": 0.0},
        {"torque_limit": [1.0, 2.0]},
        {"velocity_limit": 0.0},
        {"armature": [0.0, 0.0, -0.01]},
        {"lie_q": [0.0, 9.0, -1.0]},
        {"foot_radius": 25.0},
        {"suspended_height": 800.0},
        {"velocity_limit": 1200.0},
        {"armature": 150.0},
        {"name": "fourth"},
    ],
)
def test_a_wrong_number_of_a_robot_is_refused_by_its_name(tmp_path, change):
    folder = tmp_path / "mine"
    shutil.copytree(ALIENGO.folder, folder)
    fields = yaml.safe_load((folder / "robot.yaml").read_text())
    (folder / "robot.yaml").write_text(yaml.safe_dump({**fields, **change}))
    with pytest.raises(ValueError, match=rf"robot.yaml: .*{next(iter(change))}: found"):
        load_robot(str(folder))


def test_a_robot_is_loaded_by_name_or_folder(tmp_path):
    shutil.copytree(GO2.folder, tmp_path / "mine")
    copied = load_robot(str(tmp_path / "mine"))
    assert (copied.name, copied.mass) == (GO2.name, GO2.mass)
    assert load_robot("go2") is GO2
    with pytest.raises(FileNotFoundError, match="found 'spot', expected aliengo, go2 or the path"):
        load_robot("spot")
    with pytest.raises(ValueError, match=r"expected a robot\.yaml or its folder; `quadvel robot check`"):
        load_robot(str(Path(GO2.folder) / "robot.urdf"))


def test_a_file_of_a_robot_that_is_not_shipped_asks_for_its_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"walk\.mcap: its robot is 'mine', .*--robot"):
        robot_of_file(tmp_path / "walk.mcap", "mine", None)
    assert robot_of_file(tmp_path / "walk.mcap", "go2", GO2.folder) is not None

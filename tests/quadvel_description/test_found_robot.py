"""Robots found in MJCF and URDF files: joints matched by place and chain, others refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadvel_description.found_robot import FoundRobot, UnsupportedRobotError, find_robot
from quadvel_description.found_robot_checks import check_found_robot
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import shipped_robots
from tests.helpers.third_robot import write_third_robot


@pytest.fixture
def third(tmp_path: Path) -> Path:
    return write_third_robot(tmp_path)


def _codes(found: FoundRobot) -> list[str]:
    return [finding.code for finding in check_found_robot(found)]


def _edited(path: Path, *replacements: tuple[str, str]) -> FoundRobot:
    text = path.read_text()
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return find_robot(path)


@pytest.mark.parametrize("name", shipped_robots())
@pytest.mark.parametrize("file", ["mjcf_file", "urdf_file"])
def test_a_shipped_robot_is_found_as_it_is_loaded(name: str, file: str) -> None:
    robot = load_robot(name)
    found = find_robot(getattr(robot, file))
    assert [joint.source for joint in found.joints] == list(JOINT_NAMES)
    np.testing.assert_allclose([joint.lower for joint in found.joints], robot.lower, atol=1e-6)
    np.testing.assert_allclose(found.anchors[:, 0], robot.legs.hips, atol=1e-9)
    np.testing.assert_allclose(found.foot_radii, robot.foot_radius)
    assert found.mass == pytest.approx(robot.mass, abs=0.002)  # the AlienGo's URDF has an IMU of 1 g
    assert not [finding for finding in check_found_robot(found) if finding.fatal]


def test_a_urdf_states_limits_of_torque_and_speed() -> None:
    found = find_robot(load_robot("go2").urdf_file)
    assert [joint.speed for joint in found.joints] == [30.0] * 12
    assert [joint.torque for joint in found.joints] == [23.7, 23.7, 45.43] * 4


def test_joints_are_matched_by_place_and_chain_and_turned_ones_are_named(third: Path) -> None:
    found = find_robot(third)
    assert [joint.source for joint in found.joints[:3]] == ["rf_haa", "rf_hfe", "rf_kfe"]
    assert [joint.number for joint in found.joints] == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    assert [joint.source for joint in found.joints if joint.sign < 0] == ["lf_haa", "lh_haa"]
    assert [joint.torque for joint in found.joints] == [30.0, 30.0, 40.0] * 4
    np.testing.assert_allclose(found.imu, [0, 0, 0.03])
    assert _codes(found) == ["sign", "speed_limit"]


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ('axis="0 1 0" range="-1.8 1.8" act', 'axis="0 1 0" act', "range_limit"),
        ('actuatorfrcrange="-40 40"', "", "torque_limit"),
        ('<site name="imu" pos="0 0 0.03"/>', "", "imu"),
        ('type="sphere" size="0.025" pos="0 0 -0.26"', 'type="box" size="0.02 0.02 0.02"', "feet"),
        ('mass="9" pos="0.01 0 0"', 'mass="9" pos="0.01 0.01 0"', "symmetry"),
        ('mass="9"', 'mass="0.9"', "mass"),
        ('diaginertia="0.06 0.25 0.28"', 'diaginertia="60 250 280"', "inertia"),
        ('pos="0 0 -0.26"', 'pos="0.05 0 -0.26"', "zero_posture"),
        ('name="lf_', 'name="FR_', "names"),
    ],
)
def test_what_is_missing_or_wrong_is_found(third: Path, old: str, new: str, code: str) -> None:
    assert code in _codes(_edited(third, (old, new)))


def test_a_link_that_differs_from_its_mirror_image_is_named(third: Path) -> None:
    one = third.read_text().index("rf_thigh")
    text = third.read_text()
    third.write_text(text[:one] + text[one:].replace('mass="1.1"', 'mass="1.3"', 1))
    found = [one.text for one in check_found_robot(find_robot(third)) if one.code == "symmetry"]
    assert found == ["links of rf_hfe and lf_hfe: masses 1.300 and 1.100 kg"]


WHEEL = """<body pos="0 0 -0.26"><inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
<joint name="wheel" axis="0 1 0"/></body>"""
ARM = WHEEL.replace("wheel", "shoulder")


@pytest.mark.parametrize(
    ("code", "old", "new"),
    [
        ("arm", '<site name="imu"', ARM + '<site name="imu"'),
        ("wheels", '<geom type="sphere"', WHEEL.replace(' name="wheel"', "") + '<geom type="sphere"'),
        (
            "joint_count",
            '<joint name="lf_kfe" axis="0 1 0" range="-2.6 -0.4" actuatorfrcrange="-40 40"/>',
            "",
        ),
        ("joint_type", '<joint name="lf_kfe"', '<joint type="slide" name="lf_kfe"'),
        ("axis", 'name="lf_hfe" axis="0 1 0"', 'name="lf_hfe" axis="0 0 1"'),
        ("legs", 'name="lf_hip" pos="0.28', 'name="lf_hip" pos="-0.28'),
        ("inertia", 'diaginertia="0.006 0.006 0.001"', 'diaginertia="0.006 0.001 0.001"'),
        ("file", "</mujoco>", ""),
    ],
)
def test_what_is_no_quadruped_with_twelve_joints_is_refused_by_name(
    third: Path, code: str, old: str, new: str
) -> None:
    with pytest.raises(UnsupportedRobotError, match=f"third.xml: {code}: ") as refused:
        _edited(third, (old, new))
    assert refused.value.code == code


LEG = """<mujoco><worldbody><body name="shank">
<joint name="knee" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/>{more}
</body></worldbody></mujoco>"""
FOREARM = """<body name="forearm" pos="0 0 -0.3">
<joint name="elbow" axis="0 1 0"/><geom type="sphere" size="0.05"/></body>"""


@pytest.mark.parametrize("more", ["", FOREARM])
def test_a_leg_or_arm_on_a_fixed_base_is_refused_for_its_joints(more: str, tmp_path: Path) -> None:
    (tmp_path / "leg.xml").write_text(LEG.format(more=more))
    with pytest.raises(UnsupportedRobotError) as refused:
        find_robot(tmp_path / "leg.xml")
    assert refused.value.code == "joint_count"


def test_four_legs_without_a_trunk_are_refused_for_their_fixed_base(third: Path) -> None:
    with pytest.raises(UnsupportedRobotError) as refused:
        _edited(
            third,
            ("<freejoint/>", ""),
            ('<inertial mass="9" pos="0.01 0 0" diaginertia="0.06 0.25 0.28"/>', ""),
            ('<body name="torso" pos="0 0 0.6">', "<frame>"),
            ("</body>\n  </worldbody>", "</frame>\n  </worldbody>"),
        )
    assert refused.value.code == "fixed_base"

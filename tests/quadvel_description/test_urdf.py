"""Tests that the URDF equals the MJCF; MuJoCo reads both."""

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from quadvel_description import kinematics, mjcf
from quadvel_description.frames import BASE
from quadvel_description.quadruped import JOINT_NAMES, LEGS
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import shipped_robots
from quadvel_description.urdf import read_links
from quadvel_description.urdf_generator import generate_folder_urdf

KEEP_FIXED_LINKS = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'


@pytest.fixture(scope="module", params=shipped_robots())
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def imported(robot: Robot) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        robot.urdf_file.read_text().replace("</robot>", f"{KEEP_FIXED_LINKS}</robot>")
    )


@pytest.fixture(scope="module")
def simulated(robot: Robot) -> mujoco.MjModel:
    return mjcf.load_model(robot, mjcf.Plant(plane=False))


def _postures(robot: Robot, imported: mujoco.MjModel, simulated: mujoco.MjModel, count: int):
    """Postures, and the URDF's and the MJCF's MjData in them, with the trunk at the origin."""
    first, second = mujoco.MjData(imported), mujoco.MjData(simulated)
    for q in np.random.default_rng(0).uniform(robot.lower, robot.upper, size=(count, 12)):
        for name, angle in zip(JOINT_NAMES, q, strict=True):
            first.joint(name).qpos = angle
        second.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q]
        for model, data in ((imported, first), (simulated, second)):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
        yield q, first, second


def test_urdf_and_mjcf_weigh_the_same(robot, imported, simulated):
    assert imported.body_mass.sum() == pytest.approx(robot.mass, abs=1e-9)
    assert simulated.body_mass.sum() == pytest.approx(robot.mass, abs=1e-9)


def test_urdf_and_mjcf_have_the_same_centre_of_mass(robot, imported, simulated):
    for _, first, second in _postures(robot, imported, simulated, 20):
        np.testing.assert_allclose(first.body(BASE).subtree_com, second.body("trunk").subtree_com, atol=1e-9)


def test_urdf_and_mjcf_have_the_same_inertia_about_every_joint(robot, imported, simulated):
    rows = [imported.joint(name).dofadr[0] for name in JOINT_NAMES]
    for _, first, second in _postures(robot, imported, simulated, 5):
        inertia = []
        for model, data in ((imported, first), (simulated, second)):
            mujoco.mj_crb(model, data)
            full = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, full)
            inertia.append(full - np.diag(model.dof_armature))
        np.testing.assert_allclose(inertia[0][np.ix_(rows, rows)], inertia[1][6:, 6:], atol=1e-9)


def test_urdf_and_mjcf_put_every_foot_at_the_same_place(robot, imported, simulated):
    for q, first, second in _postures(robot, imported, simulated, 50):
        for leg, foot in zip(LEGS, kinematics.foot_positions(robot, q), strict=True):
            np.testing.assert_allclose(
                first.body(f"{leg}_foot").xpos, second.geom(f"{leg}_foot").xpos, atol=1e-9
            )
            np.testing.assert_allclose(first.body(f"{leg}_foot").xpos, foot, atol=1e-9)


def test_urdf_and_mjcf_show_the_same_shapes(robot, imported, simulated):
    def shapes(model: mujoco.MjModel, data: mujoco.MjData, collide: bool) -> np.ndarray:
        rows = [
            [model.geom_type[i], *model.geom_size[i], *data.geom_xpos[i], *np.abs(data.geom_xmat[i])]
            for i in range(model.ngeom)
            if not collide or model.geom_conaffinity[i]
        ]
        return np.array(sorted(rows))

    _, first, second = next(_postures(robot, imported, simulated, 1))
    expected = shapes(simulated, second, False)
    np.testing.assert_allclose(shapes(imported, first, True), expected, atol=1e-9)
    assert imported.ngeom == 2 * len(expected)  # a visual and a collision shape each


def test_limits_in_the_urdf_are_those_of_the_joint_table(robot):
    joints = {
        joint.get("name"): joint
        for joint in ElementTree.fromstring(robot.urdf_file.read_text()).iter("joint")
    }
    for i, name in enumerate(JOINT_NAMES):
        limit = joints[name].find("limit")
        found = [float(limit.get(key)) for key in ("lower", "upper", "effort", "velocity")]
        assert found == [
            robot.lower[i],
            robot.upper[i],
            robot.torque_limit[i],
            robot.velocity_limit[i],
        ]


def test_links_form_one_tree_below_a_root_without_inertia(robot):
    tree = ElementTree.fromstring(robot.urdf_file.read_text())
    links = [link.get("name") for link in tree.iter("link")]
    children = [joint.find("child").get("link") for joint in tree.iter("joint")]
    parents = [joint.find("parent").get("link") for joint in tree.iter("joint")]
    assert len(set(links)) == len(links)
    assert sorted([BASE, *children]) == sorted(links)
    assert set(parents) <= set(links)
    assert tree.find(f"link[@name='{BASE}']/inertial") is None


def test_the_urdf_of_the_go2_is_the_generated_one():
    go2 = load_robot("go2")
    assert go2.urdf_file.read_text() == generate_folder_urdf(go2.folder), (
        "python -m quadvel_description.urdf_generator"
    )


def _joints_changed(robot: Robot, folder: Path, change: Callable[[list[ElementTree.Element]], None]) -> Path:
    """Write the robot's URDF with other joints."""
    tree = ElementTree.parse(robot.urdf_file)
    root, joints = tree.getroot(), tree.getroot().findall("joint")
    for joint in joints:
        root.remove(joint)
    change(joints)
    root.extend(joints)
    tree.write(folder / "robot.urdf")
    return folder / "robot.urdf"


def test_joints_are_read_in_any_order_and_parents_come_first(robot, tmp_path):
    links = read_links(_joints_changed(robot, tmp_path, list.reverse))
    names = [link["name"] for link in links]
    assert sorted(names) == sorted(link.name for link in robot.links)
    assert all(link["parent"] is None or link["parent"] in names[:i] for i, link in enumerate(links))


def test_the_order_of_a_file_whose_parents_come_first_is_kept(robot):
    assert [link["name"] for link in read_links(robot.urdf_file)] == [link.name for link in robot.links]


@pytest.mark.parametrize(
    ("element", "link"), [("parent", "FR_calf"), ("parent", "nothing"), ("child", "FL_thigh")]
)
def test_links_in_a_circle_without_a_parent_or_with_two_are_refused(robot, tmp_path, element, link):
    def wrong(joints: list[ElementTree.Element]) -> None:
        joint = next(joint for joint in joints if joint.get("name") == "FR_hip_joint")
        joint.find(element).set("link", link)

    path = _joints_changed(robot, tmp_path, wrong)
    with pytest.raises(ValueError, match=str(path)):
        read_links(path)

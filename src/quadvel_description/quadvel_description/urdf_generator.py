"""URDF of a robot from its MJCF, for robots whose maker publishes no usable URDF.

`python -m quadvel_description.urdf_generator FOLDER` writes `robot.urdf` from `robot.xml`; limits of
torque and speed come from `robot.yaml`. The simulation uses the MJCF; `urdf` reads the result.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from .arrays import Array
from .bounded_yaml import read_yaml
from .quadruped import JOINT_NAMES
from .urdf import ROOT

Element = ElementTree.Element
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def _text(*values: float) -> str:
    """Return numbers as an attribute value."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # + 0.0: no negative zeros


def _rpy(quaternion: np.ndarray) -> np.ndarray:
    """Return roll, pitch, yaw (rad) of a quaternion (w, x, y, z): URDF's fixed-axis angles."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    r = matrix.reshape(3, 3)
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def _add_inertial(link: Element, body: mujoco.MjsBody) -> None:
    """Add the inertia of a body; its MJCF must state it in the axes of the body."""
    full = body.fullinertia if np.isfinite(body.fullinertia[0]) else [*body.inertia, 0.0, 0.0, 0.0]
    node = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(node, "origin", xyz=_text(*body.ipos), rpy="0 0 0")
    ElementTree.SubElement(node, "mass", value=_text(body.mass))
    ElementTree.SubElement(node, "inertia", dict(zip(_INERTIA, map(_text, full), strict=True)))


def _add_shape(link: Element, geom: mujoco.MjsGeom, model: mujoco.MjModel) -> None:
    """Add a geom as visual and collision."""
    size, quaternion = geom.size, model.geom_quat[geom.id]
    shape: tuple[str, dict[str, str]]
    match geom.type:
        case mujoco.mjtGeom.mjGEOM_BOX:
            shape = "box", {"size": _text(*(2 * size))}
        case mujoco.mjtGeom.mjGEOM_CYLINDER | mujoco.mjtGeom.mjGEOM_CAPSULE:
            shape = "cylinder", {"radius": _text(size[0]), "length": _text(2 * size[1])}
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = "sphere", {"radius": _text(size[0])}
        case other:
            raise ValueError(f"geom {geom.name!r}: found {other}, expected box, capsule, cylinder or sphere")
    for role in ("visual", "collision"):
        node = ElementTree.SubElement(link, role)
        ElementTree.SubElement(node, "origin", xyz=_text(*geom.pos), rpy=_text(*_rpy(quaternion)))
        ElementTree.SubElement(ElementTree.SubElement(node, "geometry"), shape[0], shape[1])
        if role == "visual":
            colour = _text(*np.round(geom.rgba.astype(float), 3))
            material = ElementTree.SubElement(node, "material", name=f"rgba {colour}")
            ElementTree.SubElement(material, "color", rgba=colour)


def _add_joint(
    tree: Element,
    child: str,
    parent: str,
    origin: np.ndarray,
    joint: mujoco.MjsJoint | None,
    limits: Mapping[str, str],
) -> None:
    """Add the joint between a link and its parent: revolute, or fixed without `joint`."""
    name = joint.name if joint else f"{child}_fixed"
    element = ElementTree.SubElement(tree, "joint", name=name, type="revolute" if joint else "fixed")
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    ElementTree.SubElement(element, "origin", xyz=_text(*origin), rpy="0 0 0")
    if joint:
        lower, upper = map(_text, joint.range)
        ElementTree.SubElement(element, "axis", xyz=_text(*joint.axis))
        ElementTree.SubElement(element, "limit", {"lower": lower, "upper": upper, **limits})


def generate_urdf(mjcf: str, name: str, torque_limit: Array, velocity_limit: Array) -> str:
    """Generate the URDF of a robot: root link `base_link`, then the bodies of its MJCF.

    Args:
        mjcf: Text of the MJCF.
        name: Name of the robot.
        torque_limit: Largest torques, (12,), N m.
        velocity_limit: Largest speeds, (12,), rad/s.

    Returns:
        URDF text.
    """
    spec = mujoco.MjSpec.from_string(mjcf)
    model = spec.compile()
    tree = Element("robot", name=name)
    ElementTree.SubElement(tree, "link", name=ROOT)
    for body in spec.bodies[1:]:
        link = ElementTree.SubElement(tree, "link", name=body.name)
        _add_inertial(link, body)
        for geom in body.geoms:
            _add_shape(link, geom, model)
        parent = body.parent.name
        moving = [joint for joint in body.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
        joint, limits = None, {}
        if moving:
            joint = moving[0]
            i = JOINT_NAMES.index(joint.name)
            limits = {"effort": _text(torque_limit[i]), "velocity": _text(velocity_limit[i])}
        root = parent == "world"
        origin = np.zeros(3) if root else body.pos
        _add_joint(tree, body.name, ROOT if root else parent, origin, joint, limits)
    for site in spec.sites:
        if site.name == "imu":
            ElementTree.SubElement(tree, "link", name="imu_link")
            _add_joint(tree, "imu_link", site.parent.name, site.pos, None, {})
    ElementTree.indent(tree)
    return ElementTree.tostring(tree, encoding="unicode", xml_declaration=True) + "\n"


def generate_folder_urdf(folder: Path) -> str:
    """Generate the URDF of a robot's folder, from `robot.xml` and `robot.yaml`.

    Args:
        folder: Folder of the robot.

    Returns:
        URDF text.
    """
    numbers = read_yaml(folder / "robot.yaml", "a YAML file of a robot")
    limits = (np.resize(numbers[name], len(JOINT_NAMES)) for name in ("torque_limit", "velocity_limit"))
    return generate_urdf((folder / "robot.xml").read_text(encoding="utf-8"), numbers["name"], *limits)


if __name__ == "__main__":
    if len(sys.argv) != 2 or not (Path(sys.argv[1]) / "robot.yaml").is_file():
        sys.exit(
            "usage: python -m quadvel_description.urdf_generator FOLDER, with robot.xml and robot.yaml in it"
        )
    (Path(sys.argv[1]) / "robot.urdf").write_text(generate_folder_urdf(Path(sys.argv[1])), encoding="utf-8")

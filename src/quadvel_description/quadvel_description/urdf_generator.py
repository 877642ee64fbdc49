"""Generator of the URDF file: `python -m quadvel_description.urdf_generator` writes it.

Links, inertias and limits come from `robot`, shapes from the MJCF. The simulation uses the MJCF.
"""

from __future__ import annotations

from xml.etree import ElementTree

import mujoco
import numpy as np

from . import robot
from .frames import BASE
from .mjcf import Plant, load_model
from .urdf import FILE


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


def _add_inertial(element: ElementTree.Element, inertial: robot.Inertial) -> None:
    """Add the inertia of a link."""
    node = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(node, "origin", xyz=_text(*inertial.com), rpy="0 0 0")
    ElementTree.SubElement(node, "mass", value=_text(inertial.mass))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    tensor = {name: _text(value) for name, value in zip(names, inertial.fullinertia(), strict=True)}
    ElementTree.SubElement(node, "inertia", tensor)


def _add_shape(element: ElementTree.Element, model: mujoco.MjModel, geom: int, origin: np.ndarray) -> None:
    """Add an MJCF geom as visual and collision of a link at `origin` in the geom's body."""
    size = model.geom_size[geom]
    shape: tuple[str, dict[str, str]]
    match int(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            shape = "box", {"size": _text(*(2 * size))}
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            shape = "cylinder", {"radius": _text(size[0]), "length": _text(2 * size[1])}
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = "sphere", {"radius": _text(size[0])}
        case other:
            raise ValueError(
                f"geom {model.geom(geom).name!r}: found type {other}, expected box, cylinder or sphere"
            )
    for role in ("visual", "collision"):
        node = ElementTree.SubElement(element, role)
        position = model.geom_pos[geom] - origin
        ElementTree.SubElement(node, "origin", xyz=_text(*position), rpy=_text(*_rpy(model.geom_quat[geom])))
        ElementTree.SubElement(ElementTree.SubElement(node, "geometry"), shape[0], shape[1])
        if role == "visual":
            colour = _text(*np.round(model.geom_rgba[geom].astype(float), 3))
            material = ElementTree.SubElement(node, "material", name=f"rgba {colour}")
            ElementTree.SubElement(material, "color", rgba=colour)


def _add_link(parent: ElementTree.Element, link: robot.Link, model: mujoco.MjModel) -> None:
    """Add a link with inertia and shapes."""
    element = ElementTree.SubElement(parent, "link", name=link.name)
    _add_inertial(element, link.inertial)
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        owner = model.geom(geom).name or body  # a foot is a link here, and a geom of the calf there
        if owner == link.name:
            _add_shape(element, model, geom, np.zeros(3) if body == owner else np.array(link.origin))


def _add_joint(parent: ElementTree.Element, link: robot.Link) -> None:
    """Add the joint between `link` and its parent: revolute (joint table) or fixed."""
    name = f"{link.name}_joint" if link.axis else f"{link.name}_fixed"
    element = ElementTree.SubElement(parent, "joint", name=name, type="revolute" if link.axis else "fixed")
    ElementTree.SubElement(element, "parent", link=link.parent or BASE)
    ElementTree.SubElement(element, "child", link=link.name)
    ElementTree.SubElement(element, "origin", xyz=_text(*link.origin), rpy="0 0 0")
    if link.axis:
        i = robot.JOINT_NAMES.index(name)
        ElementTree.SubElement(element, "axis", xyz={"x": "1 0 0", "y": "0 1 0"}[link.axis])
        ElementTree.SubElement(
            element,
            "limit",
            lower=_text(robot.LOWER[i]),
            upper=_text(robot.UPPER[i]),
            effort=_text(robot.TORQUE_LIMIT[i]),
            velocity=_text(robot.VELOCITY_LIMIT[i]),
        )
        ElementTree.SubElement(
            element, "dynamics", damping=_text(robot.DAMPING[i]), friction=_text(robot.FRICTION[i])
        )


def generate_urdf() -> str:
    """Generate the URDF: root link `base_link` with the trunk; joints as in `robot.JOINT_NAMES`.

    Returns:
        URDF text.
    """
    model = load_model(Plant(plane=False))
    root = ElementTree.Element("robot", name="aliengo")
    ElementTree.SubElement(root, "link", name=BASE)
    for link in robot.LINKS:
        _add_link(root, link, model)
        _add_joint(root, link)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


if __name__ == "__main__":
    FILE.write_text(generate_urdf(), encoding="utf-8")

"""Files of a new robot's folder, from what was found in its MJCF or URDF.

    robot.yaml  numbers that the file states; the others are UNDECIDED, and `load_robot` names them
    robot.xml   MJCF in our names, order and signs, with simple shapes
    robot.urdf  the same links, generated from robot.xml

There is no actuator.yaml: without one, the actuators are a plain PD law.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.etree import ElementTree

import numpy as np
import yaml

from .arrays import Array
from .found_robot import FoundJoint, FoundRobot
from .inertia import Inertial
from .quadruped import JOINT_NAMES, KINDS, LEGS
from .robot import SCHEMA, UNDECIDED
from .urdf_generator import generate_urdf

STANCE_SHARE, LYING_SHARE = 0.75, 0.24
"""Hips above the feet, as a share of the leg's length; the AlienGo's: 0.8 and 0.22, the Go2's: 0.7 and 0.24."""
RANGE_MARGIN_RAD = 0.05
"""Least distance of a proposed calf angle from the end of its range."""
_HELD_GAP_M = 0.3  # feet above ground if the trunk is held in the air
_SHELL_SHARE = 0.08  # radius of thigh and calf shapes, as a share of their length
_ANGLE_DIGITS, _LENGTH_DIGITS = 4, 6

Element = ElementTree.Element


def robot_files(found: FoundRobot) -> dict[str, str]:
    """Make the files of a robot's folder.

    Args:
        found: The robot, without a fatal finding of `check_found_robot`.

    Returns:
        Texts by name of the file.
    """
    mjcf = _mjcf(found)
    limits = (
        np.nan_to_num([getattr(joint, field) for joint in found.joints]) for field in ("torque", "speed")
    )  # 0 in a URDF: not stated
    return {
        "robot.yaml": _numbers(found),
        "robot.xml": mjcf,
        "robot.urdf": generate_urdf(mjcf, robot_name(found), *limits),
    }


def robot_name(found: FoundRobot) -> str:
    """Make the name of a robot in files.

    Args:
        found: The robot.

    Returns:
        The name of its model, else of its file, without `_description`; letters, digits and
        underscores in lower case.
    """
    named = found.name if found.name not in ("", "MuJoCo Model") else found.path.stem
    return re.sub(r"\W+", "_", named.lower()).removesuffix("_description")


def proposed_posture(found: FoundRobot, share: float) -> Array | None:
    """Propose a posture with the feet below the thigh joints on level ground.

    Args:
        found: The robot.
        share: Hips above the feet, as a share of the leg's length; larger if the knees cannot bend
            so far, or if the trunk would touch the ground.

    Returns:
        Joint angles, (12,), rad; None if a calf can bend both ways, or a joint cannot reach the
        posture.
    """
    l1, l2 = _leg_lengths(found)
    lower, upper = (
        np.array([getattr(joint, end) for joint in found.joints]).reshape(len(LEGS), len(KINDS))
        for end in ("lower", "upper")
    )
    knees = (lower[:, 2] >= 0).astype(int) - (upper[:, 2] <= 0)
    if not knees.all():
        return None
    # Law of cosines: depth^2 = l1^2 + l2^2 + 2 l1 l2 cos(calf) for a foot below the thigh joint.
    most = np.minimum(np.where(knees > 0, upper[:, 2], -lower[:, 2]) - RANGE_MARGIN_RAD, np.pi)
    folded = np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(most))
    hips = found.anchors[:, 0, 2]  # above the trunk's origin, m
    belly = 0.0 if found.trunk_box is None else -float(found.trunk_box[0, 2])
    height = max(share * (l1 + l2), float((folded - hips).max()), belly - float(found.foot_radii[0]))
    depth = height + hips
    calf = knees * np.arccos(np.clip((depth**2 - l1**2 - l2**2) / (2 * l1 * l2), -1.0, 1.0))
    thigh = -np.arctan2(l2 * np.sin(calf), l1 + l2 * np.cos(calf))
    q = np.column_stack([np.zeros(len(LEGS)), thigh, calf]).round(_ANGLE_DIGITS)
    return None if ((q < lower) | (q > upper)).any() else q.ravel()


def _leg_lengths(found: FoundRobot) -> tuple[float, float]:
    """Return the lengths of thighs and calves, m, means of the legs."""
    thighs, calves = found.anchors[:, 1, 2], found.anchors[:, 2, 2]
    return float((thighs - calves).mean()), float((calves - found.feet[:, 2]).mean())


def _numbers(found: FoundRobot) -> str:
    """Return the text of robot.yaml."""
    name, joints = robot_name(found), found.joints
    title = yaml.safe_dump(name.replace("_", " ").title()).split("\n")[0]
    postures = {
        field: UNDECIDED if (q := proposed_posture(found, share)) is None else _per_joint(q)
        for field, share in (("nominal_q", STANCE_SHARE), ("lie_q", LYING_SHARE))
    }
    armature = [joint.armature or np.nan for joint in joints]  # 0: not stated
    held = round(sum(_leg_lengths(found)) + _HELD_GAP_M, 1)
    return f"""\
# {name}, from {found.path.name}. Replace each {UNDECIDED} by your numbers.
# A value for each joint: one number, three (hip, thigh, calf) or twelve in the order FR, FL, RR, RL.
#
# This folder is in our convention: x forward, y left, z up; hips turn about +x, thighs and calves about +y. The robot's
# own joints in this order, with their number in its file; angles, speeds and torques of those with - change their sign:
{_joint_comments(joints)}

schema: {SCHEMA}
name: {yaml.safe_dump(name).split(chr(10))[0]}
title: {title}

# Gains of a policy and of excitation motions (N m/rad, N m s/rad). AlienGo, 25 kg: 30, 0.5. Go2, 15 kg: 20, 0.5.
kp: {UNDECIDED}
kd: {UNDECIDED}

# Postures (rad), proposed: feet below the thigh joints. Height of the trunk held in the air (m).
nominal_q: {postures["nominal_q"]}
lie_q: {postures["lie_q"]}
suspended_height: {held}

# Limits of the drives: largest torque (N m), speed at which no torque is left (rad/s).
torque_limit: {_per_joint([joint.torque for joint in joints])}
velocity_limit: {_per_joint([joint.speed for joint in joints])}

# Joint targets that the drives accept (rad): command_lower and command_upper, if narrower than the mechanical range.

# Reflected rotor inertia (kg m^2): that of the rotor times the square of the gear ratio. Coulomb friction (N m) and
# viscous friction (N m s/rad): those of the file, 0 if it states none.
armature: {_per_joint(armature)}
joint_friction: {_per_joint([joint.friction for joint in joints])}
joint_damping: {_per_joint([joint.damping for joint in joints])}

# Radius of the foot spheres (m).
foot_radius: {_text([found.foot_radii.mean()])}
"""


def _joint_comments(joints: Iterable[FoundJoint]) -> str:
    """Return comment lines with name, number and sign of each joint in the file."""
    rows = [(joint, "-" if joint.sign < 0 else "+") for joint in joints]
    return "\n".join(f"#   {joint.name:15} {sign} {joint.number:3} {joint.source}" for joint, sign in rows)


def _per_joint(values: Iterable[float] | Array) -> str:
    """Return twelve numbers as YAML: one if all are equal, three if all legs are; UNDECIDED if one is NaN."""
    array = np.array([*values], float).round(_LENGTH_DIGITS)
    if not np.isfinite(array).all():
        return UNDECIDED
    legs = array.reshape(len(LEGS), len(KINDS))
    if (array == array[0]).all():
        return _text(array[:1])
    shown = array[: len(KINDS)] if (legs == legs[0]).all() else array
    return f"[{', '.join(_text([value]) for value in shown)}]"


def _text(values: Iterable[float] | Array) -> str:
    """Return numbers separated by blanks."""
    return " ".join(repr(round(float(value), _LENGTH_DIGITS) + 0.0) for value in values)


def _mjcf(found: FoundRobot) -> str:
    """Return the text of robot.xml: bodies of our names, joints in our convention, simple shapes."""
    root = Element("mujoco", model=robot_name(found))
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    trunk = ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "body", name="trunk")
    trunk.set("pos", _text([0, 0, sum(_leg_lengths(found))]))
    ElementTree.SubElement(trunk, "freejoint", name="root")
    _add_inertial(trunk, found.trunk)
    anchors = found.anchors
    low, high = np.sort(anchors[:, 0], axis=0)[[0, -1]] if found.trunk_box is None else found.trunk_box
    half = np.maximum(0.5 * (high - low), found.foot_radii[0])
    _add_geom(trunk, "box", half, 0.5 * (low + high), name="trunk")
    imu = np.zeros(3) if found.imu is None else found.imu
    ElementTree.SubElement(trunk, "site", name="imu", pos=_text(imu), size="0.01")
    lengths = _leg_lengths(found)
    for i, leg in enumerate(LEGS):
        lateral = anchors[i, 1, 1] - anchors[i, 0, 1]
        origins = anchors[i, 0], [0, lateral, 0], [0, 0, -lengths[0]], [0, 0, -lengths[1]]
        body = trunk
        for k, kind in enumerate(KINDS):
            joint = found.joints[JOINT_NAMES.index(f"{leg}_{kind}_joint")]
            body = _add_link(body, f"{leg}_{kind}", origins[k], joint)
            if kind != "hip":
                length = lengths[KINDS.index(kind) - 1]
                _add_geom(body, "cylinder", [_SHELL_SHARE * length, 0.4 * length], [0, 0, -0.5 * length])
        foot = ElementTree.SubElement(body, "body", name=f"{leg}_foot", pos=_text(origins[-1]))
        _add_geom(foot, "sphere", [found.foot_radii.mean()], [0, 0, 0], name=f"{leg}_foot", mass="0")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_link(parent: Element, name: str, origin: Iterable[float], joint: FoundJoint) -> Element:
    """Add a link with its joint."""
    body = ElementTree.SubElement(parent, "body", name=name, pos=_text(origin))
    _add_inertial(body, joint.inertial)
    axis = "1 0 0" if name.endswith("hip") else "0 1 0"
    limits = _text([joint.lower, joint.upper])
    ElementTree.SubElement(body, "joint", name=joint.name, axis=axis, range=limits)
    return body


def _add_inertial(body: Element, inertial: Inertial) -> None:
    """Add the inertia of a body; it keeps all digits, because small inertias have few."""
    full = " ".join(repr(float(value)) for value in inertial.fullinertia())
    ElementTree.SubElement(
        body, "inertial", mass=repr(inertial.mass), pos=_text(inertial.com), fullinertia=full
    )


def _add_geom(
    body: Element, kind: str, size: Iterable[float], place: Iterable[float], **attributes: str
) -> None:
    """Add a shape."""
    ElementTree.SubElement(
        body, "geom", attributes | {"type": kind, "size": _text(size), "pos": _text(place)}
    )

"""Links and joints of a robot from its URDF file, in SI units.

It does not need MuJoCo, so that it runs on a robot's computer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .quadruped import JOINT_NAMES

ROOT = "base_link"
"""Name of the root link. It is not read; the trunk, its child, has no parent."""

_AXES: dict[tuple[float, ...], str] = {(1.0, 0.0, 0.0): "x", (0.0, 1.0, 0.0): "y"}
_ZERO = (0.0, 0.0, 0.0)


def read_links(path: Path) -> list[dict[str, Any]]:
    """Read the links below the root link, in the order of their joints in the file, parents first.

    Args:
        path: URDF file.

    Returns:
        Fields of `robot.Link`, one mapping for each link: origins in m, ranges in rad, masses in
        kg, inertia tensors in kg m^2 about the centre of mass in the axes of the link.

    Raises:
        ValueError: The file is no URDF of a quadruped with twelve joints; the message names file,
            element, value found and expectation.
        FileNotFoundError: There is no such file.
    """
    try:
        tree = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: found no XML ({error}), expected a URDF") from None
    elements = {link.get("name"): link for link in tree.iter("link")}
    links = []
    for joint in tree.iterfind("joint"):
        child = joint.find("child")
        name = "" if child is None else child.get("link", "")
        if name not in elements:
            raise ValueError(f"{path}: joint {joint.get('name')}: found child {name!r}, expected a link")
        links.append(
            {"name": name, **_read_joint(joint, path), "inertial": _read_inertial(elements[name], path)}
        )
    moving = [link["joint"] for link in links if link["joint"]]
    if sorted(moving) != sorted(JOINT_NAMES):
        strange = sorted(set(moving) ^ set(JOINT_NAMES))
        raise ValueError(
            f"{path}: joints that move: found {', '.join(strange)} missing or too many, "
            f"expected {', '.join(JOINT_NAMES)}"
        )
    return _parents_first(links, path)


def _parents_first(links: list[dict[str, Any]], path: Path) -> list[dict[str, Any]]:
    """Move links behind their parents; a file may state its joints in any order."""
    names = [link["name"] for link in links]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path}: link {name}: found {names.count(name)} joints above it, expected one")
    placed: dict[str, dict[str, Any]] = {}
    while len(placed) < len(links):
        before = len(placed)
        for link in links:
            if link["parent"] is None or link["parent"] in placed:
                placed.setdefault(link["name"], link)
        if len(placed) == before:
            lost = next(link for link in links if link["name"] not in placed)
            raise ValueError(
                f"{path}: link {lost['name']}: found parent {lost['parent']!r}, "
                f"expected a chain of links from {ROOT}"
            )
    return list(placed.values())


def _numbers(element: ElementTree.Element | None, name: str, size: int = 3) -> tuple[float, ...]:
    """Read an attribute of numbers; zeros if element or attribute is missing."""
    text = "" if element is None else element.get(name, "")
    return tuple(float(part) for part in text.split()) or (0.0,) * size


def _read_joint(joint: ElementTree.Element, path: Path) -> dict[str, Any]:
    """Read parent, axis, origin and range of a joint."""
    where, origin = f"{path}: joint {joint.get('name')}", joint.find("origin")
    parent, axis = joint.find("parent"), _numbers(joint.find("axis"), "xyz")
    moves = joint.get("type") != "fixed"
    if parent is None:
        raise ValueError(f"{where}: found no parent, expected one")
    if _numbers(origin, "rpy") != _ZERO:
        raise ValueError(
            f"{where}: rpy: found {_numbers(origin, 'rpy')}, expected zeros: frames are parallel"
        )
    if moves and axis not in _AXES:
        raise ValueError(f"{where}: axis: found {axis}, expected 1 0 0 (hip) or 0 1 0 (thigh, calf)")
    limit = joint.find("limit")
    if moves and limit is None:
        raise ValueError(f"{where}: found no limit, expected lower and upper")
    name = parent.get("link")
    return {
        "parent": None if name == ROOT else name,
        "joint": joint.get("name") if moves else None,
        "axis": _AXES[axis] if moves else None,
        "origin": _numbers(origin, "xyz"),
        "lower": _numbers(limit, "lower", 1)[0],
        "upper": _numbers(limit, "upper", 1)[0],
    }


def _read_inertial(link: ElementTree.Element, path: Path) -> dict[str, Any]:
    """Read the inertia of a link."""
    where, inertial = f"{path}: link {link.get('name')}", link.find("inertial")
    if inertial is None:  # a link without mass, such as the frame of a sensor
        return {"mass": 0.0, "com": _ZERO, "tensor": np.zeros((3, 3))}
    if _numbers(inertial.find("origin"), "rpy") != _ZERO:
        raise ValueError(f"{where}: inertial: found rpy, expected the inertia in axes of the link")
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    ixx, iyy, izz, ixy, ixz, iyz = (_numbers(inertial.find("inertia"), name, 1)[0] for name in names)
    return {
        "mass": _numbers(inertial.find("mass"), "value", 1)[0],
        "com": _numbers(inertial.find("origin"), "xyz"),
        "tensor": [[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]],
    }

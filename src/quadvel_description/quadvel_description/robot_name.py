"""Names of robots in files: a policy, an estimator, an actuator model or a recording belongs to one robot."""

from __future__ import annotations

import re
from pathlib import Path

DEFAULT_ROBOT = "aliengo"
"""Robot of commands, nodes and recipes that name none."""
UNNAMED_ROBOT = "aliengo"
"""Robot of a file without a name; such files are older than the names."""
ROBOTS = Path(__file__).parent / "robots"
"""Folder of the folders of the shipped robots."""


def shipped_robots() -> tuple[str, ...]:
    """List the robots that ship with the package.

    Returns:
        Their names.
    """
    return tuple(sorted(file.parent.name for file in ROBOTS.glob("*/robot.yaml")))


def shipped_file(folder: Path, robot: str, name: str, kind: str, remedy: str) -> Path:
    """Find a file that is shipped for a robot: in the subfolder of its name.

    Those of UNNAMED_ROBOT are in the folder itself.

    Args:
        folder: Folder of the files of all robots.
        robot: Name of the robot.
        name: Name of the file.
        kind: What the file holds, for the error.
        remedy: What to do without it, for the error.

    Returns:
        The file.

    Raises:
        FileNotFoundError: There is none for this robot.
    """
    path = folder / name if robot == UNNAMED_ROBOT else folder / robot / name
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} is shipped for the robot {robot!r}: {remedy}")
    return path


def described_robot(urdf: str) -> str | None:
    """Read the name of the robot in a URDF, such as on the topic `robot_description`.

    Args:
        urdf: The XML.

    Returns:
        The name, or None if there is none.
    """
    found = re.search(r"""<robot\b[^>]*\bname\s*=\s*["']([^"']+)""", urdf)
    return found[1] if found else None

"""What a package imports of the others, and of ROS 2, its package.xml asks for: so it can be built and run by itself."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

SRC = Path(__file__).parents[2] / "src"
PACKAGES = sorted(file.parent.name for file in SRC.glob("*/package.xml"))
OF_ROS = ("_msgs", "_srvs", "_interfaces")
EMBEDDED = "quadvel_dds"
"""Takes the place of ROS 2: what it imports of it is its own."""


def imported(package: str) -> Iterator[str]:
    """The first names of all modules that the package's sources import."""
    for file in (SRC / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                yield from (one.name.partition(".")[0] for one in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                yield node.module.partition(".")[0]


@pytest.mark.parametrize("package", [one for one in PACKAGES if one != EMBEDDED])
def test_a_package_asks_for_the_packages_that_it_imports(package: str) -> None:
    root = ElementTree.parse(SRC / package / "package.xml").getroot()
    asked = {one.text for kind in ("depend", "exec_depend") for one in root.iter(kind)}
    used = {
        name
        for name in imported(package)
        if name in PACKAGES or name in ("rclpy", "launch", "launch_ros") or name.endswith(OF_ROS)
    }
    assert used - {package} - asked == set()

"""The folders of the design, and the entry points that the documents name."""

from __future__ import annotations

import re
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = (
    "docker",
    "ros_ws",
    "src/quadvel_estimator",
    "src/quadvel_msgs",
    "src/quadvel_policy",
    "src/quadvel_sim",
    "tests",
    "training",
)
TEXTS = [
    path
    for pattern in ("*.md", "docs/**/*.md", "src/**/*.md", "src/**/*.py", "ros_ws/*.md", "ros_ws/**/*.xml")
    for path in sorted(ROOT.glob(pattern))
    if path.name != "CHANGELOG.md" and not path.is_relative_to(ROOT / "ros_ws" / "src")
]


def documented(command: str) -> set[tuple[str, str]]:
    """Package and argument of each `ros2 run` or `ros2 launch` with a package of ours."""
    texts = "\n".join(path.read_text(encoding="utf-8") for path in TEXTS)
    return set(re.findall(rf"ros2 {command} (quadvel_\w+)\s+([\w.]+)", texts))


def entry_points(package: str) -> set[str]:
    """The programs that a package installs."""
    config = ConfigParser()
    config.read(ROOT / "src" / package / "setup.cfg")
    lines = config.get("options.entry_points", "console_scripts", fallback="").split("\n")
    return {line.partition("=")[0].strip() for line in lines if line}


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_folders_of_the_design_are_there(folder: str) -> None:
    assert any((ROOT / folder).iterdir())


def test_programs_that_documents_run_are_declared() -> None:
    programs = documented("run")
    assert ("quadvel_policy", "controller") in programs
    assert {(package, name) for package, name in programs if name not in entry_points(package)} == set()


def test_launch_files_that_documents_name_are_there() -> None:
    files = documented("launch")
    assert ("quadvel_bringup", "robot.launch.py") in files
    assert all((ROOT / "src" / package / "launch" / name).is_file() for package, name in files)

"""Tests of the choice of rclpy for a process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os, subprocess, sys
import quadvel_dds
embedded = quadvel_dds.install()
import rclpy
print(embedded, rclpy.__file__)
"""


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A folder with an rclpy that is not ours, and no interfaces of quadvel."""
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").touch()
    return tmp_path


def run(program: str, folder: Path, **changes: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(folder), *sys.path])
    without = {name: value for name, value in os.environ.items() if name != "QUADVEL_MIDDLEWARE"}
    environment = {**without, "PYTHONPATH": path, **changes}
    return subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60
    )


def test_an_rclpy_without_our_interfaces_is_left_aside_with_a_sentence_said_once(foreign: Path) -> None:
    done = run(f"{PROGRAM}\nsubprocess.run([sys.executable, '-c', {PROGRAM!r}])", foreign)
    assert done.stdout.count("True") == 2
    assert str(foreign) not in done.stdout
    assert done.stderr.count("ROS 2's rclpy is here, but not quadvel_msgs") == 1
    assert len(done.stderr.splitlines()) == 1


def test_a_mere_folder_named_like_our_interfaces_is_not_taken_for_them(foreign: Path) -> None:
    (foreign / "quadvel_msgs" / "msg").mkdir(parents=True)
    assert run(PROGRAM, foreign).stdout.startswith("True")


def test_an_rclpy_with_our_interfaces_is_used(foreign: Path) -> None:
    (foreign / "quadvel_msgs").mkdir()
    (foreign / "quadvel_msgs" / "__init__.py").touch()
    done = run(PROGRAM, foreign)
    assert done.stdout == f"False {foreign / 'rclpy' / '__init__.py'}\n"
    assert not done.stderr


def test_who_asks_for_the_embedded_one_gets_it_without_a_word(foreign: Path) -> None:
    done = run(PROGRAM, foreign, QUADVEL_MIDDLEWARE="embedded")
    assert done.stdout.startswith("True")
    assert not done.stderr


def test_the_doctor_says_that_an_rclpy_is_left_aside_and_why(foreign: Path) -> None:
    program = "from quadvel_bringup import doctor\nprint(next(f.text for f in doctor.examine() if f.subject == 'ROS 2'))"
    assert run(program, foreign).stdout.startswith("ROS 2's rclpy is here, but not quadvel_msgs")

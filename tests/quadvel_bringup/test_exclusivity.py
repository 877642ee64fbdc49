"""Which processes of this machine are robots, by their command lines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from quadvel_bringup.exclusivity import RobotAlreadyRunningError, refuse_beside_a_robot, running_robots

SLEEP = "import time; print(flush=True); time.sleep(60.0)"


def robot_name(line: list[str]) -> str | None:
    """The name of the robot that a process with this command line is, or None."""
    with subprocess.Popen(line, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout
            assert process.stdout.readline()
            return running_robots().get(process.pid, (None,))[0]
        finally:
            process.terminate()


@pytest.mark.parametrize(
    ("program", "arguments", "name"),
    [
        ("quadvel", ["run", "board", "--ros-args"], "board"),
        ("lib/quadvel_driver/driver", ["--ros-args"], "driver"),
        ("quadvel", ["run", "driver", "--ros-args", "-p", "dry_run:=true"], None),
        ("quadvel", ["up", "--low-level", "board"], None),
        ("quadvel", ["run", "controller", "board"], None),
        ("backup", ["board", "driver"], None),
    ],
)
def test_a_robot_is_known_by_its_program_and_not_by_an_option(
    program: str, arguments: list[str], name: str | None, tmp_path: Path
) -> None:
    script = tmp_path / program
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(SLEEP)
    assert robot_name([sys.executable, "-S", str(script), *arguments]) == name


def test_a_node_of_quadvel_up_is_known_by_its_module(tmp_path: Path) -> None:
    (tmp_path / "quadvel_bringup").mkdir()
    (tmp_path / "quadvel_bringup/nodes.py").write_text(SLEEP)
    line = ["env", f"PYTHONPATH={tmp_path}", sys.executable, "-m", "quadvel_bringup.nodes", "driver"]
    assert robot_name(line) == "driver"


def test_a_command_that_only_starts_a_robot_is_none() -> None:
    assert robot_name(["timeout", "60", sys.executable, "-c", SLEEP, "run", "board"]) is None


def test_a_simulator_refuses_to_start_beside_a_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "97")
    refuse_beside_a_robot()
    script = tmp_path / "sim_node"
    script.write_text(SLEEP)
    with subprocess.Popen([sys.executable, "-S", str(script)], stdout=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stdout.readline()
        with pytest.raises(RobotAlreadyRunningError, match=rf"sim_node \(pid {process.pid}"):
            refuse_beside_a_robot()
        process.terminate()

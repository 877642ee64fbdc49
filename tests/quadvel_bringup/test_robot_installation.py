"""A fresh environment with the extra `robot` alone runs the nodes of a robot, and refuses the rest by sentences.

pip installs from its index. The board is simulated by the environment of the tests.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from .test_packages import HEAVY

ROOT = Path(__file__).parents[2]
SOURCES = ("LICENSE", "README.md", "pyproject.toml", "setup.py", "src", "training")
NODES = ("driver", "estimator", "controller", "command_mux")
PORT = 8007 + int(os.environ["ROS_DOMAIN_ID"])
PARAMETERS = f"driver: {{ros__parameters: {{board_address: 127.0.0.1, board_port: {PORT}, local_port: 0}}}}\n"


def pip(python: Path, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    words = [python, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    assert not check or found.returncode == 0, found.stderr
    return found


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs of the fresh environment."""
    folder = tmp_path_factory.mktemp("robot")
    programs = folder / "venv" / "bin"
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    constraint = ["--constraint", str(ROOT / "requirements.lock")]
    wanted = ["attrs", "--no-deps", "--dest", str(folder / "probe"), *constraint]
    if (probe := pip(programs / "python", "download", *wanted, check=False)).returncode:
        pytest.skip(f"pip finds no index here: {(probe.stderr.splitlines() or [''])[-1]}")
    copy = folder / "quadvel"  # pip builds in the folder of the sources
    copy.mkdir()
    for name in SOURCES:
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, copy / name)
    pip(programs / "python", "install", "--no-compile", *constraint, f"{copy}[robot]")
    return programs


@pytest.fixture
def robot_is_up(robot: Path, tmp_path: Path) -> Iterator[Path]:
    """The log of `quadvel up`, which runs in the fresh environment, with a board that runs in this one."""
    (tmp_path / "params.yaml").write_text(PARAMETERS)
    board = [sys.executable, "-m", "quadvel_bringup", "run", "board", "--ros-args", "-p", f"port:={PORT}"]
    up = [robot / "quadvel", "up", "--low-level", "driver", "--params", tmp_path / "params.yaml"]
    log = tmp_path / "log"
    with log.open("w") as output:
        processes = [subprocess.Popen(words, stdout=output, stderr=output) for words in (board, up)]
        yield log
        for process in reversed(processes):
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) == 0, log.read_text()


def test_nodes_of_the_robot_run(robot: Path, robot_is_up: Path) -> None:
    until = time.monotonic() + 60.0
    text = ""
    while not (all(f"{name} " in text for name in NODES) and re.search(r"low_state [1-9]", text)):
        assert time.monotonic() < until, f"{text}\n{robot_is_up.read_text()}"
        text = subprocess.run([robot / "quadvel", "status"], capture_output=True, text=True).stdout
    assert "passive: waiting for a mode request" in text


def test_nothing_heavy_is_installed(robot: Path) -> None:
    lines = pip(robot / "python", "list", "--format=freeze").stdout.splitlines()
    assert {line.partition("==")[0] for line in lines} & HEAVY == set()


@pytest.mark.parametrize(
    ("command", "extra"),
    [("up", "sim"), ("demo", "eval"), ("identify log.npz", "identify"), ("record", "log"), ("view", "view")],
)
def test_what_is_not_installed_says_how_to_install_it(robot: Path, command: str, extra: str) -> None:
    found = subprocess.run([robot / "quadvel", *command.split()], capture_output=True, text=True)
    assert found.returncode == 2
    assert found.stderr.count("\n") == 1
    assert f"pip install 'quadvel-core[{extra}]'" in found.stderr

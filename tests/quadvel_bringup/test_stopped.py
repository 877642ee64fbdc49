"""Ctrl-C while a long command works: one sentence, exit code 130, and no trace of what was begun."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

LONG = {
    "demo": ["--lockstep", "--no-video"],
    "demo follow": ["--seconds", "60", "--world", "corridor"],
    "excite": ["creep", "--seconds", "600"],
    "twin": ["dry_gears"],
    "eval": ["--grid", "quick"],
    "faults": ["--seeds", "2"],
    "paper": ["--only", "tracking", "--seeds", "1"],
    "people": [],
    "following": [],
    "bench": [],
}
USUAL = ("excite",)
"""Those that are run always; the others, which end in the same way, by hand"""


STOPPED = (128 + signal.SIGINT, -signal.SIGINT)
"""A shell reports both as 130. Python 3.11 ends itself by the signal where it came while `exec` ran a string, as in imports."""
TOUR = "demo follow --tour"


def start(command: str, folder: Path) -> subprocess.Popen[str]:
    """In a terminal's way: the command and all that it starts are one group, which Ctrl-C reaches."""
    line = [sys.executable, "-m", "quadvel_bringup", *command.split(), *LONG.get(command, [])]
    return subprocess.Popen(
        line, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


@pytest.mark.parametrize(
    "command", [one if one in USUAL else pytest.param(one, marks=pytest.mark.long) for one in LONG]
)
def test_ctrl_c_is_answered_and_leaves_nothing(command: str, tmp_path: Path) -> None:
    process = start(command, tmp_path)
    time.sleep(8.0)
    assert process.poll() is None, process.stdout and process.stdout.read()
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=90)
    assert process.returncode in STOPPED, said
    assert "Traceback" not in said
    assert said.count("quadvel: stopped") == 1, said
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == []


def test_a_tour_that_is_stopped_keeps_what_there_is_of_it(tmp_path: Path) -> None:
    process = start(TOUR, tmp_path)
    assert process.stdout is not None
    for line in process.stdout:
        if " m: " in line:  # it walks
            break
    time.sleep(1.0)
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=90)
    assert process.returncode in STOPPED, said
    assert json.loads((tmp_path / "out/tour/tour.json").read_text())["walked"] >= 0.0
    assert sorted(path.name for path in (tmp_path / "out/tour").iterdir()) == ["tour.json", "tour.png"]

"""`quadvel up` with small programs in the place of the nodes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from quadvel_bringup import stack, up
from quadvel_bringup.exclusivity import RobotAlreadyRunningError
from quadvel_bringup.stack import Stack
from quadvel_lab.scripted_walk import ScriptedWalk

NODE = """
import signal, time
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.2)  # as a node that needs a moment to end
    print("clean", flush=True)
"""


def use_programs(monkeypatch: pytest.MonkeyPatch, program: Callable[[str], str]) -> None:
    def command(name: str, arguments: Sequence[str]) -> list[str]:
        return [sys.executable, "-S", "-c", program(name)]

    monkeypatch.setattr(stack, "process_command", command)


def interrupt_when_ready(monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    """Send Ctrl-C, `times` times, once all four programs said that they are ready."""
    ready = []

    class Output(up.PrefixedOutput):
        def __call__(self, name: str, line: str) -> None:
            super().__call__(name, line)
            if line == "ready":
                ready.append(name)
            if len(ready) == 4:
                ready.clear()
                threading.Thread(target=press).start()

    def press() -> None:
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.005)

    monkeypatch.setattr(up, "PrefixedOutput", Output)


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_lets_every_node_end_by_itself(
    times: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    use_programs(monkeypatch, lambda name: NODE)
    interrupt_when_ready(monkeypatch, times)
    assert up.up(Stack()) == 0
    output = capfd.readouterr().out
    assert "   sim_node | clean\n" in output
    assert output.count("| clean\n") == 4


def test_when_a_node_dies_the_others_are_stopped_and_its_exit_code_is_returned(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    use_programs(monkeypatch, lambda name: "raise SystemExit(3)" if name == "controller" else NODE)
    assert up.up(Stack()) == 3
    assert "controller ended with exit code 3; stopping the others" in capfd.readouterr().out


def test_that_the_page_died_is_said_at_once_and_the_robot_goes_on(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    use_programs(monkeypatch, lambda name: "raise SystemExit(3)" if name == "view" else NODE)
    said: list[str] = []

    class Output(up.PrefixedOutput):
        def __call__(self, name: str, line: str) -> None:
            super().__call__(name, line)
            said.append(line)
            if "ended with exit code 3" in line:
                os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(up, "PrefixedOutput", Output)
    assert up.up(Stack(), view=True) == 1
    death = next(number for number, line in enumerate(said) if "ended with exit code 3" in line)
    assert "clean" not in said[:death]
    assert sum("exit code 3" in line for line in said) == 1


def test_a_demo_says_at_once_that_its_page_died(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The planner ends after the page, and in good order."""
    page = [sys.executable, "-S", "-c", "raise SystemExit(3)"]
    planner = [sys.executable, "-S", "-c", "import time; time.sleep(3)"]
    walk = ScriptedWalk(tmp_path / "demo.mcap", "quick", {"view": page}, False, Console(soft_wrap=True))
    walk._nodes = {"view": page, "planner": planner}
    assert walk.run() == ""
    assert "view | ended with exit code 3" in capfd.readouterr().out


def test_a_node_that_ends_by_itself_is_a_fault_even_with_exit_code_0(monkeypatch: pytest.MonkeyPatch) -> None:
    use_programs(monkeypatch, lambda name: "pass" if name == "sim_node" else NODE)
    assert up.up(Stack()) == 1


def test_of_two_that_start_at_the_same_instant_one_runs(tmp_path: Path) -> None:
    def start(name: str) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "quadvel_bringup", "up", "--policy", "none"]
        return subprocess.Popen(line, stdout=(tmp_path / name).open("wb"), stderr=subprocess.STDOUT)

    both = [start("first"), start("second")]
    try:
        until = time.monotonic() + 60.0
        while time.monotonic() < until and all(one.poll() is None for one in both):
            time.sleep(0.1)
        (refused,) = (index for index, one in enumerate(both) if one.poll() is not None)
        assert both[refused].returncode == 2
        survivor = both.pop(1 - refused)
        sentence = (tmp_path / ("first", "second")[refused]).read_text()
        assert f"pid {survivor.pid}" in sentence
        assert "Traceback" not in sentence
        both = [survivor]
        output = tmp_path / ("first", "second")[1 - refused]
        while time.monotonic() < until and "stood up" not in output.read_text():
            time.sleep(0.1)
        assert "stood up" in output.read_text()
        assert "publishers" not in output.read_text()
    finally:
        for one in both:
            one.send_signal(signal.SIGINT)
        assert [one.wait(30.0) for one in both] == [0] * len(both)


def test_beside_another_simulator_it_does_not_start(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    use_programs(monkeypatch, lambda name: "raise SystemExit(3)")
    program = [
        sys.executable,
        "-m",
        "quadvel_bringup",
        "run",
        "sim_node",
        "--ros-args",
        "-p",
        "mode:=lockstep",
    ]
    other = subprocess.Popen(program)
    try:
        until = time.monotonic() + 30.0
        while time.monotonic() < until:
            with suppress(RobotAlreadyRunningError), up.only_robot():
                continue
            break
        named = f"low_state: already published on ROS domain .* by sim_node \\(pid {other.pid}\\)"
        with pytest.raises(RobotAlreadyRunningError, match=named):
            up.up(Stack())
    finally:
        other.send_signal(signal.SIGINT)
        assert other.wait(20.0) == 0
    assert "starting" not in capfd.readouterr().out

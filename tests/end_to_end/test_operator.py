"""An operator and a simulated robot: `quadvel up` and the commands that talk to it, all as processes over DDS.

The tests share one robot; each begins with one that stands.
"""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.standing import wait_until_ready

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")


def quadvel(*arguments: str) -> tuple[int, str]:
    """Exit code and all that the command wrote."""
    done = subprocess.run([*QUADVEL, *arguments], capture_output=True, text=True, timeout=180)
    return done.returncode, done.stdout + done.stderr


class Robot:
    """`quadvel up`, what it wrote, and its nodes."""

    def __init__(self, log: Path, *options: str) -> None:
        self._log = log
        with log.open("a") as file:
            self._process = subprocess.Popen(
                [*QUADVEL, "up", *options], stdout=file, stderr=subprocess.STDOUT, start_new_session=True
            )

    def says(self, text: str, seconds: float = 180.0) -> None:
        """Wait until `up` has shown a line with this text."""
        until = time.monotonic() + seconds
        while text not in self._log.read_text():
            assert self._process.poll() is None, self._log.read_text()
            assert time.monotonic() < until, f"{text!r} is not in:\n{self._log.read_text()}"
            time.sleep(0.05)

    def is_running(self) -> bool:
        return self._process.poll() is None

    def log(self) -> str:
        """Everything it reported since `forget`."""
        return self._log.read_text()

    def forget(self) -> None:
        """What it says from now on is what `says` looks at."""
        with self._log.open("r+") as file:
            file.truncate(0)

    def node(self, name: str) -> int:
        """The process of a node."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        for child in map(int, children.split()):
            if f"\0{name}\0" in Path(f"/proc/{child}/cmdline").read_text():
                return child
        raise AssertionError(f"no process of {name}")

    def stand_up(self) -> None:
        for words in (("reset",), ("mode", "passive"), ("mode", "stand_up")):
            code, text = quadvel(*words)
            assert code == 0, text

    def end(self) -> int:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        return self._process.wait(60.0)


class Shown:
    """What a program has written to its terminal."""

    def __init__(self, terminal: int) -> None:
        self._terminal, self._text = terminal, ""

    def now(self) -> str:
        """All of it up to now."""
        while select.select([self._terminal], [], [], 0.0)[0]:
            self._text += os.read(self._terminal, 4096).decode(errors="replace")
        return self._text

    def until(self, text: str, since: str = "") -> None:
        """Wait for it to come, behind the last place of `since`."""
        until = time.monotonic() + 60.0
        while text not in self.now().rpartition(since)[2] if since else text not in self.now():
            assert time.monotonic() < until, f"{text!r} is not in:\n{self._text[-2000:]}"
            time.sleep(0.05)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    robot = Robot(tmp_path_factory.mktemp("up") / "up.log")
    try:
        wait_until_ready(robot.log, robot.is_running)
        yield robot
    finally:
        code = robot.end()
    assert code == 0


def test_drive_says_what_was_commanded_and_what_was_measured(up: Robot) -> None:
    code, text = quadvel("drive", "--vx", "0.4", "--seconds", "4")
    assert code == 0, text
    assert "commanded  vx +0.40 m/s, vy +0.00 m/s, wz +0.00 rad/s" in text
    measured = re.search(r"measured   vx ([+-][\d.]+) m/s, vy ([+-][\d.]+) m/s", text)
    assert measured, text
    assert float(measured[1]) == pytest.approx(0.4, abs=0.1)
    assert float(measured[2]) == pytest.approx(0.0, abs=0.1)
    up.says("follows teleop")
    up.says("walk: a velocity was commanded")


@pytest.mark.realtime
def test_teleop_walks_while_a_key_repeats_and_its_space_bar_stops_for_good(up: Robot) -> None:
    terminal, other = pty.openpty()
    teleop = subprocess.Popen([*QUADVEL, "teleop"], stdin=other, stdout=other, stderr=other)
    os.close(other)
    shown = Shown(terminal)
    shown.until("speed 0.5 m/s")
    while "walk " not in shown.now():
        os.write(terminal, b"w")
        time.sleep(0.05)
    shown.until("vx +0.00 m/s, vy +0.00 m/s", since="walk ")
    os.write(terminal, b" ")
    shown.until("STOPPED")
    shown.until("passive")
    os.write(terminal, b"w")
    teleop.send_signal(signal.SIGINT)
    assert teleop.wait(30.0) == 0
    os.close(terminal)
    up.says("passive: requested")
    up.stand_up()


def test_teleop_without_a_terminal_says_so(up: Robot) -> None:
    done = subprocess.run(
        [*QUADVEL, "teleop"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60
    )
    assert done.returncode != 0
    assert "standard input is not a terminal" in done.stdout + done.stderr


def test_drive_says_when_a_command_is_cut(up: Robot) -> None:
    code, text = quadvel("drive", "--wz", "20", "--seconds", "1")
    assert code == 0, text
    assert "commanded  vx +0.00 m/s, vy +0.00 m/s, wz +20.00 rad/s" in text
    assert "in effect" in text


def test_two_that_drive_at_once_are_told_so(up: Robot) -> None:
    with subprocess.Popen(
        [*QUADVEL, "drive", "--vx", "-0.3", "--seconds", "5"], stdout=subprocess.PIPE, text=True
    ) as other:
        code, text = quadvel("drive", "--vx", "0.3", "--seconds", "4")
        other_text = other.communicate(timeout=60)[0]
    for ended, said in ((code, text), (other.returncode, other_text)):
        assert ended == 1, said
        assert "not followed: another program that publishes cmd_vel_teleop, too, commands the robot" in said


def test_drive_refuses_what_is_no_number() -> None:
    code, text = quadvel("drive", "--vx", "nan")
    assert (code, text.strip()) == (2, "quadvel: --vx is nan, expected a finite number")


def test_drive_says_that_nobody_listens(up: Robot) -> None:
    code, text = quadvel("drive", "--vx", "0.2", "--topic", "cmd_vel_of_nobody")
    assert code == 2
    assert text.startswith(
        "quadvel: cmd_vel_of_nobody: no subscriber for velocities, which are taken on /cmd_vel,"
    )


def test_status_shows_nodes_mode_rates_and_files_on_one_page(up: Robot) -> None:
    code, text = quadvel("status")
    assert code == 0, text
    for expected in ("sim_node", "estimator", "controller", "command_mux", "walking       ready"):
        assert expected in text
    assert "actuator      the robot's own" in text
    assert re.search(r"rates +low_state \d+, velocity_estimate \d+, ", text), text
    assert "battery" in text
    assert "temperatures" in text
    assert "FR_calf" not in text
    code, text = quadvel("status", "--joints")
    assert code == 0, text
    assert re.search(r"FR_calf +-1\.\d+ rad, +-?0\.\d+ rad/s, +\d+\.\d+ N m", text), text
    assert re.search(r"imu +roll -?\d\.\d, pitch -?\d\.\d degrees", text), text


def test_the_doctor_says_which_actuator_model_runs(up: Robot) -> None:
    code, text = quadvel("doctor")
    assert code == 0, text
    assert (
        "running: command_mux, controller, estimator, sim_node; robot aliengo, policy the shipped one" in text
    ), text
    assert "actuator the robot's own" in text


def test_a_fault_is_told_everywhere_and_there_is_a_way_out_of_it(up: Robot) -> None:
    assert quadvel("push", "--fy", "1500", "--seconds", "0.4")[0] == 0
    up.says("controller | fault: ")
    code, text = quadvel("drive", "--vx", "0.3")
    assert code == 1
    assert "not followed: the robot is in fault: " in text
    assert "quadvel mode passive, then quadvel mode stand_up" in text
    code, text = quadvel("status")
    assert code == 1
    assert "recovery      once the cause is gone" in text
    code, text = quadvel("mode", "stand_up")
    assert code == 1
    assert "request passive first" in text
    up.stand_up()
    assert quadvel("drive", "--vx", "0.3", "--seconds", "2")[0] == 0


def test_a_walking_robot_is_reset_through_passive_and_its_odometry_starts_again(up: Robot) -> None:
    up.forget()
    with subprocess.Popen(
        [*QUADVEL, "drive", "--vx", "0.6", "--seconds", "600"], stdout=subprocess.PIPE
    ) as driving:
        up.says("walk: a velocity was commanded")
        up.forget()
        assert quadvel("reset") == (0, "the robot is back in posture lie\n")
        up.says("passive: requested")
        up.says("odometry starts at zero")
        assert driving.wait(180.0) == 1  # it was not followed to the end
    code, text = quadvel("mode", "stand_up")
    assert code == 0, text
    assert "fault" not in up.log()
    _, text = quadvel("status")
    place = re.search(r"position +x (-?[\d.]+), y (-?[\d.]+)", text)
    assert place, text
    assert float(place[1]) == pytest.approx(0.0, abs=0.1)


def test_the_simulator_is_paused_and_stepped(up: Robot) -> None:
    assert quadvel("pause") == (0, "paused\n")
    assert quadvel("step", "20") == (0, "advances by 20 ms\n")
    code, text = quadvel("drive", "--vx", "0.3")
    assert code == 1
    assert "is the simulator paused?" in text
    assert quadvel("pause", "--off") == (0, "running\n")
    code, text = quadvel("drive", "--vx", "0.3", "--seconds", "2")
    assert code == 0, text  # the pause was no fault
    code, text = quadvel("step")
    assert code == 1
    assert "pause it first" in text


def test_lying_down_ends_passive(up: Robot) -> None:
    code, text = quadvel("mode", "lie_down")
    assert code == 0, text
    assert "passive: lies" in text
    code, text = quadvel("drive", "--vx", "0.3")
    assert code == 1
    assert "the robot is in mode passive" in text
    assert quadvel("mode", "stand_up")[0] == 0


@pytest.mark.parametrize(
    "starved",
    [
        "controller",
        *(pytest.param(node, marks=pytest.mark.long) for node in ("sim_node", "estimator", "command_mux")),
    ],
)
def test_a_walking_robot_waits_for_a_node_that_gets_no_time(up: Robot, starved: str) -> None:
    """On a loaded machine a process may stand still for a while; a simulated robot must not fall for that."""
    up.forget()
    driving = subprocess.Popen(
        [*QUADVEL, "drive", "--vx", "0.5", "--seconds", "6"], stdout=subprocess.PIPE, text=True
    )
    up.says("follows teleop")
    for _ in range(4):
        process = up.node(starved)
        os.kill(process, signal.SIGSTOP)
        time.sleep(0.3)
        os.kill(process, signal.SIGCONT)
        time.sleep(0.5)
    text, _ = driving.communicate(timeout=60.0)
    assert driving.returncode == 0, text


def test_a_robot_that_is_started_again_does_not_walk_off(up: Robot, tmp_path: Path) -> None:
    """Somebody goes on commanding a velocity while the controller ends and another one starts."""
    driving = subprocess.Popen(
        [*QUADVEL, "drive", "--vx", "0.5", "--seconds", "60", "--topic", "cmd_vel"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        up.says("follows planner")
        for words in (("mode", "passive"), ("reset",), ("mode", "stand_up")):
            assert quadvel(*words)[0] == 0
        _, text = quadvel("status")
        assert "stance: stood up" in text
    finally:
        driving.kill()
        driving.communicate()


def test_no_robot_is_no_success() -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(int(os.environ["ROS_DOMAIN_ID"]) // 4 * 4 + 3)}
    done = subprocess.run([*QUADVEL, "status"], capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 1
    assert "no robot runs; start one: quadvel up" in done.stdout
    assert done.stdout.count("ROS domain") == 1

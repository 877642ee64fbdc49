"""Playing a motion on a robot: what it is sent, when that ends, and what is recorded of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from quadvel_bringup import cli
from quadvel_bringup.error_sentence import exit_with_sentence
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_lab.excite import RAMP_S, MotionError, MotionPlayer
from quadvel_sysid.excitation import FootLifting
from quadvel_sysid.logs.read_log import read_log
from tests.helpers.robots import ALIENGO

PROGRAM = """
import typer
from quadvel_lab.excite import excite_command
app = typer.Typer(pretty_exceptions_enable=False)
app.command()(excite_command)
app()
"""


def state(seconds: float, q: np.ndarray = ALIENGO.lie_q, tilt: float = 0.0) -> RobotState:
    quaternion = np.array([np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0])
    rest = np.zeros(12)
    return RobotState(
        5.0 + seconds,
        5000 + round(1e3 * seconds),
        np.array(q),
        rest,
        rest,
        quaternion,
        rest[:3],
        rest[:3],
        rest[:4],
    )


def play(player: MotionPlayer, begin: float, end: float, q: np.ndarray = ALIENGO.lie_q) -> JointCommand:
    """The answer at `end`, s, after states of every 20 ms since `begin`."""
    times = np.linspace(begin, end, round((end - begin) / 0.02) + 1)
    return [player.answer(state(float(t), q)) for t in times][-1]


def test_a_motion_begins_where_the_robot_is_and_ends_in_damping() -> None:
    excitation = FootLifting(ALIENGO, seconds=1.0)
    player, targets = MotionPlayer(excitation), excitation.targets()
    first = player.answer(state(0.0))
    np.testing.assert_allclose(first.q, ALIENGO.lie_q)
    assert (first.mode, first.tick) == (MODE_SERVO, 5000)
    near = ALIENGO.nominal_q
    np.testing.assert_allclose(play(player, 0.0, RAMP_S, near).q, targets[0], atol=1e-9)
    np.testing.assert_allclose(play(player, RAMP_S, RAMP_S + 0.25, near).q, targets[250], atol=1e-9)
    assert not player.is_done
    assert play(player, RAMP_S + 0.25, RAMP_S + 1.0, near).mode == MODE_DAMPING
    assert player.is_done


@pytest.mark.parametrize("then", [1.2, 0.9])
def test_a_motion_that_would_jump_after_a_silence_or_a_step_of_the_clock_is_ended(then: float) -> None:
    player = MotionPlayer(FootLifting(ALIENGO, seconds=1.0))
    play(player, 0.0, 1.0)
    with pytest.raises(MotionError, match=r"two states is (0.200|-0.100) s, expected 0 to 0.05 s"):
        player.answer(state(then))


def test_a_target_is_held_back_where_the_joint_is_far_from_it() -> None:
    player = MotionPlayer(FootLifting(ALIENGO))
    asked = ALIENGO.kp * (play(player, 0.0, RAMP_S).q - ALIENGO.lie_q)
    assert (np.abs(asked) <= ALIENGO.torque_limit).all()


def test_a_robot_that_tips_over_or_leaves_its_range_ends_the_motion() -> None:
    with pytest.raises(MotionError, match=r"the trunk tilts by 0\.900 rad"):
        MotionPlayer(FootLifting(ALIENGO)).answer(state(0.0, tilt=0.9))
    q = ALIENGO.nominal_q.copy()
    q[5] = ALIENGO.upper[5] + 0.2
    with pytest.raises(MotionError, match=r"FL_calf_joint is 0\.20 rad beyond its range"):
        MotionPlayer(FootLifting(ALIENGO)).answer(state(0.0, q))


def excite(*arguments: object) -> list[str]:
    return [sys.executable, "-c", PROGRAM, *map(str, arguments)]


def test_a_hung_robot_is_moved_and_recorded_at_1_khz_without_gaps(tmp_path: Path) -> None:
    file = tmp_path / "steps.mcap"
    ended = subprocess.run(
        excite("steps", "--seconds", 0.6, "--out", file), capture_output=True, text=True, timeout=240
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    log = read_log(file)
    np.testing.assert_allclose(np.diff(log.t), 0.001, atol=1e-9)
    np.testing.assert_allclose(np.diff(log.t_cmd), 0.001, atol=1e-9)
    assert log.t[-1] - log.t[0] >= RAMP_S + 0.6 - 0.002
    assert log.kp is not None
    assert (log.kp == ALIENGO.kp).all()
    swing = np.ptp(log.q[round(1e3 * RAMP_S) :], axis=0)
    assert swing.max() > 0.02
    assert sorted(path.name for path in tmp_path.iterdir()) == ["steps.mcap"]


@pytest.mark.long
def test_ctrl_c_ends_it_and_leaves_no_file(tmp_path: Path) -> None:
    running = subprocess.Popen(excite("sweep", "--seconds", 600, "--out", tmp_path / "x.mcap"))
    until = time.monotonic() + 120.0
    while not list(tmp_path.glob(".x*")):
        assert time.monotonic() < until, "it did not begin"
        time.sleep(0.05)
    time.sleep(0.5)
    running.send_signal(signal.SIGINT)
    running.send_signal(signal.SIGINT)
    assert running.wait(60) == 130
    assert os.listdir(tmp_path) == []


def test_no_recording_is_written_over(tmp_path: Path) -> None:
    file = tmp_path / "lift.mcap"
    file.write_text("measured once")
    ended = subprocess.run(excite("foot-lifting", "--out", file), capture_output=True, text=True)
    assert ended.returncode != 0
    assert f"{file} exists already" in ended.stderr
    assert file.read_text() == "measured once"


def test_after_a_report_it_says_what_to_record_next(tmp_path: Path) -> None:
    report = {
        "joints": ["FR_hip_joint"],
        "effects": [{"name": "coulomb_friction", "indistinguishable": ["stribeck_friction"]}],
        "unexplained": {"verdict": "white", "depends_on": []},
    }
    (tmp_path / "report.json").write_text(json.dumps(report))
    ended = subprocess.run(excite("--after", tmp_path / "report.json"), capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "quadvel excite creep --seconds 40\n  for coulomb_friction, stribeck_friction" in ended.stdout


OTHER_ROBOT = """
import sys
import quadvel_dds
quadvel_dds.install()
from rclpy.node import Node
from std_msgs.msg import String
from quadvel_description.robot import load_robot
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_nodes.node import request_exit, run
from quadvel_nodes.robot_view import LATCHED

class Robot(Node):
    def __init__(self):
        super().__init__("driver")
        self.described = self.create_publisher(String, "robot_description", LATCHED)
        self.described.publish(String(data=load_robot("go2").urdf_file.read_text()))
        self.states = self.create_publisher(LowState, "low_state", 1)
        self.create_subscription(LowCmd, "low_cmd", self.count, 10)
        self.tick, self.commands = 0, 0
        self.create_timer(0.01, self.send)
        self.create_timer(60.0, lambda: request_exit(self))
        self.create_timer(0.2, self.end_without_excite)
        self.seen = False

    def count(self, message):
        print("moved", flush=True)

    def send(self):
        self.tick += 1
        stamp = self.get_clock().now().to_msg()
        self.states.publish(LowState(stamp=stamp, tick=self.tick, orientation_wxyz=[1.0, 0.0, 0.0, 0.0]))

    def end_without_excite(self):
        present = self.count_publishers("low_cmd") > 0
        if self.seen and not present:
            request_exit(self)
        self.seen = self.seen or present

run(Robot, [])
"""


def test_the_motion_of_another_robot_is_not_played(tmp_path: Path) -> None:
    file = tmp_path / "creep.mcap"
    robot = subprocess.Popen([sys.executable, "-c", OTHER_ROBOT], stdout=subprocess.PIPE, text=True)
    ended = subprocess.run(
        excite("creep", "--seconds", 1, "--low-level", "external", "--out", file),
        capture_output=True,
        text=True,
        timeout=120,
    )
    moved, _ = robot.communicate(timeout=120)
    assert ended.returncode == 1
    assert "robot_description is that of 'go2', expected 'aliengo'" in ended.stdout
    assert moved == ""
    assert not file.exists()


def test_without_a_robot_it_says_what_to_start_and_ends_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("quadvel_lab.excite.FIRST_STATE_TIMEOUT_S", 0.2)
    path = tmp_path / "chirp.mcap"
    with pytest.raises(SystemExit) as ended, exit_with_sentence("quadvel"):
        cli.command("excite").main(["chirp", "--low-level", "external", "--out", str(path)])
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert "quadvel run driver" in message
    assert "ROS_DOMAIN_ID" in message
    assert not path.exists()


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended, exit_with_sentence("quadvel"):
        cli.command("excite").main(arguments)
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_options_that_contradict_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = refused(["chirp", "--low-level", "external", "--seed", "5"], capsys)
    assert "--seed: only a simulated robot has this" in text
    (tmp_path / "report.json").write_text(
        '{"joints": [], "effects": [], "unexplained": {"verdict": "white", "depends_on": []}}'
    )
    text = refused(["chirp", "--after", str(tmp_path / "report.json")], capsys)
    assert "found the motion chirp and --after" in text

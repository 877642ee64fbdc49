"""`quadvel plot` and `quadvel replay` of recordings without stamps, and of other robots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_eval.offline import replay_command
from quadvel_eval.recording_plot import plot_command, read_recorded_run
from quadvel_recordings.definitions import STORE
from tests.quadvel_recordings.joint_bags import (
    PERIOD,
    ROWS,
    T0,
    Message,
    go2,
    joint_states,
    motion,
    own,
    rosbag2,
)

SECONDS = 1e-9 * PERIOD * (ROWS - 1)
ORDERED = [name for leg in ("FL", "FR", "RL", "RR") for name in JOINT_NAMES if name.startswith(leg)]


def run(command: Any, *arguments: object) -> Any:
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(one) for one in arguments])


@pytest.mark.parametrize("zeros", [range(ROWS), range(20)])
def test_without_stamps_a_plot_is_over_the_times_of_receipt(tmp_path: Path, zeros: range) -> None:
    path = rosbag2(tmp_path / "bag", own(zeros))
    said: list[str] = []
    found = read_recorded_run(path, warn=said.append)
    assert (found.end, found.begin) == (pytest.approx(SECONDS), pytest.approx(1e-9 * T0))
    assert sum(f"{len(zeros)} of {ROWS} stamps are 0" in text for text in said) == 2
    result = run(plot_command, path, "--out", tmp_path / "out")
    assert (result.exit_code, f"warning: {path}: /low_state" in result.stderr) == (0, True)


@pytest.mark.parametrize(
    "messages", [go2(), joint_states(("shoulder", "elbow", "wrist", "grip"))], ids=["go2", "arm"]
)
def test_joints_of_other_robots_are_drawn(tmp_path: Path, messages: list[Message]) -> None:
    path = rosbag2(tmp_path / "bag", messages)
    found = read_recorded_run(path)
    moved = motion(len(found.joints))
    np.testing.assert_allclose(
        found.series["/low_state"][1], np.hstack([moved["q"], moved["tau"]]), atol=1e-4
    )
    np.testing.assert_allclose(found.series["/low_cmd"][1], moved["q_des"], atol=1e-4)
    assert found.end == pytest.approx(SECONDS, abs=1e-3)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "velocity.png").write_text("of another recording")
    result = run(plot_command, path, "--out", tmp_path / "out")
    assert result.exit_code == 0
    assert {one.name for one in (tmp_path / "out").iterdir()} == {"joints.png", "torques.png"}


def replayed(path: Path, *arguments: object) -> dict[str, float]:
    out = path.parent / f"{path.name}-out"
    result = run(replay_command, path, "--out", out, *arguments)
    assert result.exit_code == 0, result.output
    errors: dict[str, float] = json.loads((out / "replay.json").read_text())["torque_error_nm"]
    return errors


def test_a_replay_is_the_same_of_every_kind_of_recording(tmp_path: Path) -> None:
    """With stamps and without, from this stack's messages, a Go2's, and JointState in another order of the legs."""
    whole = replayed(rosbag2(tmp_path / "own", own(())))
    assert replayed(rosbag2(tmp_path / "zeros", own(range(ROWS)))) == pytest.approx(whole, abs=1e-3)
    others = rosbag2(tmp_path / "go2", go2())
    assert replayed(others, "--robot", "aliengo") == pytest.approx(whole, abs=1e-3)
    assert replayed(others) == replayed(others, "--robot", "go2")
    pair = joint_states(JOINT_NAMES, commanded=ORDERED)
    assert replayed(rosbag2(tmp_path / "pair", pair), "--gains", 30, 0.5) == pytest.approx(whole, abs=1e-3)


@pytest.mark.parametrize(
    ("messages", "sentence"),
    [
        (joint_states(JOINT_NAMES), "/joint_commands: kp: not in the recording, expected --gains KP KD"),
        (joint_states(("a", "b")), "expected all joints of the model; FR_hip_joint is missing"),
        (joint_states(JOINT_NAMES)[::2], "expected commands for the states on /joint_states"),
        ([("/x", "std_msgs/msg/String", T0, STORE.types["std_msgs/msg/String"]("x"))], r"the recording has /x \(std_msgs"),
    ],
)  # fmt: skip
def test_a_recording_that_cannot_be_replayed_fails_with_the_cause(
    tmp_path: Path, messages: list[Message], sentence: str
) -> None:
    path = rosbag2(tmp_path / "bag", messages)
    result = run(replay_command, path, "--out", tmp_path / "out")
    with pytest.raises(ValueError, match=sentence):
        raise result.exception
    assert not (tmp_path / "out").exists()

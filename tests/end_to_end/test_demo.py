"""The whole stack over DDS, each node a process: `quadvel demo`, in lockstep so that a busy machine does not matter."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import attrs
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from quadvel_actuator import ActuatorParameters
from quadvel_bringup import cli
from quadvel_recordings.reading import read_messages
from tests.helpers.robots import ALIENGO

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")
VIEWED = ("/tf", "/tf_static", "/robot_description")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


def test_a_short_demo_walks_without_a_fall_and_judges_itself(out: Path) -> None:
    (out / "notes.txt").write_text("mine")
    (out / "demo.mp4").write_text("of another walk")
    command = [*QUADVEL, "demo", "--quick", "--lockstep", "--no-video", "--out", str(out)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert re.search(r"^ *controller \| stance: stood up$", ended.stdout, re.MULTILINE), ended.stdout
    assert "refused mode" not in ended.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert sorted(summary) == [
        *("estimator", "falls", "loop", "max_error_wz", "max_error_xy", "mean_error_wz", "mean_error_xy"),
        *("realtime_factor", "segments"),
    ]
    commands = [segment["command"] for segment in summary["segments"]]
    assert commands[-2:] == [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]  # the robot may stand for a while before
    assert summary["falls"] == 0
    assert summary["max_error_xy"] < 0.15
    assert max(summary["estimator"]["rmse"]) < 0.08
    assert sorted(summary["loop"]) == [
        *("compute_p50_us", "compute_p99_us", "inference_p50_us", "overruns", "period_p99_ms", "rate_hz"),
    ]
    assert (out / "notes.txt").read_text() == "mine"
    assert not (out / "demo.mp4").exists()
    assert {"demo.mcap", "summary.json", "demo.png", "loop.png"} <= {path.name for path in out.iterdir()}


def test_a_go2_walks_as_well(tmp_path: Path) -> None:
    command = [
        *QUADVEL,
        "demo",
        "--robot",
        "go2",
        "--quick",
        "--lockstep",
        "--no-video",
        "--out",
        str(tmp_path),
    ]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["falls"] == 0
    assert summary["max_error_xy"] < 0.15
    assert max(summary["estimator"]["rmse"]) < 0.08


def test_a_demo_whose_robot_cannot_stand_up_ends_with_its_cause_and_exit_code_1(tmp_path: Path) -> None:
    weak = tmp_path / "weak.yaml"
    attrs.evolve(ActuatorParameters.of(ALIENGO), torque_limit=2.0).save(weak)
    command = [*QUADVEL, "demo", "--quick", "--lockstep", "--no-video", "--out", str(tmp_path / "out")]
    ended = subprocess.run([*command, "--actuator", str(weak)], capture_output=True, text=True, timeout=240)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert "planner: the controller is in fault" in ended.stdout
    assert ended.stderr == ""
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["demo.mcap"]


def test_its_recording_holds_every_state_and_the_answer_to_it(out: Path) -> None:
    if not (out / "demo.mcap").exists():
        pytest.skip("the demo made no recording")
    with (out / "demo.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = {
        channel.topic: summary.statistics.channel_message_counts.get(number, 0)
        for number, channel in summary.channels.items()
    }
    assert counts["/low_cmd"] == pytest.approx(counts["/low_state"], rel=0.02)
    assert counts["/ground_truth/odom"] == pytest.approx(counts["/low_state"], rel=0.02)
    assert {schema.name for schema in summary.schemas.values()} >= {"quadvel_msgs/msg/LowState"}


def test_its_recording_alone_shows_the_robot(out: Path) -> None:
    """Foxglove and RViz need the description, and one tree of frames from odom to each of its links."""
    if not (out / "demo.mcap").exists():
        pytest.skip("the demo made no recording")
    frames, descriptions = {}, []
    for topic, _, message in read_messages(out / "demo.mcap", lambda topic, _: topic in VIEWED):
        if topic == "/robot_description":
            descriptions.append(message.data)
            continue
        for transform in message.transforms:
            parent = frames.setdefault(transform.child_frame_id, transform.header.frame_id)
            assert parent == transform.header.frame_id, transform.child_frame_id
    links = [link.get("name") for link in ElementTree.fromstring(descriptions[0]).iter("link")]
    assert links[0] == "base_link"
    for name in [*links, "base_footprint"]:
        while name != "odom":
            name = frames[name]


def test_its_recording_is_drawn_and_asked_what_model_and_estimator_say_of_it(out: Path) -> None:
    if not (out / "demo.mcap").exists():
        pytest.skip("the demo made no recording")
    runner = CliRunner()
    drawn = runner.invoke(cli.app, ["plot", str(out / "demo.mcap"), "--out", str(out / "plot")])
    assert drawn.exit_code == 0, drawn.output
    assert {path.name for path in (out / "plot").iterdir()} == {
        "velocity.png",
        "joints.png",
        "torques.png",
        "loop.png",
    }
    asked = runner.invoke(cli.app, ["replay", str(out / "demo.mcap"), "--out", str(out / "replay")])
    assert asked.exit_code == 0, asked.output
    said = json.loads((out / "replay" / "replay.json").read_text())
    # The simulated drives are those of the model: what is left is the noise of their torque.
    assert max(said["torque_error_nm"].values()) < 0.35 < min(said["torque_rms_nm"].values())
    assert max(said["velocity_error"]["recorded estimate"]) < 1e-3
    assert max(said["velocity_error"]["truth"]) < 0.08


def test_a_demo_whose_folder_is_a_file_starts_nothing(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    command = [*QUADVEL, "demo", "--out", str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert "is a file" in ended.stderr
    assert "Traceback" not in ended.stderr

"""`quadvel calibrate` on recordings: from the board whose IMU leans, over driver and recorder, to the file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import quadvel_dds

quadvel_dds.install()

import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from quadvel_bringup import cli  # noqa: E402
from quadvel_bringup.recorder import Recorder  # noqa: E402
from quadvel_bringup.recording_file import RecordingFile  # noqa: E402
from quadvel_description.state import JointCommand  # noqa: E402
from quadvel_driver.calibration import Calibration  # noqa: E402
from quadvel_driver.find_calibration import CalibrationFit  # noqa: E402
from quadvel_msgs.msg import LowState  # noqa: E402
from quadvel_nodes.messages import write_low_state  # noqa: E402
from quadvel_nodes.robot_view import LATCHED  # noqa: E402
from quadvel_sim.simulator import Simulator, SimulatorConfig  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")
LEANING = Calibration(imu_mounting=np.radians([2.0, -1.0]))


def record_standing(path: Path, seconds: float) -> None:
    """A robot that stands, as it is reported by one whose IMU leans, in a recording."""
    rclpy.init(args=["test"])
    node = rclpy.create_node("standing")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    publisher = node.create_publisher(LowState, "low_state", 10)
    describer = node.create_publisher(String, "robot_description", LATCHED)
    describer.publish(String(data=(ALIENGO.folder / "robot.urdf").read_text()))
    simulator = Simulator(SimulatorConfig(robot=ALIENGO))
    simulator.reset("stand")
    hold = JointCommand(q=np.array(ALIENGO.nominal_q), kp=np.full(12, 100.0), kd=np.full(12, 3.0))
    with Recorder(node, RecordingFile(path)) as recorder:
        recorder.record("/low_state", "quadvel_msgs/msg/LowState")
        recorder.record("/robot_description", "std_msgs/msg/String")
        for _ in range(round(200 * seconds)):
            simulator.command(hold)
            simulator.step(5)
            message = LowState()
            message.stamp.sec, nanoseconds = divmod(round(1e9 * simulator.time), 10**9)
            message.stamp.nanosec = nanoseconds
            write_low_state(LEANING.as_reported(simulator.state()), message)
            publisher.publish(message)
            recorder.serve(executor, 0.001)
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("standing") / "standing.mcap"
    record_standing(path, 5.0)
    return path


def calibrate(*arguments: object) -> tuple[int, str]:
    done = subprocess.run(
        [*QUADVEL, "calibrate", *map(str, arguments)], capture_output=True, text=True, timeout=120
    )
    return done.returncode, done.stdout + done.stderr


def test_a_robot_that_does_not_hang_is_refused_by_file(standing: Path, tmp_path: Path) -> None:
    code, text = calibrate("--suspended", standing, "--out", tmp_path / "calibration.yaml")
    assert code == 2
    assert str(standing) in text
    assert "--suspended" in text
    assert not any(tmp_path.iterdir())


def test_an_imu_that_leans_by_two_degrees_is_shown_and_written(standing: Path, tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    code, text = calibrate("--standing", standing, "--out", file)
    assert code == 0, text
    assert "IMU: tilted by +2.0" in text or "IMU: tilted by +1.9" in text
    np.testing.assert_allclose(
        Calibration.load(file).imu_mounting, LEANING.imu_mounting, atol=np.radians(0.15)
    )
    assert "not estimated" in text


def test_what_tells_nothing_is_refused_in_one_sentence_and_writes_nothing(
    standing: Path, tmp_path: Path
) -> None:
    file = tmp_path / "calibration.yaml"
    for arguments, sentence in (
        ((), "name one with --suspended, with --standing, or both"),
        (("--standing", tmp_path / "none.mcap"), "there is no such file"),
        (("--standing", standing, "--robot", "go2"), "robot is 'aliengo', expected 'go2'"),
        (
            ("--suspended", standing),
            f"{standing}: suspended robot: FR_hip_joint hardly moves to and fro; record",
        ),
    ):
        code, text = calibrate(*arguments, "--out", file)
        assert code == 2
        assert sentence in text
        assert "Traceback" not in text
    assert not file.exists()


def test_the_table_shows_the_tilt_that_is_written_with_its_own_standard_error(
    standing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = Calibration(np.full(12, 0.001), np.radians([1.66, 0.3]))
    found = CalibrationFit(
        estimate=joints,
        zero_errors=np.full(12, 0.01),
        mounting_errors=np.radians([0.96, 0.5]),
        tilt=np.radians([1.85, 0.02]),
        tilt_errors=np.radians([0.11, 0.12]),
        calibration=Calibration(imu_mounting=np.radians([1.85, 0.0])),
        unevenness=0.0,
    )
    monkeypatch.setattr("quadvel_bringup.calibrate.fit_calibration", lambda *_: found)
    with pytest.raises(SystemExit):
        cli.command("calibrate").main(["--standing", str(standing), "--out", str(tmp_path / "c.yaml")])
    row = next(line for line in capsys.readouterr().out.splitlines() if "IMU roll" in line)
    assert [float(word) for word in row.split() if word[-1:].isdigit()] == [1.85, 0.11, 1.85]

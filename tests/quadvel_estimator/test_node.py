"""The node over DDS: what it publishes, what it refuses, and how it starts and ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from tf2_msgs.msg import TFMessage

from quadvel_description.kinematics import foot_positions
from quadvel_description.state import JointCommand, RobotState
from quadvel_estimator import estimator, features
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_nodes import publishers
from quadvel_nodes.messages import write_low_cmd, write_low_state
from quadvel_nodes.node import StartError
from tests.helpers.robots import ALIENGO

RECEIVED = {
    "velocity_estimate": TwistWithCovarianceStamped,
    "odom": Odometry,
    "/tf": TFMessage,
    "/diagnostics": DiagnosticArray,
}


State = Callable[..., RobotState]


class Bench:
    """The node under test and a peer that feeds it, served by one executor."""

    def __init__(self, arguments: list[str], standing: State) -> None:
        rclpy.init(args=["--ros-args", *arguments])
        self._standing = standing
        self._executor = SingleThreadedExecutor()
        peer = rclpy.create_node("peer", use_global_arguments=False)
        for node in (estimator.EstimatorNode(), peer):
            self._executor.add_node(node)
        self.heard: dict[str, list[Any]] = {topic: [] for topic in RECEIVED}
        for topic, kind in RECEIVED.items():
            peer.create_subscription(kind, topic, self.heard[topic].append, 100)
        self.states = peer.create_publisher(LowState, "low_state", 100)
        self.commands = peer.create_publisher(LowCmd, "low_cmd", 100)
        self.wait(lambda: self.states.get_subscription_count() and self.commands.get_subscription_count())
        self.wait(lambda: all(peer.count_publishers(topic) for topic in RECEIVED))

    def wait(self, is_so: Callable[[], Any], seconds: float = 30.0) -> None:
        """Serve until the predicate holds; fail with what was heard when the time is up."""
        end = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < end, {topic: len(messages) for topic, messages in self.heard.items()}
            self._executor.spin_once(timeout_sec=0.05)

    def send(self, at: float, **changes: Any) -> Any:
        """Publish a state with its stamp at `at` s; returns the message."""
        message = LowState()
        write_low_state(self._standing(at, **changes), message)
        message.stamp.sec, message.stamp.nanosec = int(at), round(1e9 * (at % 1.0))
        self.states.publish(message)
        return message

    def diagnosed(self, text: str) -> None:
        """Wait until /diagnostics has `text` among the values of its last status."""
        seen = self.heard["/diagnostics"]
        self.wait(lambda: seen and any(text in pair.value for pair in seen[-1].status[0].values))

    def close(self) -> None:
        self._executor.shutdown()
        rclpy.shutdown()


@pytest.fixture
def bench(
    request: pytest.FixtureRequest,
    write_estimator: Callable[..., Path],
    standing: State,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Bench]:
    arguments = getattr(request, "param", ["-p", f"model:={write_estimator()}"])
    with monkeypatch.context() as alone:
        alone.setattr(publishers, "DISCOVERY_TIME_S", 0.0)  # the node is the first
        bench = Bench(arguments, standing)
    yield bench
    bench.close()


def test_each_state_is_answered_with_the_network_s_velocity(
    bench: Bench, standing: State, weights: np.ndarray
) -> None:
    command = LowCmd()
    write_low_cmd(JointCommand(q=ALIENGO.nominal_q + 0.2), command)
    bench.commands.publish(command)
    for i in range(5):
        state = bench.send(3.0 + 0.005 * i)
        bench.wait(lambda n=i: len(bench.heard["velocity_estimate"]) == n + 1)
    answer = bench.heard["velocity_estimate"][4]
    assert answer.header.stamp == state.stamp
    assert answer.header.frame_id == "base_link"
    velocity = answer.twist.twist.linear
    expected = 0.5 * (
        features.build(ALIENGO, standing(0.0), np.full(12, 0.2), features.default_layout(ALIENGO)) @ weights
        + 4
    )
    np.testing.assert_allclose([velocity.x, velocity.y, velocity.z], expected, atol=1e-4)
    np.testing.assert_allclose(
        np.reshape(answer.twist.covariance, (6, 6)).diagonal()[:3], [0.01, 0.0025, 0.0225], rtol=1e-5
    )


def test_a_second_estimator_refuses_to_start(bench: Bench) -> None:
    with pytest.raises(StartError, match="velocity_estimate is already published"):
        estimator.EstimatorNode()


def test_a_stall_of_the_whole_machine_moves_nothing(bench: Bench) -> None:
    for i, at in enumerate((3.0, 3.005, 3.205, 3.21)):  # by the robot's own clock all of them 5 ms apart
        bench.send(at, tick=5 * i)
        bench.wait(lambda n=i: len(bench.heard["velocity_estimate"]) == n + 1)
    bench.wait(lambda: bench.heard["odom"])
    speeds = [answer.twist.twist.linear.x for answer in bench.heard["velocity_estimate"]]
    np.testing.assert_allclose(np.diff(speeds), 0.5, atol=1e-5)  # the network keeps its state
    assert bench.heard["odom"][0].pose.pose.position.x == pytest.approx(0.005 * sum(speeds[1:]))
    bench.diagnosed("0.195")


@pytest.mark.parametrize("bench", [["-p", "kind:=kalman"]], indirect=True)
def test_odometry_and_transform_agree_and_carry_the_imu_s_orientation(bench: Bench) -> None:
    turned = np.array([np.cos(0.2), 0.0, 0.0, np.sin(0.2)])
    for i in range(8):
        bench.send(0.005 * i, quaternion=turned)
        bench.wait(lambda n=i: len(bench.heard["velocity_estimate"]) == n + 1)
    bench.wait(lambda: len(bench.heard["odom"]) == 2 and len(bench.heard["/tf"]) == 2)
    odom, transform = bench.heard["odom"][-1], bench.heard["/tf"][-1].transforms[0]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert odom.header.stamp == transform.header.stamp == bench.heard["velocity_estimate"][-1].header.stamp
    assert odom.pose.pose.orientation == transform.transform.rotation
    assert odom.pose.pose.orientation.z == pytest.approx(np.sin(0.2), abs=1e-6)
    assert odom.pose.pose.position.x == transform.transform.translation.x
    assert abs(odom.twist.twist.linear.x) < 1e-3


def test_height_is_that_above_the_feet_and_said_to_be_unknown(bench: Bench, standing: State) -> None:
    """Height is independent of the estimated vertical velocity."""
    for i in range(40):
        bench.send(0.005 * i)
        bench.wait(lambda n=i: len(bench.heard["velocity_estimate"]) == n + 1)
    bench.wait(lambda: len(bench.heard["odom"]) == 10)
    assert abs(bench.heard["velocity_estimate"][-1].twist.twist.linear.z) > 0.5  # 0.1 m in this time
    odom = bench.heard["odom"][-1]
    height = ALIENGO.foot_radius - foot_positions(ALIENGO, standing(0.0).q)[:, 2].min()
    assert odom.pose.pose.position.z == pytest.approx(height, abs=1e-6)
    variances = np.reshape(odom.pose.covariance, (6, 6)).diagonal()
    assert variances[2] > 1e5 > max(variances[:2])


@pytest.mark.parametrize("bench", [["-p", "kind:=kalman", "-p", "publish_tf:=false"]], indirect=True)
def test_what_is_not_fit_to_use_is_refused_counted_and_named(bench: Bench) -> None:
    for at, changes in [(1.0, {}), (1.005, {"q": np.full(12, np.nan)}), (0.5, {}), (1.010, {})]:
        bench.send(at, **changes)
    bench.wait(lambda: len(bench.heard["velocity_estimate"]) == 2)
    bench.diagnosed("2, last: stamp is 500 ms older than the newest")
    command = LowCmd()
    command.q[3] = np.inf
    bench.commands.publish(command)
    bench.diagnosed("1, last: q holds inf, expected finite numbers")
    status = bench.heard["/diagnostics"][-1].status[0]
    assert status.name == "estimator"
    assert status.level == DiagnosticStatus.WARN
    assert not bench.heard["/tf"]
    bench.send(1.015)
    bench.wait(lambda: len(bench.heard["velocity_estimate"]) == 3)


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        (
            "kind:=psychic",
            "parameters: kind: found 'psychic', expected one of learned, kalman",
        ),
        ("reset_gap:=0.0", "parameters: reset_gap: found 0.0, expected above 0"),
        ("reset_gap:=soon", "parameter reset_gap: "),
        ("speed:=3", "unknown parameter speed, expected one of realtime_priority, cpus, robot, kind, model"),
    ],
)
def test_a_wrong_parameter_ends_the_start_with_one_sentence(
    argument: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        estimator.main(["--ros-args", "-p", argument])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(sentence)
    assert not rclpy.ok()


def launch(*arguments: str) -> subprocess.Popen[str]:
    """The node in a separate process."""
    program = "import quadvel_dds; quadvel_dds.install(); from quadvel_estimator import estimator"
    return subprocess.Popen(
        [sys.executable, "-c", f"{program}; estimator.main()", "--ros-args", *arguments],
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_missing_network_ends_the_process_with_one_sentence() -> None:
    process = launch("-p", "model:=/nowhere.onnx")
    _, error = process.communicate(timeout=60)
    expected = "/nowhere.onnx: no such file, expected an ONNX network\n"
    assert (process.returncode, error) == (2, expected)


def test_ctrl_c_that_arrives_twice_ends_it_with_exit_code_0() -> None:
    process = launch("-p", "kind:=kalman")
    rclpy.init(args=[])
    watcher = rclpy.create_node("watcher")
    reports: list[Any] = []
    watcher.create_subscription(DiagnosticArray, "/diagnostics", reports.append, 10)
    end = time.monotonic() + 60.0
    while not reports and time.monotonic() < end:
        rclpy.spin_once(watcher, timeout_sec=0.1)
    rclpy.shutdown()
    assert reports, "the node did not report within a minute"
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")

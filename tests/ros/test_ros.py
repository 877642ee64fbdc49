"""Our nodes under ROS 2: built with colcon, run with `ros2 run`, and together with embedded ones.

Not for what a node computes: that is tested with its class.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from quadvel_bringup.nodes import NODES

pytestmark = pytest.mark.ros

# Embedded nodes answer calls by Cyclone DDS alone: vendors differ in how a reply is matched to its request.
CYCLONE = "rmw_cyclonedds_cpp"
with_cyclone = pytest.mark.parametrize("ros", [CYCLONE], indirect=True)

STATE = ("controller/state", "quadvel_msgs/msg/ControllerState", "mode_name")
FORWARD = ("ground_truth/odom", "nav_msgs/msg/Odometry", "twist.twist.linear.x")
TRUTH_RATE = 200


@with_cyclone
def test_ros2_knows_every_node_and_message(ros: Any) -> None:
    for name, entry in NODES.items():
        assert f"{entry.package} {name}" in ros.call("ros2", "pkg", "executables", entry.package).splitlines()
    assert "float32[12] kp" in ros.call("ros2", "interface", "show", "quadvel_msgs/msg/LowCmd")
    assert "string keyframe" in ros.call("ros2", "interface", "show", "quadvel_msgs/srv/ResetSim")


@pytest.mark.parametrize("name", NODES)
def test_node_starts_and_two_ctrl_c_end_it_with_0(ros: Any, name: str) -> None:
    node = ros.node(name)
    ros.wait_for_nodes(f"/{name}")
    code = node.interrupt(times=2)
    assert code == 0, f"{node.name} ended with {code}:\n{node.text}"
    assert "Traceback" not in node.text, node.text


@with_cyclone
@pytest.mark.parametrize("name", NODES)
def test_unknown_parameter_is_refused_in_one_sentence(ros: Any, name: str) -> None:
    node = ros.node(name, "-p", "spring:=1.0")
    assert node.wait(30.0) != 0
    assert "spring" in node.text
    assert "Traceback" not in node.text, node.text


@pytest.mark.parametrize("embedded", [False, True], ids=["rclpy", "embedded"])
def test_parameters_come_from_yaml_and_can_be_asked_for(ros: Any, tmp_path: Path, embedded: bool) -> None:
    if embedded and ros.rmw != CYCLONE:
        pytest.skip(f"{ros.rmw} and Cyclone DDS do not answer each other's service calls")
    file = tmp_path / "params.yaml"
    file.write_text("estimator:\n  ros__parameters:\n    kind: kalman\n    reset_gap: 0.25\n")
    ros.node("estimator", "--params-file", str(file), "-p", "reset_gap:=0.5", embedded=embedded)
    ros.wait_for_nodes("/estimator")
    assert "kalman" in ros.call("ros2", "param", "get", "/estimator", "kind", "--no-daemon")
    assert "0.5" in ros.call("ros2", "param", "get", "/estimator", "reset_gap", "--no-daemon")
    described = ros.call("ros2", "param", "describe", "/estimator", "reset_gap", "--no-daemon")
    assert "Read only: true" in described


@pytest.mark.parametrize(
    ("body", "brain"), [("rclpy", "rclpy"), ("rclpy", "embedded"), ("embedded", "rclpy")]
)
def test_a_twist_makes_the_robot_walk(ros: Any, body: str, brain: str) -> None:
    ros.node("sim_node", embedded=body == "embedded")
    ros.node("estimator", embedded=brain == "embedded")
    ros.node("command_mux", embedded=brain == "embedded")
    ros.node("controller", "-p", "auto_stand:=true", embedded=brain == "embedded")
    modes = ros.echo(*STATE)
    ros.wait_until(
        lambda: "stance" in modes(), 60.0, lambda: f"expected mode stance, found {sorted({*modes()})}"
    )

    rate = ros.start("ros2", "topic", "hz", "low_cmd")
    ros.start("ros2", "topic", "pub", "-r", "20", "cmd_vel", "geometry_msgs/msg/Twist", "{linear: {x: 0.5}}")
    forward = ros.echo(*FORWARD)

    def mean() -> float:
        """Of the last second, m/s."""
        speeds = [float(speed) for speed in forward()[-TRUTH_RATE:]]
        return sum(speeds) / TRUTH_RATE if len(speeds) == TRUTH_RATE else 0.0

    def rates() -> list[float]:
        return [float(value) for value in re.findall(r"average rate: ([\d.]+)", rate.text)]

    ros.wait_until(
        lambda: abs(mean() - 0.5) < 0.15,
        30.0,
        lambda: f"expected 0.5 m/s, found {mean():.3f} after the modes {sorted({*modes()})}",
    )
    ros.wait_until(
        lambda: any(195.0 < value < 205.0 for value in rates()),
        15.0,
        lambda: f"expected low_cmd at 200 Hz, found {rates()}",
    )
    assert_type_hashes_are_understood(ros)


def test_ros2_sees_embedded_nodes_their_endpoints_and_their_types(ros: Any) -> None:
    for name in NODES:
        ros.node(name, embedded=True)
    ros.wait_for_nodes(*(f"/{name}" for name in NODES))
    info = ros.call("ros2", "node", "info", "/controller", "--no-daemon", "--spin-time", "2")
    assert "/low_cmd: quadvel_msgs/msg/LowCmd" in info
    assert "/low_state: quadvel_msgs/msg/LowState" in info
    assert "/controller/set_mode: quadvel_msgs/srv/SetMode" in info
    ros.node("estimator", "-r", "__node:=other")  # its reader's type hash comes from ROS 2's own generator
    ros.wait_for_nodes("/other")
    verbose = ros.call("ros2", "topic", "info", "low_cmd", "--verbose", "--no-daemon", "--spin-time", "2")
    hashes = re.findall(r"Topic type hash: (\S+)", verbose)
    assert len(hashes) >= 3, verbose
    assert len({*hashes}) == 1, verbose
    assert hashes[0].startswith("RIHS01_")
    assert_type_hashes_are_understood(ros)


@with_cyclone
def test_embedded_node_answers_a_service_call_of_ros2(ros: Any) -> None:
    ros.node("sim_node", embedded=True)
    ros.wait_for_nodes("/sim_node")
    call = ("/sim_node/reset", "quadvel_msgs/srv/ResetSim", "{keyframe: stand}")
    answer = ros.call("ros2", "service", "call", *call)
    assert "success=True" in answer, answer


def assert_type_hashes_are_understood(ros: Any) -> None:
    """ROS 2 warns of a writer or reader whose user data holds no type hash that it can read."""
    for process in ros.processes:
        warnings = [line for line in process.lines if re.search(r"(?<!Topic )type hash", line)]
        assert not warnings, f"{process.name}: {warnings}"

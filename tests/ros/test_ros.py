"""Our nodes under ROS 2: built with colcon, run with `ros2 run` and `ros2 launch`, together with embedded ones.

Not for what a node computes: that is tested with its class. Robots walk in lockstep here, where a slow machine
makes them slower and not worse.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from quadvel_bringup.nodes import NODES
from quadvel_bringup.stack import Stack
from quadvel_sysid.logs.read_log import read_log

pytestmark = pytest.mark.ros

# Embedded nodes answer calls by Cyclone DDS alone: vendors differ in how a reply is matched to its request.
CYCLONE = "rmw_cyclonedds_cpp"
with_cyclone = pytest.mark.parametrize("ros", [CYCLONE], indirect=True)

POLICY = Path(__file__).parents[2] / "ros_ws" / "security" / "policy.xml"
AS_TOOL = ("env", "ROS_SECURITY_ENCLAVE_OVERRIDE=/quadvel/tools")
STACK = ("sim_node", "estimator", "controller", "command_mux")
# Nothing goes out to a robot's address, and no port is taken that somebody else may have.
ALONE = {"board": ("-p", "port:=0"), "driver": ("-p", "dry_run:=true")}
LAUNCH = ("ros2", "launch", "quadvel_bringup", "robot.launch.py")
QUADVEL = ("quadvel_bringup", "quadvel")
STATE = ("controller/state", "quadvel_msgs/msg/ControllerState", "mode_name")
FORWARD = ("ground_truth/odom", "nav_msgs/msg/Odometry", "twist.twist.linear.x")
TRUTH_RATE = 200
LOOKING = ("--no-daemon", "--spin-time", "5")
"""A command that asks a node looks for it so long (s); Fast DDS takes some seconds where lo has no multicast."""
RESET = ("/sim_node/reset", "quadvel_msgs/srv/ResetSim", "{keyframe: stand}")

RESET_FROM_EMBEDDED = """
import quadvel_dds; quadvel_dds.install()
import rclpy
from quadvel_msgs.srv import ResetSim
rclpy.init(args=[])
node = rclpy.create_node("caller")
client = node.create_client(ResetSim, "/sim_node/reset")
assert client.wait_for_service(timeout_sec=60.0), "the service is not there"
future = client.call_async(ResetSim.Request(keyframe="stand"))
rclpy.spin_until_future_complete(node, future, timeout_sec=60.0)
print(future.result())
rclpy.shutdown()
"""


@with_cyclone
def test_ros2_knows_every_node_and_message(ros: Any) -> None:
    for name, entry in NODES.items():
        assert f"{entry.package} {name}" in ros.call("ros2", "pkg", "executables", entry.package).splitlines()
    assert "float32[12] kp" in ros.call("ros2", "interface", "show", "quadvel_msgs/msg/LowCmd")
    assert "string keyframe" in ros.call("ros2", "interface", "show", "quadvel_msgs/srv/ResetSim")


@pytest.mark.parametrize("name", NODES)
def test_ros2_run_starts_a_node_and_ctrl_c_ends_it_with_0(ros: Any, name: str) -> None:
    assert_ends_cleanly(ros, ros.node(name, *ALONE.get(name, ())), 1, f"/{name}")


@pytest.mark.parametrize("name", NODES)
def test_ctrl_c_that_comes_twice_ends_a_node_with_0(ros: Any, name: str) -> None:
    arguments = ("--ros-args", *ALONE[name]) if name in ALONE else ()
    assert_ends_cleanly(ros, ros.program(NODES[name].package, name, *arguments), 2, f"/{name}")


@with_cyclone
@pytest.mark.parametrize("name", NODES)
def test_unknown_parameter_is_refused_in_one_sentence(ros: Any, name: str) -> None:
    node = ros.node(name, "-p", "spring:=1.0")
    assert node.wait(60.0) != 0
    assert "spring" in node.text
    assert "Traceback" not in node.text, node.text


@pytest.mark.parametrize("times", [1, 2])
def test_the_launch_file_starts_the_robot_and_ctrl_c_ends_it(ros: Any, times: int) -> None:
    launch = ros.start(*LAUNCH, "use_sim_time:=true")
    assert_ends_cleanly(ros, launch, times, *(f"/{name}" for name in STACK))
    assert launch.text.count("process has finished cleanly") == len(STACK), launch.text


@with_cyclone
@pytest.mark.parametrize(
    ("file", "names"),
    [
        (("sim.launch.py", "use_sim_time:=true"), STACK),
        (("robot.launch.py", "low_level:=board"), ("board", "driver", *STACK[1:])),
        (("follow.launch.py", "use_sim_time:=true"), ("person_tracker", "follow_planner")),
    ],
    ids=["sim", "board", "follow"],
)
def test_every_other_launch_starts_its_nodes_and_ctrl_c_ends_them(ros: Any, file: Any, names: Any) -> None:
    launch = ros.start("ros2", "launch", "quadvel_bringup", *file)
    assert_ends_cleanly(ros, launch, 1, *(f"/{name}" for name in names))
    assert launch.text.count("process has finished cleanly") == len(names), launch.text


@with_cyclone
def test_a_launched_simulator_takes_the_actuator_file_that_is_named(ros: Any, tmp_path: Path) -> None:
    launch = ros.start(*LAUNCH, f"actuator:={tmp_path}/none.yaml")
    launch.wait(60.0)
    assert f"actuator_file: cannot read {tmp_path}/none.yaml" in launch.text, launch.text


@with_cyclone
def test_the_launch_file_ends_all_where_one_node_cannot_start(ros: Any) -> None:
    launch = ros.start(*LAUNCH, "policy:=/nowhere.onnx")
    launch.wait(60.0)  # its end; the processes that it leaves behind fail the test
    controller = [line for line in launch.lines if line.startswith("[controller-")]
    assert len(controller) == 1, launch.text
    assert "/nowhere.onnx: no such file" in controller[0]


@with_cyclone
@pytest.mark.parametrize("times", [1, 2])
def test_quadvel_up_does_the_same_with_the_same_nodes(ros: Any, times: int) -> None:
    assert_ends_cleanly(ros, ros.program(*QUADVEL, "up"), times, *(f"/{name}" for name in STACK))


@pytest.mark.parametrize("embedded", [False, True], ids=["rclpy", "embedded"])
def test_parameters_come_from_yaml_and_are_told_but_fixed(ros: Any, tmp_path: Path, embedded: bool) -> None:
    if embedded and ros.rmw != CYCLONE:
        pytest.skip(f"{ros.rmw} and Cyclone DDS do not answer each other's service calls")
    file = tmp_path / "params.yaml"
    file.write_text("estimator:\n  ros__parameters:\n    kind: kalman\n    reset_gap: 0.25\n")
    ros.node("estimator", "--params-file", str(file), "-p", "reset_gap:=0.5", embedded=embedded)
    ros.wait_for_nodes("/estimator")
    listed = ros.call("ros2", "param", "list", "/estimator", *LOOKING).split()
    assert {"kind", "reset_gap", "use_sim_time"} <= {*listed}
    assert "kalman" in ros.call("ros2", "param", "get", "/estimator", "kind", *LOOKING)
    assert "0.5" in ros.call("ros2", "param", "get", "/estimator", "reset_gap", *LOOKING)
    described = ros.call("ros2", "param", "describe", "/estimator", "reset_gap", *LOOKING)
    assert "Read only: true" in described
    refused = ros.start("ros2", "param", "set", "/estimator", "reset_gap", "0.1", *LOOKING)
    refused.wait(60.0)
    assert "read-only" in refused.text, refused.text
    assert "0.5" in ros.call("ros2", "param", "get", "/estimator", "reset_gap", *LOOKING)


@pytest.mark.parametrize(
    ("body", "brain"), [("rclpy", "rclpy"), ("rclpy", "embedded"), ("embedded", "rclpy")]
)
def test_a_twist_makes_the_robot_walk(ros: Any, body: str, brain: str) -> None:
    for name, arguments in Stack(use_sim_time=True).arguments().items():
        middleware = body if name == "sim_node" else brain
        ros.node(name, *arguments[1:], embedded=middleware == "embedded")
    modes = ros.echo(*STATE)
    ros.wait_until(
        lambda: "stance" in modes(), 120.0, lambda: f"expected mode stance, found {sorted({*modes()})}"
    )
    rate = ros.start("ros2", "topic", "hz", "--use-sim-time", "low_cmd")
    ros.start("ros2", "topic", "pub", "-r", "50", "cmd_vel", "geometry_msgs/msg/Twist", "{linear: {x: 0.5}}")
    forward = ros.echo(*FORWARD)

    def mean() -> float:
        """Of the last second, m/s."""
        speeds = [float(speed) for speed in forward()[-TRUTH_RATE:]]
        return sum(speeds) / TRUTH_RATE if len(speeds) == TRUTH_RATE else 0.0

    def rates() -> list[float]:
        return [float(value) for value in re.findall(r"average rate: ([\d.]+)", rate.text)]

    ros.wait_until(
        lambda: abs(mean() - 0.5) < 0.1,
        120.0,
        lambda: f"expected 0.5 m/s, found {mean():.3f} after the modes {sorted({*modes()})}",
    )
    ros.wait_until(
        lambda: any(199.0 < value < 201.0 for value in rates()),
        60.0,
        lambda: f"expected low_cmd at 200 Hz, found {rates()}",
    )
    assert "fault" not in modes()
    assert_type_hashes_are_understood(ros)


def test_ros2_sees_embedded_nodes_their_endpoints_and_their_types(ros: Any) -> None:
    for name in NODES:
        ros.node(name, *ALONE.get(name, ()), embedded=True)
    ros.wait_for_nodes(*(f"/{name}" for name in NODES))
    info = ros.call("ros2", "node", "info", "/controller", *LOOKING)
    assert "/low_cmd: quadvel_msgs/msg/LowCmd" in info
    assert "/low_state: quadvel_msgs/msg/LowState" in info
    assert "/controller/set_mode: quadvel_msgs/srv/SetMode" in info
    ros.node("estimator", "-r", "__node:=other")  # its reader's type hash comes from ROS 2's own generator
    ros.wait_for_nodes("/other")
    verbose = ros.call("ros2", "topic", "info", "/low_cmd", "--verbose", *LOOKING)
    hashes = re.findall(r"Topic type hash: (\S+)", verbose)
    assert len(hashes) >= 3, verbose
    assert len({*hashes}) == 1, verbose
    assert hashes[0].startswith("RIHS01_")
    assert_type_hashes_are_understood(ros)


@with_cyclone
def test_an_embedded_node_answers_a_service_call_of_ros2(ros: Any) -> None:
    ros.node("sim_node", embedded=True)
    ros.wait_for_nodes("/sim_node")
    answer = ros.call("ros2", "service", "call", *RESET)
    assert "success=True" in answer, answer


@with_cyclone
def test_a_node_of_ros2_answers_a_service_call_of_an_embedded_node(ros: Any) -> None:
    ros.node("sim_node")
    caller = ros.python(RESET_FROM_EMBEDDED)
    assert caller.wait(120.0) == 0, caller.text
    assert "success=True" in caller.text, caller.text


@pytest.mark.parametrize("embedded", [False, True], ids=["rclpy", "embedded"])
def test_a_recording_made_under_ros2_is_whole_and_readable(ros: Any, tmp_path: Path, embedded: bool) -> None:
    file = tmp_path / "walk.mcap"
    simulator = ros.node("sim_node", embedded=embedded)
    recording = ros.program(*QUADVEL, "record", "low_state", "imu", "--out", str(file))
    ros.wait_for_nodes("/sim_node", "/recorder")
    ros.wait_until(lambda: file.stat().st_size > 20_000, 60.0, lambda: "nothing was recorded")
    assert recording.interrupt(times=2) == 0, recording.text
    with AnyReader([file], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        assert kinds == {"/low_state": "quadvel_msgs/msg/LowState", "/imu": "sensor_msgs/msg/Imu"}
        for connection, _, data in reader.messages():
            assert reader.deserialize(data, connection.msgtype).__msgtype__ == connection.msgtype
    if has_rosbag2(ros):
        assert "/low_state" in ros.call("ros2", "bag", "info", str(file))
        simulator.interrupt()
        heard = ros.start("ros2", "topic", "echo", "--once", "imu", "sensor_msgs/msg/Imu")
        ros.call("ros2", "bag", "play", "--delay", "3", str(file))
        assert heard.wait(60.0) == 0, heard.text


@with_cyclone
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_of_ros2_bag_is_a_log_to_identify_from(ros: Any, tmp_path: Path, storage: str) -> None:
    if not has_rosbag2(ros):
        pytest.skip("ros2bag is not installed")
    for name, arguments in Stack(use_sim_time=True).arguments().items():
        ros.node(name, *arguments[1:])
    ros.wait_for_nodes(*(f"/{name}" for name in STACK))
    bag = tmp_path / "bag"
    recording = ros.start("ros2", "bag", "record", "-s", storage, "-o", str(bag), "/low_state", "/low_cmd")
    ros.wait_until(lambda: recording.text.count("Subscribed to topic") == 2, 60.0, lambda: recording.text)
    ros.call("sleep", "3")
    assert recording.interrupt() == 0, recording.text
    log = read_log(bag)
    assert len(log.t) > 50
    assert len(log.t_cmd) > 50


def test_under_sros2_the_robot_stands_up_and_obeys_its_operator_alone(ros: Any, tmp_path: Path) -> None:
    if "sros2" not in ros.call("ros2", "pkg", "list").split():
        pytest.skip("sros2 is not installed")
    keystore = tmp_path / "keystore"
    ros.call("ros2", "security", "create_keystore", str(keystore))
    ros.call("ros2", "security", "generate_artifacts", "-k", str(keystore), "-p", str(POLICY))
    ros.secure(keystore)
    launch = ros.start(*LAUNCH, "use_sim_time:=true")
    ros.wait_until(lambda: "stance: stood up" in launch.text, 120.0, lambda: "it does not stand up")
    obeyed = ros.program(*QUADVEL, "drive", "--vx", "0.5", "--seconds", "3")
    assert obeyed.wait(120.0) == 0, obeyed.text
    heard = ros.call(*AS_TOOL, "ros2", "topic", "echo", "--once", "low_state", "quadvel_msgs/msg/LowState")
    assert "stamp:" in heard
    for order in (
        ("topic", "pub", "--once", "low_cmd", "quadvel_msgs/msg/LowCmd", "{}"),
        ("service", "call", "controller/set_mode", "quadvel_msgs/srv/SetMode", "{mode: passive}"),
    ):
        refused = ros.start(*AS_TOOL, "ros2", *order)
        assert refused.wait(60.0) != 0, refused.text
    assert launch.interrupt() == 0, launch.text


def assert_ends_cleanly(ros: Any, process: Any, times: int, *nodes: str) -> None:
    """Wait for the nodes, press Ctrl-C: exit code 0 without a traceback, and no node left."""
    ros.wait_for_nodes(*nodes)
    code = process.interrupt(times)
    assert code == 0, f"{process.name} ended with {code}:\n{process.text}"
    assert "Traceback" not in process.text, process.text


def assert_type_hashes_are_understood(ros: Any) -> None:
    """ROS 2 warns of a writer or reader whose user data holds no type hash that it can read."""
    for process in ros.processes:
        warnings = [line for line in process.lines if re.search(r"(?<!Topic )type hash", line)]
        assert not warnings, f"{process.name}: {warnings}"


def has_rosbag2(ros: Any) -> bool:
    return "ros2bag" in ros.call("ros2", "pkg", "list").split()

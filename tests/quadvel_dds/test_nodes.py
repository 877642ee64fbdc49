"""Tests of nodes in one process: names, services, logs, creation and destruction."""

import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import Twist
from rclpy.exceptions import NameValidationException, NotInitializedException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool

from quadvel_dds import UnsupportedError

Start = Callable[..., None]
SpinUntil = Callable[..., bool]


def test_node_names_are_told_to_ros(ros: Start) -> None:
    from rmw_dds_common.msg import ParticipantEntitiesInfo

    from quadvel_dds import messages

    ros("--ros-args", "-r", "__ns:=/robot")
    node = Node("mux")
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    reader = node.context.participant.reader("ros_discovery_info", ParticipantEntitiesInfo.TYPENAME, profile)
    data, _ = reader.take()
    (info,) = messages.deserialize(data, ParticipantEntitiesInfo.TYPENAME).node_entities_info_seq
    assert (info.node_namespace, info.node_name) == ("/robot", "mux")
    assert len(info.writer_gid_seq) == 1 + 6  # /rosout and the parameter services
    assert len(info.reader_gid_seq) == 6


def test_security_that_is_not_here_is_not_pretended(ros: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    with pytest.raises(ValueError, match="the embedded middleware has no security"):
        ros("--ros-args", "--enclave", "/quadvel/controller")


def test_remapping_of_node_namespace_and_topics(ros: Start) -> None:
    ros(
        "--ros-args",
        "-r",
        "__node:=mux2",
        "-r",
        "__ns:=/robot",
        "-r",
        "cmd_vel:=/teleop",
        "-r",
        "~/set:=set_mode",
    )
    node = Node("mux", namespace="/other")
    assert node.get_fully_qualified_name() == "/robot/mux2"
    assert node.create_publisher(Twist, "cmd_vel", 1).topic_name == "/teleop"
    assert (
        node.create_service(SetBool, "~/set", lambda request, response: response).service_name
        == "/robot/set_mode"
    )


def test_bad_names_are_refused(ros: Start) -> None:
    ros()
    with pytest.raises(NameValidationException, match="my-node"):
        Node("my-node")
    with pytest.raises(NameValidationException, match="cmd vel"):
        Node("mux").create_publisher(Twist, "cmd vel", 1)


def test_node_needs_init() -> None:
    with pytest.raises(NotInitializedException, match=r"rclpy\.init"):
        Node("early")


def test_service_answers(ros: Start) -> None:
    ros()
    node = Node("server")

    def on_request(request: Any, response: Any) -> Any:
        response.success, response.message = request.data, "as asked"
        return response

    node.create_service(SetBool, "allow_walking", on_request)
    first, second = node.create_client(SetBool, "allow_walking"), node.create_client(SetBool, "allow_walking")
    assert first.wait_for_service(timeout_sec=5.0)
    futures = [
        client.call_async(SetBool.Request(data=data)) for client, data in ((first, True), (second, False))
    ]
    for future in futures:
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
    assert [future.result().success for future in futures] == [True, False]
    assert futures[0].result().message == "as asked"


def test_the_time_to_forget_a_request_does_not_depend_on_their_number(
    ros: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    ros()
    client = Node("caller").create_client(SetBool, "nowhere")
    monkeypatch.setattr(client._endpoint, "ask", lambda request, number: None)
    futures = [client.call_async(SetBool.Request()) for _ in range(10_000)]
    start = time.process_time()
    for future in futures:
        client.remove_pending_request(future)
        client.remove_pending_request(future)
    assert time.process_time() - start < 1.0
    assert not client._pending


def test_absent_service_is_not_ready(ros: Start) -> None:
    ros()
    assert not Node("caller").create_client(SetBool, "nowhere").wait_for_service(timeout_sec=0.05)


def test_order_of_the_end_does_not_matter(ros: Start) -> None:
    ros()
    node, executor = Node("idle"), SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin_once(timeout_sec=0.0)
    rclpy.shutdown()
    node.destroy_node()
    node.destroy_node()
    executor.remove_node(node)
    executor.shutdown()
    rclpy.try_shutdown()


def test_init_again_after_shutdown(ros: Start) -> None:
    for _ in range(2):
        ros()
        node = Node("again")
        assert rclpy.ok()
        node.destroy_node()
        rclpy.shutdown()
        assert not rclpy.ok()


def test_options_that_are_not_offered_say_so(ros: Start) -> None:
    ros()
    node = Node("plain")
    with pytest.raises(UnsupportedError, match="create_publisher: option 'event_callbacks'"):
        node.create_publisher(String, "chatter", 1, event_callbacks=object())
    with pytest.raises(UnsupportedError, match=r"Node\.get_node_names"):
        node.get_node_names()

    async def callback() -> None: ...

    with pytest.raises(UnsupportedError, match="coroutine"):
        SingleThreadedExecutor().create_task(callback)


def test_one_place_in_the_program_logs_with_one_severity_as_rclpy_wants_it(ros: Start) -> None:
    ros()
    log = Node("talker").get_logger()

    def tell(is_fault: bool) -> None:
        (log.error if is_fault else log.info)("it lies")

    tell(False)
    with pytest.raises(ValueError, match="severity cannot be changed between calls"):
        tell(True)


def test_log_lines_have_levels_throttles_and_reach_rosout(
    ros: Start, spin_until: SpinUntil, capsys: pytest.CaptureFixture[str]
) -> None:
    from rcl_interfaces.msg import Log

    ros("--ros-args", "--log-level", "talker:=debug")
    node, logged = Node("talker"), []
    node.create_subscription(Log, "/rosout", lambda message: logged.append((message.level, message.msg)), 10)
    for number in range(3):
        node.get_logger().warning(f"late {number}", throttle_duration_sec=60.0)
        node.get_logger().debug(f"debug {number}", once=True)
    assert spin_until(node, lambda: len(logged) == 2)
    assert logged == [(30, "late 0"), (10, "debug 0")]
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("[WARN] [")
    assert first.endswith("] [talker]: late 0")
    assert second.startswith("[DEBUG]")

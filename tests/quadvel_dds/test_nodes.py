"""Nodes in one process: topics, services, timers, parameters, executors."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidNodeNameException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    InvalidTopicNameException,
    NotInitializedException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Int32, String
from std_srvs.srv import SetBool

from quadvel_dds import UnsupportedError

Start = Callable[..., None]


def spin_until(node: Node, condition: Callable[[], Any], timeout: float = 20.0) -> bool:
    deadline = time.monotonic() + timeout
    while not condition() and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    return bool(condition())


def test_messages_arrive_in_order(ros: Start) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Int32, "numbers", lambda message: received.append(message.data), 10)
    publisher = node.create_publisher(Int32, "numbers", 10)
    assert publisher.get_subscription_count() == 1
    for number in range(10):
        publisher.publish(Int32(data=number))
    assert spin_until(node, lambda: len(received) == 10)
    assert received == list(range(10))


def test_depth_keeps_the_newest(ros: Start) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Int32, "numbers", lambda message: received.append(message.data), 3)
    publisher = node.create_publisher(Int32, "numbers", 10)
    for number in range(10):
        publisher.publish(Int32(data=number))
    assert spin_until(node, lambda: 9 in received)
    assert received == [7, 8, 9]


def test_nan_and_infinity_are_delivered_as_they_are(ros: Start) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Twist, "cmd_vel", received.append, 1)
    command = Twist()
    command.linear.x, command.linear.y = math.nan, math.inf
    node.create_publisher(Twist, "cmd_vel", 1).publish(command)
    assert spin_until(node, lambda: received)
    assert math.isnan(received[0].linear.x)
    assert received[0].linear.y == math.inf


def test_transient_local_reaches_late_subscriptions(ros: Start) -> None:
    ros()
    node, late, volatile = Node("listener"), [], []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(String, "description", latched).publish(String(data="<robot/>"))
    node.create_subscription(String, "description", late.append, latched)
    node.create_subscription(String, "description", volatile.append, 1)
    assert spin_until(node, lambda: late)
    assert late[0].data == "<robot/>"
    assert not volatile


def test_best_effort_publisher_does_not_serve_a_reliable_subscription(ros: Start) -> None:
    ros()
    node = Node("listener")
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = node.create_publisher(String, "chatter", best_effort)
    subscription = node.create_subscription(String, "chatter", lambda _: None, 1)
    assert publisher.get_subscription_count() == 0
    assert subscription.get_publisher_count() == 0


def test_callback_may_take_the_message_information(ros: Start) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(String, "chatter", lambda message, info: received.append(info), 1)
    before = time.time_ns()
    node.create_publisher(String, "chatter", 1).publish(String())
    assert spin_until(node, lambda: received)
    assert before <= received[0]["source_timestamp"] <= time.time_ns()


def test_raw_bytes_pass_through(ros: Start) -> None:
    ros()
    node, raw, texts = Node("repeater"), [], []
    publisher = node.create_publisher(String, "copy", 1)
    node.create_subscription(String, "chatter", lambda data: publisher.publish(data), 1, raw=True)
    node.create_subscription(String, "chatter", raw.append, 1, raw=True)
    node.create_subscription(String, "copy", lambda message: texts.append(message.data), 1)
    node.create_publisher(String, "chatter", 1).publish(String(data="hello"))
    assert spin_until(node, lambda: raw and texts)
    assert isinstance(raw[0], bytes)
    assert texts == ["hello"]


def test_publishing_another_type_is_refused(ros: Start) -> None:
    ros()
    publisher = Node("talker").create_publisher(String, "chatter", 1)
    with pytest.raises(TypeError, match="String"):
        publisher.publish(Int32())


def test_destroyed_endpoints_leave_the_graph(ros: Start) -> None:
    ros()
    node = Node("talker")
    publisher = node.create_publisher(String, "chatter", 1)
    subscription = node.create_subscription(String, "chatter", lambda _: None, 1)
    assert (node.count_publishers("chatter"), node.count_subscribers("/chatter")) == (1, 1)
    assert ("/chatter", ["std_msgs/msg/String"]) in node.get_topic_names_and_types()
    assert node.destroy_publisher(publisher)
    assert node.destroy_subscription(subscription)
    assert not node.destroy_subscription(subscription)
    assert spin_until(node, lambda: node.count_publishers("chatter") + node.count_subscribers("chatter") == 0)


def test_type_hash_stands_in_the_user_data(ros: Start) -> None:
    from cyclonedds.qos import Policy

    ros()
    node = Node("talker")
    node.create_publisher(Twist, "cmd_vel", 1)
    endpoint = next(
        e for e in node.context.participant.endpoints("publication") if e.topic_name == "rt/cmd_vel"
    )
    assert endpoint.type_name == "geometry_msgs::msg::dds_::Twist_"
    assert endpoint.qos[Policy.Userdata].data == (
        b"typehash=RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a;"
    )


def test_node_names_are_told_to_ros(ros: Start) -> None:
    from rmw_dds_common.msg import ParticipantEntitiesInfo

    from quadvel_dds import messages

    ros("--ros-args", "-r", "__ns:=/robot")
    node = Node("mux")
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    reader = node.context.participant.reader("ros_discovery_info", ParticipantEntitiesInfo.TYPENAME, profile)
    data, _ = reader.take()
    (told,) = messages.deserialize(data, ParticipantEntitiesInfo.TYPENAME).node_entities_info_seq
    assert (told.node_namespace, told.node_name) == ("/robot", "mux")
    assert len(told.writer_gid_seq) == 2 + 6  # /rosout, /parameter_events and the parameter services
    assert len(told.reader_gid_seq) == 6


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
    assert node.resolve_topic_name("cmd_vel", only_expand=True) == "/robot/cmd_vel"


def test_bad_names_are_refused(ros: Start) -> None:
    ros()
    with pytest.raises(InvalidNodeNameException, match="my-node"):
        Node("my-node")
    with pytest.raises(InvalidTopicNameException, match="cmd vel"):
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


def test_absent_service_is_not_ready(ros: Start) -> None:
    ros()
    assert not Node("caller").create_client(SetBool, "nowhere").wait_for_service(timeout_sec=0.05)


def test_error_in_a_callback_ends_the_spin(ros: Start) -> None:
    ros()
    node = Node("faulty")
    node.create_timer(0.001, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rclpy.spin(node)


def drive_clock(node: Node, seconds: float) -> None:
    """Set simulated time as /clock does, and let the node act on it."""
    message = ClockMessage()
    message.clock = Time(seconds=seconds).to_msg()
    node._on_clock(message)
    for _ in range(10):
        rclpy.spin_once(node, timeout_sec=0.0)


def test_timer_keeps_its_grid_and_leaves_out_missed_deadlines(ros: Start) -> None:
    ros("--ros-args", "-p", "use_sim_time:=true")
    node, calls = Node("control", start_parameter_services=False), []
    timer = node.create_timer(0.1, lambda: calls.append(node.get_clock().now().nanoseconds / 1e9))
    for now in (0.05, 0.13, 0.2, 0.26, 0.95, 1.0):
        drive_clock(node, now)
    assert calls == [0.13, 0.2, 0.95, 1.0]  # not shifted by the lateness of 0.13 and 0.95
    timer.cancel()
    drive_clock(node, 2.0)
    timer.reset()
    drive_clock(node, 2.05)
    assert len(calls) == 4
    drive_clock(node, 2.1)
    assert len(calls) == 5


def test_simulated_time_comes_from_the_clock_topic(ros: Start) -> None:
    ros()
    node = Node("control", parameter_overrides=[Parameter("use_sim_time", value=True)])
    assert node.get_clock().now().nanoseconds == 0
    message = ClockMessage()
    message.clock.sec = 42
    node.create_publisher(ClockMessage, "/clock", 1).publish(message)
    assert spin_until(node, lambda: node.get_clock().now().nanoseconds == 42 * 10**9)
    node.set_parameters([Parameter("use_sim_time", value=False)])
    assert abs(node.get_clock().now().nanoseconds - time.time_ns()) < 10**10


def test_parameter_defaults_and_overrides(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2.5", "-p", "unknown:=1")
    node = Node("control")
    assert node.declare_parameter("gain", 1.0).value == 2.5
    assert node.declare_parameter("rate", 200, ParameterDescriptor(description="Hz")).value == 200
    assert node.describe_parameter("rate").description == "Hz"
    assert set(node._parameter_overrides) - set(node._parameters) == {"unknown"}
    with pytest.raises(ParameterAlreadyDeclaredException, match="gain"):
        node.declare_parameter("gain", 1.0)
    with pytest.raises(ParameterNotDeclaredException, match="mass"):
        node.get_parameter("mass")


def test_override_of_another_type_is_refused(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2")
    with pytest.raises(
        InvalidParameterTypeException, match="'gain' to '2' of type 'INTEGER', expecting type 'DOUBLE'"
    ):
        Node("control").declare_parameter("gain", 1.0)


def test_parameter_with_a_type_alone_must_be_given(ros: Start) -> None:
    ros("--ros-args", "-p", "policy:=walk.onnx")
    node = Node("control")
    assert node.declare_parameter("policy", Parameter.Type.STRING).value == "walk.onnx"
    node.declare_parameter("model", Parameter.Type.STRING)
    with pytest.raises(ParameterUninitializedException, match="model"):
        node.get_parameter("model")


def test_ranges_hold_at_the_start_and_later(ros: Start) -> None:
    ros("--ros-args", "-p", "steps:=7")
    node = Node("control")
    gain = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)])
    steps = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=10, step=2)])
    node.declare_parameter("gain", 2.0, gain)
    with pytest.raises(InvalidParameterValueException, match="found 7, expected 0 to 10, step 2"):
        node.declare_parameter("steps", 4, steps)
    (result,) = node.set_parameters([Parameter("gain", value=2.5)])
    assert not result.successful
    assert "found 2.5, expected 0.0 to 2.0" in result.reason
    assert node.get_parameter("gain").value == 2.0


def test_callbacks_refuse_and_are_told(ros: Start) -> None:
    ros()
    node, told = Node("control"), []
    node.declare_parameters("limits", [("vx", 1.0), ("vy", 0.5, ParameterDescriptor(read_only=True))])

    def refuse_negative(parameters: list[Parameter]) -> Any:
        bad = [p.name for p in parameters if p.value < 0]
        return SetParametersResult(successful=not bad, reason=f"{bad} below zero")

    node.add_on_set_parameters_callback(refuse_negative)
    node.add_post_set_parameters_callback(told.append)
    assert node.set_parameters_atomically([Parameter("limits.vx", value=0.8)]).successful
    refused = node.set_parameters([Parameter("limits.vx", value=-1.0), Parameter("limits.vx", value=1)])
    assert [result.successful for result in refused] == [False, False]
    assert "below zero" in refused[0].reason
    assert "expected 'DOUBLE' got 'INTEGER'" in refused[1].reason
    assert "read-only" in node.set_parameters([Parameter("limits.vy", value=0.1)])[0].reason
    assert [[p.value for p in parameters] for parameters in told] == [[0.8]]
    assert {name: p.value for name, p in node.get_parameters_by_prefix("limits").items()} == {
        "vx": 0.8,
        "vy": 0.5,
    }


def test_parameter_services_read_and_set(ros: Start) -> None:
    from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

    ros()
    node = Node("control")
    node.declare_parameter("gains.kp", [30.0, 31.0])

    def call(type_: Any, name: str, request: Any) -> Any:
        future = node.create_client(type_, f"/control/{name}").call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        return future.result()

    listed = call(ListParameters, "list_parameters", ListParameters.Request(prefixes=["gains"])).result
    assert (listed.names, listed.prefixes) == (["gains.kp"], ["gains"])
    changed = Parameter("gains.kp", value=[25.0]).to_parameter_msg()
    assert (
        call(SetParameters, "set_parameters", SetParameters.Request(parameters=[changed]))
        .results[0]
        .successful
    )
    (value,) = call(GetParameters, "get_parameters", GetParameters.Request(names=["gains.kp"])).values
    assert list(value.double_array_value) == [25.0]
    unknown = Parameter("gains.ki", value=1.0).to_parameter_msg()
    (result,) = call(SetParameters, "set_parameters", SetParameters.Request(parameters=[unknown])).results
    assert "gains.ki" in result.reason


def test_reentrant_callbacks_run_side_by_side_and_exclusive_ones_do_not(ros: Start) -> None:
    ros()
    node, meeting = Node("workers"), threading.Barrier(2)
    running, overlaps, met = [], [], threading.Event()

    def meet() -> None:
        meeting.wait(timeout=20.0)
        met.set()

    def alone() -> None:
        overlaps.append(len(running))
        running.append(1)
        time.sleep(0.005)
        running.pop()

    group = ReentrantCallbackGroup()
    node.create_timer(0.001, meet, callback_group=group)
    node.create_timer(0.001, meet, callback_group=group)
    node.create_timer(0.001, alone)
    node.create_timer(0.001, alone)
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and not (met.is_set() and len(overlaps) > 5):
        executor.spin_once(timeout_sec=0.1)
    meeting.abort()
    executor._running.clear()
    executor.shutdown()
    assert met.is_set()
    assert set(overlaps) == {0}


def test_multi_threaded_executor_raises_what_a_callback_raised(ros: Start) -> None:
    ros()
    node = Node("faulty")
    node.create_timer(0.001, lambda: 1 / 0)
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    with pytest.raises(ZeroDivisionError):
        executor.spin()
    executor.shutdown()


def test_blocking_call_with_a_spinning_thread(ros: Start) -> None:
    ros()
    node = Node("server")
    node.create_service(SetBool, "allow", lambda request, response: response)
    client = node.create_client(SetBool, "allow")
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    assert client.wait_for_service(timeout_sec=10.0)
    answer = client.call(SetBool.Request(data=True), timeout_sec=10.0)
    rclpy.shutdown()
    thread.join()
    executor.shutdown()
    assert answer == SetBool.Response()


@pytest.mark.parametrize("executor_class", [SingleThreadedExecutor, MultiThreadedExecutor])
def test_executor_is_shut_down_by_another_thread(ros: Start, executor_class: type[Executor]) -> None:
    ros()
    node, failures = Node("idle"), []

    def spin() -> None:
        try:
            executor.spin()
        except BaseException as error:
            failures.append(error)

    for _ in range(5):
        executor = executor_class()
        executor.add_node(node)
        thread = threading.Thread(target=spin)
        thread.start()
        executor.shutdown()
        thread.join(timeout=20.0)
        assert not thread.is_alive()
    assert not failures


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


def test_publishing_after_shutdown_is_refused(ros: Start) -> None:
    ros()
    publisher = Node("talker").create_publisher(String, "chatter", 1)
    rclpy.shutdown()
    with pytest.raises(RuntimeError, match="context is invalid"):
        publisher.publish(String())


def test_init_again_after_shutdown(ros: Start) -> None:
    for _ in range(2):
        ros()
        node = Node("again")
        assert rclpy.ok()
        node.destroy_node()
        rclpy.shutdown()
        assert not rclpy.ok()


def test_times_and_durations_compute() -> None:
    start, span = Time(seconds=10, nanoseconds=5), Duration(seconds=1.5)
    assert start + span - start == span
    assert (start - span).seconds_nanoseconds() == (8, 500_000_005)
    assert Time.from_msg(start.to_msg(), ClockType.SYSTEM_TIME) == start
    assert Duration.from_msg(Duration(nanoseconds=-1).to_msg()).nanoseconds == -1
    assert start < start + span
    with pytest.raises(TypeError, match="different clock types"):
        _ = start < Clock(clock_type=ClockType.STEADY_TIME).now()
    with pytest.raises(ValueError, match="negative"):
        Time(seconds=-1)


def test_options_that_are_not_offered_say_so(ros: Start) -> None:
    ros()
    node = Node("plain")
    with pytest.raises(UnsupportedError, match="create_publisher: option 'event_callbacks'"):
        node.create_publisher(String, "chatter", 1, event_callbacks=object())
    with pytest.raises(UnsupportedError, match=r"Node\.get_node_names"):
        node.get_node_names()

    async def callback() -> None: ...

    with pytest.raises(UnsupportedError, match="coroutine"):
        rclpy.get_global_executor().create_task(callback)


def test_log_lines_have_levels_throttles_and_reach_rosout(
    ros: Start, capsys: pytest.CaptureFixture[str]
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

"""What embedded nodes and those of rclpy say to each other, with Fast DDS on the one side and Cyclone DDS on the other.

Not for what a node computes, nor for the tools of ROS 2: those are in tests/ros.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Empty, String
from std_srvs.srv import SetBool

from quadvel_bringup.stack import Stack
from quadvel_msgs.msg import ControllerState, LowState

RIGHTS = Path(__file__).parents[2] / "ros_ws" / "security" / "node.xml"
TRUTH_RATE = 200  # Hz, of ground_truth/odom
SPEED = 0.5  # m/s
TOPICS = {
    "/low_state": "sim_node",
    "/low_cmd": "controller",
    "/velocity_estimate": "estimator",
    "/command": "command_mux",
}
"""Some topics of the robot, and who publishes them."""


@pytest.mark.parametrize(("body", "brain"), [("rclpy", "embedded"), ("embedded", "rclpy")])
def test_a_robot_walks_whose_body_is_on_one_middleware_and_its_brain_on_the_other(
    graph: Any, body: str, brain: str
) -> None:
    for name, arguments in Stack(use_sim_time=True).arguments().items():
        middleware = body if name == "sim_node" else brain
        graph.start(name, *arguments[1:], embedded=middleware == "embedded")
    modes, truth = (
        graph.listen(ControllerState, "controller/state"),
        graph.listen(Odometry, "ground_truth/odom"),
    )
    velocities = graph.node.create_publisher(Twist, "cmd_vel", 10)

    def ahead() -> Any:
        command = Twist()
        command.linear.x = SPEED
        velocities.publish(command)  # this is asked twenty times a second and more

    def mean() -> float:
        """Of the last second of simulated time, m/s."""
        ahead()
        speeds = [message.twist.twist.linear.x for message in truth[-TRUTH_RATE:]]
        return sum(speeds) / TRUTH_RATE if len(speeds) == TRUTH_RATE else 0.0

    def found() -> str:
        return f"{mean():.3f} m/s after the modes {sorted({message.mode_name for message in modes})}"

    graph.wait(lambda: "stance" in {message.mode_name for message in modes[-1:]}, found)
    graph.wait(lambda: abs(mean() - SPEED) < 0.1, found, 120.0)
    assert "fault" not in {message.mode_name for message in modes}


def test_rclpy_sees_embedded_nodes_their_topics_and_the_same_types(graph: Any) -> None:
    for name in Stack().arguments():
        graph.start(name, embedded=True)
    own = {
        topic: graph.node.create_subscription(kind, topic, lambda _: None, 10)
        for topic, kind in _kinds().items()
    }

    def unseen() -> dict[str, str]:
        seen = {topic: graph.node.get_publishers_info_by_topic(topic) for topic in TOPICS}
        return {
            topic: name
            for topic, name in TOPICS.items()
            if name not in {who.node_name for who in seen[topic]}
        }

    def are_seen() -> bool:
        """Whether all nodes, topics and publishers are discovered, one after the other."""
        nodes = {*graph.node.get_node_names()}
        return not unseen() and {*TOPICS.values()} <= nodes and all(map(graph.node.count_publishers, own))

    graph.wait(are_seen, unseen)
    for topic in own:
        (writer,) = graph.node.get_publishers_info_by_topic(topic)
        readers = graph.node.get_subscriptions_info_by_topic(topic)
        hashes = {
            str(end.topic_type_hash) for end in (writer, *readers)
        }  # the watcher's is by ROS 2's own generator
        assert len(hashes) == 1, (topic, hashes)


def _kinds() -> dict[str, Any]:
    return {"/low_state": LowState, "/controller/state": ControllerState, "/ground_truth/odom": Odometry}


CALL = """
import rclpy
from std_srvs.srv import SetBool
rclpy.init(args=[])
node = rclpy.create_node("caller")
client = node.create_client(SetBool, "switch")
print(client.wait_for_service(timeout_sec=5.0))
rclpy.shutdown()
"""


def test_an_embedded_client_does_not_take_a_service_of_fast_dds_for_one_that_answers(graph: Any) -> None:
    asked: list[Any] = []

    def answer(request: Any, response: Any) -> Any:
        asked.append(request)
        return response

    graph.node.create_service(SetBool, "switch", answer)
    client = graph.program(CALL)
    graph.wait(lambda: client.poll() is not None, lambda: "the client waits for ever")
    assert client.stdout.read() == "False\n"
    assert not asked


SERVE = """
import rclpy
from std_msgs.msg import Empty
from std_srvs.srv import SetBool
rclpy.init(args=[])
node = rclpy.create_node("server")
node.create_service(SetBool, "switch", lambda request, response: print("asked") or response)
node.create_subscription(Empty, "end", lambda _: rclpy.shutdown(), 10)
print("ready", flush=True)
while rclpy.ok():
    rclpy.spin_once(node, timeout_sec=0.5)
"""


def test_an_embedded_service_does_nothing_on_a_request_by_fast_dds_which_it_can_not_answer(
    graph: Any,
) -> None:
    server = graph.program(SERVE)
    assert server.stdout.readline() == "ready\n"
    client = graph.node.create_client(SetBool, "switch")
    graph.wait(client.service_is_ready, lambda: "no service")
    client.call_async(SetBool.Request(data=True))
    assert "asked" not in end(graph, server)


ECHO = """
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Empty, String
rclpy.init(args=[])
node = rclpy.create_node("echo")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# A topic of its own for each: the last answer alone is kept for a watcher that finds us late.
of_latched = node.create_publisher(String, "latched/answer", latched)
of_best_effort = node.create_publisher(String, "best_effort/answer", latched)
node.create_subscription(String, "best_effort", of_best_effort.publish, qos_profile_sensor_data)
print("ready", flush=True)
node.create_subscription(String, "latched", of_latched.publish, latched)
node.create_subscription(Empty, "end", lambda _: rclpy.shutdown(), 10)
while rclpy.ok():
    rclpy.spin_once(node, timeout_sec=0.5)
"""


def test_a_latched_message_and_a_best_effort_one_cross_both_ways(graph: Any) -> None:
    echo = graph.program(ECHO)
    assert echo.stdout.readline() == "ready\n"
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    graph.node.create_publisher(String, "latched", latched).publish(String(data="before"))
    best_effort = graph.node.create_publisher(String, "best_effort", qos_profile_sensor_data)
    heard: list[Any] = []
    for topic in ("latched/answer", "best_effort/answer"):
        graph.node.create_subscription(String, topic, heard.append, latched)
    number = itertools.count()

    def both() -> bool:
        best_effort.publish(String(data=f"try {next(number)}"))
        return any("before" in m.data for m in heard) and any("try" in m.data for m in heard)

    graph.wait(both, lambda: heard)
    end(graph, echo)


def end(graph: Any, program: Any) -> str:
    """Have a program end; returns what it wrote."""
    order = graph.node.create_publisher(Empty, "end", 10)
    graph.wait(lambda: order.publish(Empty()) or program.poll() is not None, lambda: "it goes on")
    return program.stdout.read()


def test_every_enclave_may_offer_what_rclpy_offers_of_a_node_by_itself(graph: Any) -> None:
    services = graph.node.get_service_names_and_types_by_node("watcher", "/")
    allowed = ElementTree.parse(RIGHTS).findall("services[@reply='ALLOW']/service")
    assert {name.replace("/watcher/", "~/") for name, _ in services} == {one.text for one in allowed}

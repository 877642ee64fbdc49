"""Tests of topics: delivery, quality of service, and the format on the wire."""

import math
import time
from collections.abc import Callable

import pytest
import rclpy
from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32, String

Start = Callable[..., None]
SpinUntil = Callable[..., bool]


def test_messages_arrive_in_order(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Int32, "numbers", lambda message: received.append(message.data), 10)
    publisher = node.create_publisher(Int32, "numbers", 10)
    assert publisher.get_subscription_count() == 1
    for number in range(10):
        publisher.publish(Int32(data=number))
    assert spin_until(node, lambda: len(received) == 10)
    assert received == list(range(10))


def test_depth_keeps_the_newest(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Int32, "numbers", lambda message: received.append(message.data), 3)
    publisher = node.create_publisher(Int32, "numbers", 10)
    for number in range(10):
        publisher.publish(Int32(data=number))
    assert spin_until(node, lambda: 9 in received)
    assert received == [7, 8, 9]


def test_nan_and_infinity_are_delivered_as_they_are(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(Twist, "cmd_vel", received.append, 1)
    command = Twist()
    command.linear.x, command.linear.y = math.nan, math.inf
    node.create_publisher(Twist, "cmd_vel", 1).publish(command)
    assert spin_until(node, lambda: received)
    assert math.isnan(received[0].linear.x)
    assert received[0].linear.y == math.inf


def test_transient_local_reaches_late_subscriptions(ros: Start, spin_until: SpinUntil) -> None:
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


def test_callback_may_take_the_message_information(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node, received = Node("listener"), []
    node.create_subscription(String, "chatter", lambda message, info: received.append(info), 1)
    before = time.time_ns()
    node.create_publisher(String, "chatter", 1).publish(String())
    assert spin_until(node, lambda: received)
    assert before <= received[0]["source_timestamp"] <= time.time_ns()


def test_raw_bytes_pass_through(ros: Start, spin_until: SpinUntil) -> None:
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


def test_destroyed_endpoints_leave_the_graph(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node = Node("talker")
    publisher = node.create_publisher(String, "chatter", 1)
    subscription = node.create_subscription(String, "chatter", lambda _: None, 1)
    assert (node.count_publishers("chatter"), publisher.get_subscription_count()) == (1, 1)
    assert ("/chatter", ["std_msgs/msg/String"]) in node.get_topic_names_and_types()
    assert node.destroy_publisher(publisher)
    assert node.destroy_subscription(subscription)
    assert not node.destroy_subscription(subscription)
    assert spin_until(node, lambda: node.count_publishers("chatter") == 0)


def test_only_endpoints_that_changed_are_read_again(ros: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    ros()
    node = Node("talker")
    for i in range(40):
        node.create_publisher(String, f"chatter_{i}", 1)
    place = node.context.participant
    before = len(place.endpoints("publication"))
    assert before > 40
    read, builtin = [], place._builtin["publication"]
    take = builtin.read
    monkeypatch.setattr(builtin, "read", lambda **words: read.extend(found := take(**words)) or found)
    one = node.create_publisher(String, "one_more", 1)
    assert len(place.endpoints("publication")) == before + 1
    node.destroy_publisher(one)
    assert len(place.endpoints("publication")) == before
    assert len(read) == 2


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


def test_publishing_after_shutdown_is_refused(ros: Start) -> None:
    ros()
    publisher = Node("talker").create_publisher(String, "chatter", 1)
    rclpy.shutdown()
    with pytest.raises(RuntimeError, match="context is invalid"):
        publisher.publish(String())

"""Warnings about publishers whose type differs from the subscriptions of a topic."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import LaserScan, PointCloud2

import quadvel_dds
from quadvel_nodes.topic_types import ConflictWatch, TypeConflict, all_conflicts, conflicts_of

STAMPED, PLAIN = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"

pytestmark = pytest.mark.skipif(
    not rclpy.__file__.startswith(quadvel_dds.__path__[0]),
    reason="Fast DDS has one type for each topic of a process; these tests put two in one",
)


@pytest.fixture
def make() -> Iterator[Callable[[str], Any]]:
    rclpy.init()
    nodes: list[Any] = []

    def one(name: str) -> Any:
        nodes.append(rclpy.create_node(name))
        return nodes[-1]

    yield one
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def until(found: Callable[[], Any]) -> Any:
    end = time.monotonic() + 20.0
    while not found() and time.monotonic() < end:
        time.sleep(0.05)
    return found()


@pytest.mark.parametrize(
    ("published", "expected", "names"),
    [
        (TwistStamped, Twist, (STAMPED, PLAIN)),
        (Twist, TwistStamped, (PLAIN, STAMPED)),
        (PointCloud2, LaserScan, ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan")),
    ],
)
def test_a_publisher_of_another_type_is_named_by_the_listener_and_by_a_bystander(
    make: Callable[[str], Node], published: Any, expected: Any, names: tuple[str, str]
) -> None:
    listener, talker, bystander = make("listener"), make("talker"), make("bystander")
    listener.create_subscription(expected, "input", lambda _: None, 10)
    talker.create_publisher(expected, "input", 10)
    assert until(lambda: listener.count_publishers("input"))
    assert not conflicts_of(listener)
    wrong = talker.create_publisher(published, "input", 10)
    conflict = TypeConflict("/input", *names)
    assert until(lambda: conflicts_of(listener)) == [conflict]
    assert all_conflicts(bystander) == [conflict]
    talker.destroy_publisher(wrong)
    assert until(lambda: not conflicts_of(listener))


def test_a_node_warns_once_of_each_conflict(
    make: Callable[[str], Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    listener, talker = make("listener"), make("talker")
    listener.create_subscription(Twist, "cmd_vel", lambda _: None, 10)
    talker.create_publisher(TwistStamped, "cmd_vel", 10)
    warnings: list[str] = []
    monkeypatch.setattr(listener.get_logger(), "warning", warnings.append)
    watch = ConflictWatch(listener)
    assert until(lambda: watch.check() or warnings)
    watch.check()
    assert len(warnings) == 1
    assert "stamped: true" in warnings[0]

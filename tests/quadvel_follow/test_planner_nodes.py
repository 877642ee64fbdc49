"""Tests of the planner nodes over DDS: commands, and when they stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as Way
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from quadvel_follow.follow_planner_node import FollowPlannerNode
from quadvel_follow.trajectory_planner import TrajectoryPlanner
from quadvel_msgs.msg import ControllerState
from quadvel_nodes.node import _exit_requests

RECEIVED = {
    "cmd_vel_follow": Twist,
    "cmd_vel": Twist,
    "follow_planner/state": String,
    "follow_planner/path": Way,
}
STEP = 0.05  # s, between two messages


class Peer:
    """A robot at rest on the system clock, and a receiver of its commands."""

    def __init__(self, kind: type[Any], arguments: list[str]) -> None:
        rclpy.init(args=["--ros-args", *arguments])
        self._executor = SingleThreadedExecutor()
        self.node = rclpy.create_node("peer", use_global_arguments=False)
        self.tested = kind()
        for node in (self.tested, self.node):
            self._executor.add_node(node)
        self.heard: dict[str, list[Any]] = {topic: [] for topic in RECEIVED}
        for topic, message in RECEIVED.items():
            self.node.create_subscription(message, topic, self.heard[topic].append, 50)
        self._publishers = {
            "scan": self.node.create_publisher(LaserScan, "scan", 10),
            "odom": self.node.create_publisher(Odometry, "odom", 10),
            "person/odometry": self.node.create_publisher(Odometry, "person/odometry", 10),
        }

    def wait(
        self, is_so: Callable[[], Any], meanwhile: Callable[[], None] = lambda: None, seconds: float = 30.0
    ) -> None:
        """Serve, and send once in STEP, until the predicate holds."""
        end = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < end, {"refused": self.tested._refusals.values()} | {
                topic: messages[-1:] for topic, messages in self.heard.items()
            }
            meanwhile()
            again = time.monotonic() + STEP
            while (left := again - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)

    def send(self, topic: str, message: Any, frame: str) -> None:
        message.header.stamp, message.header.frame_id = self.node.get_clock().now().to_msg(), frame
        self._publishers[topic].publish(message)

    def send_odometry(self) -> None:
        message = Odometry()
        message.pose.pose.orientation.w = 1.0
        self.send("odom", message, "odom")

    def send_all(self, scan: bool = True) -> None:
        """Odometry, a person 3 m ahead who stands, and a scan in which nothing else is."""
        self.send_odometry()
        person = Odometry()
        person.pose.pose.position.x, person.pose.pose.orientation.w = 3.0, 1.0
        person.pose.covariance = (0.01 * np.eye(6)).ravel()
        self.send("person/odometry", person, "odom")
        if scan:
            empty = LaserScan(range_min=0.05, range_max=12.0)
            empty.angle_min, empty.angle_max = -0.75 * np.pi, 0.75 * np.pi
            empty.angle_increment = float(np.radians(0.5))
            empty.ranges = [float("inf")] * 541
            self.send("scan", empty, "laser")

    def speeds(self, topic: str) -> list[float]:
        """Every vx that was commanded on a topic, m/s."""
        return [message.linear.x for message in self.heard[topic]]

    def close(self) -> None:
        self._executor.shutdown()
        rclpy.shutdown()


@pytest.fixture
def begin() -> Iterator[Callable[..., Peer]]:
    peers: list[Peer] = []

    def make(kind: type[Any], *arguments: str) -> Peer:
        peers.append(Peer(kind, list(arguments)))
        return peers[-1]

    yield make
    for peer in peers:
        peer.close()


def test_a_person_ahead_is_approached_and_without_scans_the_robot_stops(begin: Callable[..., Peer]) -> None:
    peer = begin(FollowPlannerNode, "-p", "laser_x:=0.3")
    peer.wait(lambda: max(peer.speeds("cmd_vel_follow"), default=0.0) > 0.5, peer.send_all)
    assert peer.heard["follow_planner/state"][-1].data == "following: follows"
    way = peer.heard["follow_planner/path"][-1]
    assert way.header.frame_id == "odom"
    assert 0.2 < way.poses[-1].pose.position.x < 2.0
    peer.wait(lambda: peer.speeds("cmd_vel_follow")[-1] == 0.0, lambda: peer.send_all(scan=False))
    assert peer.heard["follow_planner/state"][-1].data == "blind: the scan is silent"


def test_a_robot_that_does_not_walk_yet_is_commanded_zero_and_followed_once_it_does(
    begin: Callable[..., Peer],
) -> None:
    peer = begin(FollowPlannerNode)
    controller = peer.node.create_publisher(ControllerState, "controller/state", 1)
    refusal = "a zero velocity has to be commanded first"

    def send() -> None:
        controller.publish(ControllerState(walk_refusal=refusal, walk_allowed=not refusal))
        peer.send_all()

    state = peer.heard["follow_planner/state"]
    peer.wait(lambda: state[-1:] and state[-1].data == f"waiting: the robot does not walk: {refusal}", send)
    assert set(peer.speeds("cmd_vel_follow")) == {0.0}
    refusal = ""
    peer.wait(lambda: peer.speeds("cmd_vel_follow")[-1] > 0.5, send)


def test_before_anything_is_heard_the_follower_commands_zero_and_says_why(begin: Callable[..., Peer]) -> None:
    peer = begin(FollowPlannerNode)
    peer.wait(lambda: len(peer.heard["cmd_vel_follow"]) > 3)
    assert set(peer.speeds("cmd_vel_follow")) == {0.0}
    assert peer.heard["follow_planner/state"][-1].data == "blind: there was no odometry yet"


def test_a_way_is_walked_to_its_end_and_ends_with_zero(
    begin: Callable[..., Peer], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "way.csv").write_text("seconds,vx,vy,wz\n0.5,0.4,0,0\n0.5,0.4,0,0.2\n")
    peer = begin(TrajectoryPlanner, "-p", f"file:={tmp_path / 'way.csv'}")
    peer.wait(lambda: peer.speeds("cmd_vel")[-1:] == [0.4])
    peer.wait(lambda: peer.speeds("cmd_vel")[-1] == 0.0)
    assert "arrived" in "".join(capfd.readouterr())


def test_in_closed_loop_a_way_begins_with_the_first_odometry(begin: Callable[..., Peer]) -> None:
    peer = begin(TrajectoryPlanner, "-p", "file:=eight", "-p", "closed_loop:=true")
    until = time.monotonic() + 0.5
    peer.wait(lambda: time.monotonic() > until)
    assert set(peer.speeds("cmd_vel")) <= {0.0}
    peer.wait(lambda: max(peer.speeds("cmd_vel"), default=0.0) > 0.1, peer.send_odometry)


def test_a_way_begins_once_the_robot_walks(begin: Callable[..., Peer]) -> None:
    peer = begin(TrajectoryPlanner, "-p", "file:=eight")
    controller = peer.node.create_publisher(ControllerState, "controller/state", 1)
    refusal = "the robot is in mode passive"

    def send() -> None:
        controller.publish(ControllerState(walk_refusal=refusal))

    peer.wait(lambda: peer.tested._refusal, send)
    heard = len(peer.heard["cmd_vel"])
    peer.wait(lambda: len(peer.heard["cmd_vel"]) > heard + 20, send)
    assert set(peer.speeds("cmd_vel")[heard + 5 :]) == {0.0}
    refusal = ""
    peer.wait(lambda: max(peer.speeds("cmd_vel")) > 0.1, send)


def test_a_way_ends_with_the_reason_where_the_robot_stops_following(
    begin: Callable[..., Peer], capfd: pytest.CaptureFixture[str]
) -> None:
    peer = begin(TrajectoryPlanner, "-p", "file:=eight")
    controller = peer.node.create_publisher(ControllerState, "controller/state", 1)
    state = ControllerState(findings=["the command is clamped"])
    peer.wait(lambda: max(peer.speeds("cmd_vel"), default=0.0) > 0.1, lambda: controller.publish(state))
    state.walk_refusal = "the robot is in mode fault"
    peer.wait(lambda: peer.tested in _exit_requests, lambda: controller.publish(state))
    assert "the robot is in mode fault" in _exit_requests[peer.tested]
    assert "controller: the command is clamped" in "".join(capfd.readouterr())
    peer.wait(lambda: peer.speeds("cmd_vel")[-1] == 0.0)

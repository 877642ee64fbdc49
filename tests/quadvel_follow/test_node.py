"""Tests of the tracker node over DDS: published person, selection, refusals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import LaserScan
from visualization_msgs.msg import Marker, MarkerArray

from quadvel_eval.people.laser import FloorPlan, Laser
from quadvel_eval.people.scenes import Scene
from quadvel_follow import person_tracker_node
from quadvel_follow.free_space import to_frame
from quadvel_msgs.srv import SelectPerson
from quadvel_sim.walker import Walker

LASER = Laser(rays=540, angle_min=-0.75 * np.pi, angle_increment=np.deg2rad(0.5))
MOUNTED = (0.3, 0.0)  # m, ahead of the robot's middle
RECEIVED = {
    "person": PoseStamped,
    "person/odometry": Odometry,
    "person_tracker/markers": MarkerArray,
    "/diagnostics": DiagnosticArray,
}


class Bench:
    """The node under test and a peer that feeds it, served by one executor."""

    def __init__(self, arguments: list[str]) -> None:
        rclpy.init(args=["--ros-args", *arguments])
        self._executor = SingleThreadedExecutor()
        peer = rclpy.create_node("peer", use_global_arguments=False)
        for node in (person_tracker_node.PersonTrackerNode(), peer):
            self._executor.add_node(node)
        self.heard: dict[str, list[Any]] = {topic: [] for topic in RECEIVED}
        for topic, kind in RECEIVED.items():
            peer.create_subscription(kind, topic, self.heard[topic].append, 50)
        self.scans = peer.create_publisher(LaserScan, "scan", 10)
        self.odom = peer.create_publisher(Odometry, "odom", 10)
        self.select = peer.create_client(SelectPerson, "select_person")
        self.wait(lambda: self.scans.get_subscription_count() and all(map(peer.count_publishers, RECEIVED)))
        self.wait(self.select.service_is_ready)

    def wait(self, is_so: Callable[[], Any], seconds: float = 30.0) -> None:
        """Serve until the predicate holds; fail with what was heard when the time is up."""
        end = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < end, {topic: len(messages) for topic, messages in self.heard.items()}
            self._executor.spin_once(timeout_sec=0.05)

    def send(self, at: float, ranges: np.ndarray, robot: np.ndarray | None) -> None:
        """Publish a scan at `at` s between two poses; wait until the node has processed it."""
        known = len(self.heard["person_tracker/markers"])
        for shift in (-0.01, 0.01):
            if robot is not None:
                self.odom.publish(odometry(at + shift, robot))
            if shift < 0.0:
                self.scans.publish(scan(at, ranges))
        self.wait(lambda: len(self.heard["person_tracker/markers"]) > known)

    def ask(self, identity: int) -> Any:
        """The answer of select_person."""
        answer = self.select.call_async(SelectPerson.Request(id=identity))
        self.wait(answer.done)
        return answer.result()

    def close(self) -> None:
        self._executor.shutdown()
        rclpy.shutdown()


def stamped(message: Any, at: float, frame: str) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = int(at), round(1e9 * (at % 1.0))
    message.header.frame_id = frame
    return message


def scan(at: float, ranges: np.ndarray) -> Any:
    message = stamped(LaserScan(), at, "laser")
    message.angle_min, message.angle_increment = LASER.angle_min, float(LASER.angle_increment)
    message.angle_max = float(LASER.angles[-1])
    message.range_min, message.range_max = 0.05, LASER.range_max
    message.ranges = ranges.astype(np.float32).tolist()
    return message


def odometry(at: float, robot: np.ndarray) -> Any:
    message = stamped(Odometry(), at, "odom")
    message.pose.pose.position.x, message.pose.pose.position.y = float(robot[0]), float(robot[1])
    message.pose.pose.orientation.z = float(np.sin(robot[2] / 2))
    message.pose.pose.orientation.w = float(np.cos(robot[2] / 2))
    return message


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = Bench(getattr(request, "param", ["-p", f"laser_x:={MOUNTED[0]}"]))
    yield bench
    bench.close()


def feed(bench: Bench, robot: np.ndarray | None, seconds: float = 3.0, start: float = 100.0) -> np.ndarray:
    """A person who walks before the laser of a robot that stands at `robot`; where the person is at last."""
    pose = np.zeros(3) if robot is None else np.array([*to_frame(np.array([MOUNTED]), robot)[0], robot[2]])
    way = to_frame(np.array([[3.0, -2.0], [3.0, 2.0]]), pose)
    scene = Scene(
        LASER,
        10.0,
        FloorPlan(),
        [Walker(way=way, speed=1.2)],
        seconds,
        np.random.default_rng(0),
        lambda _: pose,
    )
    for instant in scene.scans():
        bench.send(start + instant.time, instant.ranges, robot)
    return instant.people[0]


def test_a_person_before_a_turned_robot_is_published_in_the_frame_of_its_odometry(bench: Bench) -> None:
    person = feed(bench, np.array([5.0, 1.0, 2.0]))
    bench.wait(lambda: bench.heard["person"] and bench.heard["person"][-1].header.stamp.nanosec > 850_000_000)
    published, moving = bench.heard["person"][-1], bench.heard["person/odometry"][-1]
    assert (published.header.frame_id, moving.header.frame_id) == ("odom", "odom")
    assert np.hypot(published.pose.position.x - person[0], published.pose.position.y - person[1]) < 0.2
    assert published.header.stamp == moving.header.stamp
    assert moving.twist.twist.linear.x == pytest.approx(1.2, abs=0.3)
    heading = 2.0 * np.arctan2(published.pose.orientation.z, published.pose.orientation.w)
    assert np.cos(heading - 2.0 - np.pi / 2) > 0.9
    covariance = np.reshape(moving.pose.covariance, (6, 6))
    assert 0.0 < covariance[0, 0] < 0.1
    shown = bench.heard["person_tracker/markers"][-1].markers
    assert shown[0].action == Marker.DELETEALL
    assert {marker.type for marker in shown[1:]} == {Marker.CYLINDER, Marker.TEXT_VIEW_FACING}


@pytest.mark.parametrize("bench", [["-p", "use_odom:=false", "-p", "select_nearest:=false"]], indirect=True)
def test_nobody_is_meant_before_select_person_is_asked(bench: Bench) -> None:
    feed(bench, None)
    assert bench.heard["person"] == []
    refused = bench.ask(999)
    assert not refused.success
    assert "id is 999, expected one that is tracked" in refused.message
    answer = bench.ask(0)
    assert (answer.success, answer.message) == (True, f"person {answer.selected} is selected")
    feed(bench, None, 1.0, start=103.0)
    bench.wait(lambda: bench.heard["person/odometry"])
    assert bench.heard["person/odometry"][-1].child_frame_id == f"person_{answer.selected}"
    assert bench.heard["person"][-1].header.frame_id == "laser"


def test_scans_that_are_none_are_counted_with_the_reason(bench: Bench) -> None:
    robot = np.zeros(3)
    bench.odom.publish(odometry(99.0, robot))
    wrong = scan(100.0, np.ones(540))
    wrong.angle_increment = 0.0
    bench.scans.publish(wrong)
    bench.odom.publish(odometry(101.0, robot))

    def values() -> list[str]:
        return [pair.value for message in bench.heard["/diagnostics"] for pair in message.status[0].values]

    bench.wait(lambda: any("angle_increment is 0.0, expected a step" in value for value in values()))

"""Time: timers, simulated time, points in time and spans."""

import time
from collections.abc import Callable

import pytest
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

Start = Callable[..., None]
SpinUntil = Callable[..., bool]


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


def test_a_timer_goes_on_where_simulated_time_goes_back(ros: Start) -> None:
    ros("--ros-args", "-p", "use_sim_time:=true")
    node, calls = Node("control", start_parameter_services=False), []
    node.create_timer(0.1, lambda: calls.append(node.get_clock().now().nanoseconds / 1e9))
    for now in (100.05, 100.27, 0.02, 0.13, 0.24):
        drive_clock(node, now)
    assert 100.27 in calls
    assert [call for call in calls if call < 50.0] == [0.13, 0.24]


def test_simulated_time_comes_from_the_clock_topic(ros: Start, spin_until: SpinUntil) -> None:
    ros()
    node = Node("control", parameter_overrides=[Parameter("use_sim_time", value=True)])
    assert node.get_clock().now().nanoseconds == 0
    message = ClockMessage()
    message.clock.sec = 42
    node.create_publisher(ClockMessage, "/clock", 1).publish(message)
    assert spin_until(node, lambda: node.get_clock().now().nanoseconds == 42 * 10**9)
    node.set_parameters([Parameter("use_sim_time", value=False)])
    assert abs(node.get_clock().now().nanoseconds - time.time_ns()) < 10**10


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

"""Tests of timers, simulated time, times and durations."""

from collections.abc import Callable

import pytest
import rclpy
from rclpy.clock import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

from quadvel_dds import UnsupportedError

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


def test_times_become_messages_and_come_back() -> None:
    start = Time(seconds=10, nanoseconds=5)
    assert Time.from_msg(start.to_msg(), ClockType.SYSTEM_TIME).nanoseconds == 10**10 + 5
    with pytest.raises(ValueError, match="negative"):
        Time(seconds=-1)


def test_what_is_not_offered_of_times_is_refused_and_not_done_otherwise() -> None:
    with pytest.raises(UnsupportedError, match="comparing times"):
        _ = Time() == Time()
    with pytest.raises(UnsupportedError, match="computing with times"):
        _ = Time() - Time()
    with pytest.raises(UnsupportedError, match="comparing durations"):
        _ = Duration() < Duration()

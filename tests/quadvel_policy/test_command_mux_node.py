"""The node `command_mux` over DDS: velocities in, one command out, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quadvel_msgs.msg import VelocityCommand
from quadvel_nodes.node import StartError
from quadvel_policy.command_mux_node import CommandMuxNode

PERIOD = 0.02


class Desk:
    """The node, and someone who speaks on its topics."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.commands = graph.listen(VelocityCommand, "command")

    def step(self, n: int = 1, publisher: Any = None, message: Any = None) -> Any:
        """Let `n` updates pass, before each of which the message is sent; returns the last command."""
        for _ in range(n):
            if publisher is not None:
                if hasattr(message, "header"):
                    message.header.stamp = self.graph.stamp()
                publisher.publish(message)
            before = len(self.commands)
            self.graph.pass_time(PERIOD)
            self.graph.wait(lambda count=before: len(self.commands) > count)
        return self.commands[-1]


def twist(vx: float, wz: float = 0.0) -> Any:
    message = Twist()
    message.linear.x, message.angular.z = vx, wz
    return message


@pytest.fixture
def desk(graph: Callable[..., Any]) -> Desk:
    return Desk(graph(CommandMuxNode))


def test_silence_is_stance(desk: Desk) -> None:
    command = desk.step(3)
    assert (command.stance, command.source, command.twist.linear.x) == (True, "none", 0.0)
    assert command.stamp.sec == 1000


def test_a_twist_is_followed_and_its_end_is_stance(desk: Desk) -> None:
    teleop = desk.graph.speak(Twist, "cmd_vel_teleop")
    command = desk.step(20, teleop, twist(0.4, 0.2))
    assert (command.stance, command.source) == (False, "teleop")
    assert command.twist.linear.x == pytest.approx(0.4)
    assert command.twist.angular.z == pytest.approx(0.2)
    command = desk.step(40)
    assert (command.stance, command.source, command.twist.linear.x) == (True, "none", 0.0)


def test_numbers_that_are_not_finite_are_refused_counted_and_named(desk: Desk) -> None:
    teleop = desk.graph.speak(Twist, "cmd_vel_teleop")
    desk.step(20, teleop, twist(0.4))
    for bad in (np.nan, np.inf):
        command = desk.step(1, teleop, twist(bad))
    assert command.twist.linear.x == pytest.approx(0.4)
    status = desk.graph.diagnosed("refused cmd_vel_teleop: 2, last: linear is [inf, 0.0, 0.0]")
    assert (status.name, status.level) == ("command_mux", DiagnosticStatus.WARN)


def test_a_lock_and_the_stance_service_stop_the_robot(desk: Desk) -> None:
    teleop, lock = desk.graph.speak(Twist, "cmd_vel_teleop"), desk.graph.speak(Bool, "command_lock")
    desk.step(10, teleop, twist(0.2))
    lock.publish(Bool(data=True))
    assert desk.step(10, teleop, twist(0.2)).stance
    desk.graph.diagnosed("locked by command_lock")
    lock.publish(Bool(data=False))
    assert not desk.step(10, teleop, twist(0.2)).stance
    assert desk.graph.call(SetBool, "command_mux/stance", data=True).success
    assert desk.step(10, teleop, twist(0.2)).stance
    assert desk.graph.call(SetBool, "command_mux/stance", data=False).success
    assert not desk.step(10, teleop, twist(0.2)).stance


def test_stamped_twists_are_followed_and_old_ones_refused(graph: Callable[..., Any]) -> None:
    lists = ["names:=[nav]", "topics:=[plan]", "priorities:=[1]", "timeouts:=[0.3]", "stamped:=true"]
    desk = Desk(graph(CommandMuxNode, *(argument for text in lists for argument in ("-p", text))))
    plan = desk.graph.speak(TwistStamped, "plan")
    message = TwistStamped(twist=twist(0.4))
    assert desk.step(10, plan, message).source == "nav"
    old = TwistStamped(twist=twist(0.4))
    old.header.stamp = desk.graph.stamp(-1.0)
    plan.publish(old)
    desk.step()
    desk.graph.diagnosed("refused plan: 1, last: stamp is 1.0")


@pytest.mark.parametrize(
    ("parameter", "sentence"),
    [
        ("timeouts:=[0.5]", "timeouts has 1 entries, expected 3"),
        ("timeouts:=[0.5, 0.5, -1.0]", "timeout"),
        ("priorities:=[1, 1, 2]", "priority list"),
        ("acceleration:=[1.0, 0.0, 1.0]", "acceleration is"),
        ("lock:=true", "unknown parameter lock"),
    ],
)
def test_parameters_that_make_no_sense_are_refused_in_one_sentence(parameter: str, sentence: str) -> None:
    rclpy.init(args=["--ros-args", "-p", parameter])
    try:
        with pytest.raises((StartError, ValueError), match=sentence):
            CommandMuxNode()
    finally:
        rclpy.shutdown()


def test_a_second_mux_on_the_same_topic_refuses_to_start(graph: Callable[..., Any]) -> None:
    graph(CommandMuxNode)
    with pytest.raises(StartError, match="command is already published"):
        CommandMuxNode()


def test_a_second_mux_on_a_topic_of_its_own_starts(graph: Callable[..., Any]) -> None:
    others: list[Any] = []

    def beside_another() -> CommandMuxNode:
        others.append(rclpy.create_node("first", use_global_arguments=False))
        others[0].create_publisher(VelocityCommand, "command", 10)
        return CommandMuxNode()

    node = graph(beside_another, "-r", "command:=/test/command").node
    assert node.count_publishers("/test/command") == 1

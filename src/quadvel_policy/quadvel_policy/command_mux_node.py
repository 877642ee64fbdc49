"""The node `command_mux`: topics and services of `command_mux.CommandMux`."""

from __future__ import annotations

from functools import partial
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quadvel_description.fields import field
from quadvel_msgs.msg import VelocityCommand
from quadvel_nodes.diagnostics import diagnostics
from quadvel_nodes.messages import MessageError, Refusals, seconds
from quadvel_nodes.node import create_only_publisher, read_parameters, run

from .command_mux import CommandMux, MuxConfig, MuxInput, MuxOutput
from .received import StampCheck, planar_velocity

COMMAND = "command"
PERIOD_S = 0.02  # period of the topic COMMAND


@attrs.frozen(kw_only=True)
class MuxParameters(MuxConfig):
    """Parameters of the node; the lists of the inputs have one entry per input.

    Attributes:
        names: Name of each input.
        topics: Topic of each input.
        priorities: Priority of each input; the highest wins.
        timeouts: Time after which a silent input is inactive, s.
        lock_topics: Topics of type std_msgs/Bool that stop the robot while true.
        stamped: Whether the inputs are TwistStamped instead of Twist.

    Raises:
        ValueError: The lists have different lengths; raised by the constructor.
    """

    names: tuple[str, ...] = field(("teleop", "follow", "planner"), "name of each input")
    topics: tuple[str, ...] = field(("cmd_vel_teleop", "cmd_vel_follow", "cmd_vel"), "topic of each input")
    priorities: tuple[int, ...] = field((100, 50, 10), "priority of each input, the highest wins")
    timeouts: tuple[float, ...] = field((0.5, 0.15, 0.5), "silence after which each input is out, s")
    lock_topics: tuple[str, ...] = field(("command_lock",), "std_msgs/Bool topics: true stops the robot")
    stamped: bool = field(False, "inputs are TwistStamped instead of Twist")

    def __attrs_post_init__(self) -> None:
        for name in ("topics", "priorities", "timeouts"):
            found = len(getattr(self, name))
            if found != len(self.names):
                raise ValueError(f"{name} has {found} entries, expected {len(self.names)} as names has")

    def inputs(self) -> list[MuxInput]:
        """Return the inputs, in the order of the lists.

        Returns:
            The inputs.

        Raises:
            ValueError: A timeout is not positive.
        """
        lists = zip(self.names, self.priorities, self.timeouts, strict=True)
        return [MuxInput(name, priority, timeout) for name, priority, timeout in lists]


class CommandMuxNode(Node):
    """Connects a CommandMux to topics and services."""

    def __init__(self) -> None:
        super().__init__("command_mux")
        settings = read_parameters(self, MuxParameters)
        inputs = settings.inputs()
        self._mux = CommandMux(inputs, settings)
        self._refusals = Refusals()
        self._output: MuxOutput | None = None
        self._message = VelocityCommand()
        kind = TwistStamped if settings.stamped else Twist
        for source, topic in zip(inputs, settings.topics, strict=True):
            check = StampCheck(source.timeout) if settings.stamped else None
            self.create_subscription(kind, topic, partial(self._on_velocity, source.name, topic, check), 10)
        for topic in settings.lock_topics:
            self.create_subscription(Bool, topic, partial(self._on_lock, topic), 10)
        self.create_service(SetBool, "~/stance", self._on_stance)
        self._command = create_only_publisher(
            self,
            VelocityCommand,
            COMMAND,
            10,
            "`quadvel up` starts a mux itself and takes its parameters from a file: --params FILE",
        )
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # continues if the system clock is set back
        simulated = self.get_parameter("use_sim_time").value
        self.create_timer(PERIOD_S, self._update, clock=self.get_clock() if simulated else steady)
        self.create_timer(1.0, self._report, clock=steady)
        self.get_logger().info(f"takes velocities from {', '.join(settings.topics)}")

    def _now(self) -> float:
        return float(1e-9 * self.get_clock().now().nanoseconds)

    def _on_velocity(self, name: str, topic: str, check: StampCheck | None, message: Any) -> None:
        try:
            if check is not None:
                check.check(seconds(message.header.stamp), self._now())
            twist = message if check is None else message.twist
            self._mux.receive(name, self._now(), planar_velocity(twist))
        except MessageError as error:
            self._refusals.add(topic, error)

    def _on_lock(self, topic: str, message: Any) -> None:
        if message.data:
            self._mux.locks.add(topic)
        else:
            self._mux.locks.discard(topic)

    def _on_stance(self, request: Any, response: Any) -> Any:
        self._mux.stance_requested = request.data
        response.success = True
        response.message = "the robot is asked to stand still" if request.data else "commands are followed"
        return response

    def _update(self) -> None:
        before, output = self._output, self._mux.update(self._now())
        self._output = output
        if before is not None and output.source != before.source:
            self._log_source(output.source)
        message, twist = self._message, self._message.twist
        message.stamp = self.get_clock().now().to_msg()
        message.stance, message.source = output.stance, output.source
        twist.linear.x, twist.linear.y, twist.angular.z = output.velocity.tolist()
        self._command.publish(message)

    def _log_source(self, source: str) -> None:
        """Log the new source, or why there is none."""
        if source != "none":
            self.get_logger().info(f"follows {source}")
        elif self._mux.locks:
            self.get_logger().warning(f"stops: locked by {', '.join(sorted(self._mux.locks))}")
        else:
            why = "stance was requested" if self._mux.stance_requested else "no source commands a velocity"
            self.get_logger().info(f"stands still: {why}")

    def _report(self) -> None:
        """Publish /diagnostics, at 1 Hz."""
        refused = self._refusals.last_second()
        source = self._output.source if self._output else "none"
        if refused:
            level, summary = DiagnosticStatus.WARN, refused
        elif self._mux.locks:
            level, summary = DiagnosticStatus.OK, f"locked by {', '.join(sorted(self._mux.locks))}"
        elif self._mux.stance_requested:
            level, summary = DiagnosticStatus.OK, "stance was requested"
        else:
            level, summary = DiagnosticStatus.OK, f"source: {source}"
        values = {
            "source": source,
            "locks": ", ".join(sorted(self._mux.locks)) or "none",
            "stance_requested": self._mux.stance_requested,
            **self._refusals.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))


def main(args: list[str] | None = None) -> None:
    """Run the node `command_mux`.

    Args:
        args: Command line arguments; None for those of the process.
    """
    run(CommandMuxNode, args)

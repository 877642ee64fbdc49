"""`quadvel status`: health, mode, velocity, rates and files of the running robot.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import attrs
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rich.console import Console
from rich.text import Text

from quadvel_description.kinematics import roll_pitch
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_msgs.msg import ControllerState, LowState, VelocityCommand
from quadvel_nodes.number_text import number_text
from quadvel_nodes.topic_types import all_conflicts

from .discovery_hint import discovery_hint
from .drive import twist_to_array, velocity_text
from .exclusivity import describe_robots
from .operator_commands import RECOVERY_HINT
from .session import DISCOVERY_TIMEOUT_S, Session

LISTEN_TIME_S = 2.2
"""Minimum time to listen; each node reports once a second."""
LOOP_NODES = {"command_mux", "controller", "estimator"}
"""Nodes that every walking robot has; status waits for them because discovery may take seconds."""
STATUS_TOPICS = {
    "/diagnostics": DiagnosticArray,
    "controller/state": ControllerState,
    "command": VelocityCommand,
    "low_state": LowState,
    "odom": Odometry,
    "velocity_estimate": TwistWithCovarianceStamped,
}
FILE_KEYS = ("robot", "actuator", "policy")
"""Keys of /diagnostics with the files of a node."""
RATES = ("low_state", "velocity_estimate", "controller/state", "command", "odom")
LEVELS = {
    DiagnosticStatus.OK: Text("ok", style="green"),
    DiagnosticStatus.WARN: Text("warning", style="yellow"),
    DiagnosticStatus.ERROR: Text("error", style="bold red"),
    DiagnosticStatus.STALE: Text("stale", style="red"),
}
Heard = Mapping[str, deque[Any]]


@attrs.frozen
class NodeReport:
    """The last diagnostics of a node.

    Attributes:
        level: Level of DiagnosticStatus.
        summary: Its message.
        values: Its keys and values.
    """

    level: bytes
    summary: str
    values: dict[str, str]


def status(joints: bool = False) -> int:
    """Print the status of the running robot.

    Args:
        joints: Whether to print joints and IMU, too.

    Returns:
        The exit code: 1 if no robot runs, its controller is missing or in fault, or a node reports an
        error.
    """
    with Session("status") as session:
        heard = {topic: session.listen(kind, topic, keep=1000) for topic, kind in STATUS_TOPICS.items()}
        _wait_for_reports(session, heard["/diagnostics"])
        conflicts = [
            _labelled(DiagnosticStatus.WARN, str(conflict)) for conflict in all_conflicts(session.node)
        ]
        robots = session.node.count_publishers("low_state")
        if robots > 1:
            conflicts.append(
                _labelled(
                    DiagnosticStatus.ERROR,
                    f"low_state has {robots} publishers, expected 1: end all but one; "
                    f"they are {describe_robots()}; the lines show one node of each name",
                )
            )
    nodes = nodes_from_diagnostics(heard["/diagnostics"])
    if not nodes:
        print(f"no robot runs; start one: quadvel up; {discovery_hint()}")
        return 1
    console = Console(markup=False, soft_wrap=True, highlight=False)
    rows = [
        *_nodes(nodes),
        *(("topic", conflict) for conflict in conflicts),
        *_lines(heard),
        *_equipment(nodes),
        *(_measurements(heard["low_state"]) if joints else ()),
    ]
    width = max(13, *(len(name) for name, _ in rows))
    for name, text in rows:
        console.print(Text.assemble(f"{name:{width}} ", text))
    states = heard["controller/state"]
    failed = any(node.level == DiagnosticStatus.ERROR for node in nodes.values())
    return 1 if failed or robots > 1 or not states or states[-1].mode_name == "fault" else 0


def running_nodes() -> dict[str, NodeReport]:
    """List the nodes of the running robot.

    Returns:
        Diagnostics by name of the node; empty without a robot.
    """
    with Session("look") as session:
        heard = session.listen(DiagnosticArray, "/diagnostics", keep=100)
        _wait_for_reports(session, heard)
    return nodes_from_diagnostics(heard)


def _wait_for_reports(session: Session, heard: deque[Any]) -> None:
    """Listen until all nodes that publish /diagnostics have reported, or until a timeout."""
    if not session.spin_until(lambda: heard, DISCOVERY_TIMEOUT_S):
        return

    def complete() -> bool:
        # Each robot has a publisher of low_state; on a loaded machine it is discovered late.
        nodes, publishers = nodes_from_diagnostics(heard), session.node.count_publishers
        return (
            nodes.keys() >= LOOP_NODES
            and publishers("low_state") > 0
            and len(nodes) >= publishers("/diagnostics")
        )

    session.spin(LISTEN_TIME_S)
    session.spin_until(complete, DISCOVERY_TIMEOUT_S)


def nodes_from_diagnostics(arrays: deque[Any]) -> dict[str, NodeReport]:
    """Extract the last report of each node.

    Args:
        arrays: Messages of /diagnostics.

    Returns:
        Reports by name of the node, sorted.
    """
    nodes = {}
    for one in (one for array in arrays for one in array.status):
        nodes[one.name] = NodeReport(one.level, one.message, {pair.key: pair.value for pair in one.values})
    return dict(sorted(nodes.items()))


def _labelled(level: bytes, text: str) -> Text:
    """Return a text with a level of DiagnosticStatus in front."""
    return Text.assemble(LEVELS[level], f" {text}")


def _nodes(nodes: Mapping[str, NodeReport]) -> Iterator[tuple[str, Text]]:
    """Yield name and health of each node."""
    for name, node in nodes.items():
        yield name, _labelled(node.level, node.summary)


def _lines(heard: Heard) -> Iterator[tuple[str, str | Text]]:
    """Yield name and text of each line on mode, velocity and rates."""
    states, commands, estimates = heard["controller/state"], heard["command"], heard["velocity_estimate"]
    if states:
        state = states[-1]
        yield "mode", f"{state.mode_name}: {state.reason}"
        for finding in state.findings:
            yield "finding", finding
        if state.mode_name == "fault":
            yield "recovery", f"once the cause is gone: {RECOVERY_HINT}"
        yield "walking", state.walk_refusal or "ready; waiting for a velocity command"
        yield (
            "command",
            f"{velocity_text(twist_to_array(state.command))}, source {commands[-1].source if commands else 'none'}",
        )
        period, compute = number_text(state.period_p99_ms, ".2f"), number_text(state.compute_p50_us, ".0f")
        loop = f"p99 of its period {period} ms, {compute} us from state to command"
        yield "loop", f"{state.rate_hz:.0f} Hz, {loop}, {state.overruns} deadlines missed"
    else:
        yield "mode", Text("no controller is running", style="red")
    if estimates:
        fell = bool(states) and states[-1].mode_name == "fault"
        note = "; wrong while the robot falls or lies" if fell else ""
        yield "estimate", velocity_text(twist_to_array(estimates[-1].twist.twist)) + note
    if heard["odom"]:
        position = heard["odom"][-1].pose.pose.position
        x, y = (number_text(value, ".2f") for value in (position.x, position.y))
        yield "position", f"x {x}, y {y} m since the estimator's start; height is not estimated"
    yield "rates", ", ".join(f"{topic} {_rate(heard[topic]):.0f}" for topic in RATES) + " Hz"


def _equipment(nodes: Mapping[str, NodeReport]) -> Iterator[tuple[str, str]]:
    """Yield name and text of each line on files, battery and temperatures."""
    values = {key: value for node in nodes.values() for key, value in node.values.items()}
    for key in FILE_KEYS:
        yield key, values.get(key, "not reported by any node")
    yield "battery", values.get("battery", "not reported by the low-level interface")
    temperatures = {
        key.removesuffix(" temperature"): int(value)
        for key, value in values.items()
        if key.endswith(" temperature") and value.lstrip("-").isdecimal()
    }
    hottest = sorted(temperatures, key=lambda name: temperatures[name], reverse=True)[:3]
    listed = ", ".join(f"{name} {temperatures[name]}" for name in hottest)
    missing = "not reported: a simulated robot has none, a driver only with its robot"
    yield (
        "temperatures",
        f"{listed} degrees C, the hottest of {len(temperatures)} sensors" if listed else missing,
    )


def _measurements(states: deque[Any]) -> Iterator[tuple[str, str]]:
    """Yield name and values of the IMU and of each joint in the last state."""
    if not states:
        yield "joints", "no low_state is received"
        return
    state = states[-1]
    roll, pitch = np.degrees(roll_pitch(np.array(state.orientation_wxyz)))
    x, y, z = state.angular_velocity
    yield (
        "imu",
        f"roll {roll:.1f}, pitch {pitch:.1f} degrees; turn rates x {x:.2f}, y {y:.2f}, z {z:.2f} rad/s",
    )
    for name, q, dq, tau in zip(JOINT_NAMES, state.q, state.dq, state.tau, strict=True):
        yield name.removesuffix("_joint"), f"{q:7.3f} rad, {dq:6.2f} rad/s, {tau:6.2f} N m"


def _rate(messages: deque[Any]) -> float:
    """Return the rate of messages by their stamps, Hz."""
    stamps = [message.stamp if hasattr(message, "stamp") else message.header.stamp for message in messages]
    times = [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

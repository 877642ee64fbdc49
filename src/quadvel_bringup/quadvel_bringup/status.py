"""`quadvel status`: one page on the robot that runs: nodes, mode, velocity, battery, temperatures, files.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rich.console import Console

from quadvel_msgs.msg import ControllerState, LowState, VelocityCommand
from quadvel_nodes.number_text import number_text
from quadvel_nodes.topic_types import all_conflicts

from .doctor import FILES
from .drive import planar, velocity_text
from .exclusivity import ros_domain
from .operator_commands import WAY_OUT
from .session import PATIENCE, Session
from .whereabouts import whereabouts

LISTEN = 2.2
"""s at least: each node reports once a second"""
LOOP = {"command_mux", "controller", "estimator"}
"""The nodes without which no robot walks; they are waited for, as a middleware may find some of them seconds after others"""
HEARD = {
    "/diagnostics": DiagnosticArray,
    "controller/state": ControllerState,
    "command": VelocityCommand,
    "low_state": LowState,
    "odom": Odometry,
    "velocity_estimate": TwistWithCovarianceStamped,
}
RATES = ("low_state", "velocity_estimate", "controller/state", "command", "odom")
LEVELS = {
    DiagnosticStatus.OK: "[green]ok",
    DiagnosticStatus.WARN: "[yellow]warning",
    DiagnosticStatus.ERROR: "[bold red]error",
    DiagnosticStatus.STALE: "[red]stale",
}
Heard = Mapping[str, deque[Any]]


@attrs.frozen
class Node:
    """What a node said last on /diagnostics."""

    level: bytes
    summary: str
    values: dict[str, str]


def status() -> int:
    """Print the page; the exit code is 1 where no robot runs, or its controller is in fault."""
    with Session("status") as session:
        heard = {topic: session.listen(kind, topic, keep=1000) for topic, kind in HEARD.items()}
        _hear_all(session, heard["/diagnostics"])
        conflicts = all_conflicts(session.node)
    nodes = reported(heard["/diagnostics"])
    if not nodes:
        print(f"no robot runs on ROS domain {ros_domain()}; start one: quadvel up; {whereabouts()}")
        return 1
    console = Console(soft_wrap=True, highlight=False)
    for name, text in [
        *_nodes(nodes),
        *(("topic", f"[yellow]warning[/] {conflict}") for conflict in conflicts),
        *_lines(heard),
        *_equipment(nodes),
    ]:
        console.print(f"{name:13} {text}")
    states = heard["controller/state"]
    return 1 if not states or states[-1].mode_name == "fault" else 0


def look() -> dict[str, Node]:
    """The nodes of the robot that runs, by name; none where there is none."""
    with Session("look") as session:
        heard = session.listen(DiagnosticArray, "/diagnostics", keep=100)
        _hear_all(session, heard)
    return reported(heard)


def _hear_all(session: Session, heard: deque[Any]) -> None:
    """Listen until the control loop's nodes and all others that publish /diagnostics have reported, or are waited for in vain."""
    if not session.spin_until(lambda: heard, PATIENCE):
        return

    def complete() -> bool:
        nodes = reported(heard)
        return nodes.keys() >= LOOP and len(nodes) >= session.node.count_publishers("/diagnostics")

    session.spin(LISTEN)
    session.spin_until(complete, PATIENCE)


def reported(arrays: deque[Any]) -> dict[str, Node]:
    """The nodes by name, out of their /diagnostics."""
    nodes = {}
    for one in (one for array in arrays for one in array.status):
        nodes[one.name] = Node(one.level, one.message, {pair.key: pair.value for pair in one.values})
    return dict(sorted(nodes.items()))


def _nodes(nodes: Mapping[str, Node]) -> Iterator[tuple[str, str]]:
    for name, node in nodes.items():
        yield name, f"{LEVELS[node.level]}[/] {node.summary}"


def _lines(heard: Heard) -> Iterator[tuple[str, str]]:
    states, commands, estimates = heard["controller/state"], heard["command"], heard["velocity_estimate"]
    if states:
        state = states[-1]
        yield "mode", f"{state.mode_name}: {state.reason}"
        for finding in state.findings:
            yield "finding", finding
        if state.mode_name == "fault":
            yield "way out", f"once the cause is gone: {WAY_OUT}"
        yield "walking", state.walk_refusal or "ready; waiting for a velocity command"
        yield (
            "command",
            f"{velocity_text(planar(state.command))}, from {commands[-1].source if commands else 'nobody'}",
        )
        period, compute = number_text(state.period_p99_ms, ".2f"), number_text(state.compute_p50_us, ".0f")
        loop = f"p99 of its period {period} ms, {compute} us from state to command"
        yield "loop", f"{state.rate_hz:.0f} Hz, {loop}, {state.overruns} deadlines missed"
    else:
        yield "mode", "[red]no controller runs"
    if estimates:
        yield "estimate", velocity_text(planar(estimates[-1].twist.twist))
    if heard["odom"]:
        position = heard["odom"][-1].pose.pose.position
        x, y = (number_text(value, ".2f") for value in (position.x, position.y))
        yield "position", f"x {x}, y {y} m since the estimator's start; height is not estimated"
    yield "rates", ", ".join(f"{topic} {_rate(heard[topic]):.0f}" for topic in RATES) + " Hz"


def _equipment(nodes: Mapping[str, Node]) -> Iterator[tuple[str, str]]:
    values = {key: value for node in nodes.values() for key, value in node.values.items()}
    for key in FILES:
        yield key, values.get(key, "not told by any node")
    yield "battery", values.get("battery", "not told by this robot's low-level interface")
    temperatures = [f"{key} {value}" for key, value in sorted(values.items()) if "temperature" in key]
    yield "temperatures", ", ".join(temperatures) or "none told: a simulated robot has none"


def _rate(messages: deque[Any]) -> float:
    """Messages a second by their stamps, Hz."""
    stamps = [message.stamp if hasattr(message, "stamp") else message.header.stamp for message in messages]
    times = [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

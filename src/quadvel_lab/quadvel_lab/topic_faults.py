"""Fault injection on the topics of a simulated robot, by a relay between its processes.

`quadvel faults` injects faults into the classes from many seeds and measures reaction times. This
module shows that the same faults arise from messages, and that the operator sees their names:
`python -m quadvel_lab.topic_faults`. Needs `rclpy`.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any

import attrs
import numpy as np
import typer

import quadvel_dds

quadvel_dds.install()  # before anything imports rclpy

# ruff: noqa: E402
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistWithCovarianceStamped
from rclpy.qos import QoSProfile

from quadvel_bringup.error_sentence import exit_with_sentence
from quadvel_bringup.processes import ProcessGroup
from quadvel_bringup.session import Session
from quadvel_bringup.stack import Stack
from quadvel_bringup.up import only_robot
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_msgs.msg import ControllerState, LowCmd, LowState, MotorStatus, VelocityCommand
from quadvel_msgs.srv import ResetSim, SetMode
from quadvel_policy.command_limits import LIMITS

Message = Any
Change = Callable[["Relay", Message], Message | None]
"""Modifies a message in the relay; returns None to drop it."""

RELAYED_TYPES = {
    "low_state": LowState,
    "velocity_estimate": TwistWithCovarianceStamped,
    "command": VelocityCommand,
    "motor_status": MotorStatus,
}
SENDERS = {
    "low_state": ("sim_node", "driver"),
    "velocity_estimate": ("estimator",),
    "command": ("command_mux",),
    "motor_status": ("driver",),
}
"""Publishers of the relayed topics."""
WALK_SPEED_M_S = 0.4
"""Forward speed for faults of a walking robot."""
TIMEOUT_S = 60.0
"""Timeout for what takes a robot a few seconds on an idle machine."""
FAULTY_JOINT = 5
"""Joint with the faulty encoder or drive: FL_calf."""


@attrs.frozen
class TopicFault:
    """A fault of docs/faults.md and its injection.

    Attributes:
        name: Name in the table.
        topic: Relayed topic that is modified.
        change: Modifies its messages.
        begin: Further action at the start of the fault.
        mode: Mode of the robot at the start: "stance", "walk" or "stand_up".
        finding_text: Part of the expected finding, if the robot continues.
    """

    name: str
    topic: str = "low_state"
    change: Change | None = None
    begin: Callable[[TopicRobot], None] = lambda robot: None
    mode: str = "stance"
    finding_text: str = ""


class Relay:
    """Receives the topics of RELAYED_TYPES and forwards them, modified during a fault.

    Args:
        robot: The robot.
        node: The node that it uses.

    Attributes:
        velocity: Commanded forward velocity, m/s.
        states: Messages of controller/state.
        last_command: The last LowCmd, or None.
        memory: State of the present fault.
        limits: Counts of each command limit in /diagnostics.
    """

    def __init__(self, robot: Robot, node: Any) -> None:
        self.robot, self.node = robot, node
        self.velocity = 0.0
        self.states: list[Message] = []
        self.last_command: Message | None = None
        self.memory: dict[str, Any] = {}
        self.limits: dict[str, str] = {}
        self._fault: TopicFault | None = None
        self._senders = {
            topic: node.create_publisher(kind, topic, 10) for topic, kind in RELAYED_TYPES.items()
        }
        for topic, kind in RELAYED_TYPES.items():
            node.create_subscription(
                kind, f"before/{topic}", partial(self._pass_on, topic), QoSProfile(depth=10)
            )
        node.create_subscription(LowCmd, "low_cmd", self._hear, 1)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._read_limits, 10)
        node.create_subscription(ControllerState, "controller/state", self.states.append, 10)
        self._drive = node.create_publisher(Twist, "cmd_vel_teleop", 1)
        node.create_timer(0.05, self._command)

    def begin(self, fault: TopicFault) -> None:
        """Start a fault.

        Args:
            fault: The fault.
        """
        self.memory.clear()
        self._fault = fault

    def end(self) -> None:
        """End the fault."""
        self._fault = None

    def send(self, topic: str, message: Message) -> None:
        """Publish a message unmodified.

        Args:
            topic: A relayed topic.
            message: The message.
        """
        self._senders[topic].publish(message)

    def _hear(self, message: Message) -> None:
        """Store the last LowCmd."""
        self.last_command = message

    def _read_limits(self, message: Message) -> None:
        """Store the counts of the command limits."""
        values = {pair.key: pair.value for status in message.status for pair in status.values}
        self.limits |= {name: values[f"limit {name}"] for name in LIMITS if f"limit {name}" in values}

    def _command(self) -> None:
        """Publish the commanded velocity."""
        twist = Twist()
        twist.linear.x = self.velocity
        self._drive.publish(twist)

    def _pass_on(self, topic: str, message: Message | None) -> None:
        """Forward a message through the present fault."""
        fault = self._fault
        if fault is not None and fault.topic == topic and fault.change is not None:
            message = fault.change(self, message)
        if message is not None:
            self.send(topic, message)


class TopicRobot:
    """The processes of a robot with a relay between them; use it as a context manager.

    Args:
        stack: The nodes and their parameters.
        output: Receives name and line of what the processes print.
    """

    def __init__(self, stack: Stack, output: Callable[[str, str], None] = lambda name, line: None) -> None:
        self._stack = stack
        self._session = Session("relay")
        self._group = ProcessGroup(output)
        self._simulator = "board" if stack.low_level == "board" else "sim_node"

    def __enter__(self) -> TopicRobot:
        """Start the processes and wait for the controller."""
        self._session.__enter__()
        self.relay = Relay(load_robot(self._stack.robot or DEFAULT_ROBOT), self._session.node)
        for name, words in self._stack.commands().items():
            topics = [topic for topic, senders in SENDERS.items() if name in senders]
            renamed = [word for topic in topics for word in ("-r", f"{topic}:=before/{topic}")]
            self._group.start(name, [*words, *renamed])
        try:
            self.wait_for(lambda state: state.mode_name != "passive", "it does not report")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: Any) -> None:
        self._session.__exit__(None, None, None)
        self._group.stop()

    def provoke(self, fault: TopicFault) -> ControllerState:
        """Inject a fault into a healthy robot and wait until it is reported.

        Args:
            fault: The fault.

        Returns:
            The ControllerState that reported it. AssertionError with the last state if none does
            within TIMEOUT_S.
        """
        self.bring_to(fault.mode)
        before = self.relay.limits.get(fault.name)
        self.relay.begin(fault)
        fault.begin(self)
        try:
            if fault.name in LIMITS:
                return self.wait_for(
                    lambda state: self.relay.limits.get(fault.name) != before,
                    f"{fault.name} is not counted: {self.relay.limits}",
                )
            return self.wait_for(lambda state: is_named(fault, state), f"{fault.name} is not named")
        finally:
            self.relay.end()
            self.relay.velocity = 0.0

    def bring_to(self, mode: str) -> None:
        """Bring the robot to a mode.

        Args:
            mode: "stance", "walk", or "stand_up" for its beginning.
        """
        self.relay.velocity = 0.0
        self._ask_for("passive")
        self._call(ResetSim, f"{self._simulator}/reset", keyframe="lie")
        self.spin(1.5)  # until the memory of the guards has faded
        self._ask_for("stand_up")
        if mode != "stand_up":
            self.wait_for(lambda state: state.mode_name == "stance", "it does not stand up")
            self.spin(0.5)
        if mode == "walk":
            self.wait_for(lambda state: state.walk_allowed, "it is not ready")
            self.relay.velocity = WALK_SPEED_M_S
            self.wait_for(lambda state: state.mode_name == "walk", "it does not walk")
            self.spin(1.0)

    def wait_for(self, is_so: Callable[[Any], bool], otherwise: str) -> ControllerState:
        """Wait for a state of the controller.

        Args:
            is_so: Predicate of a ControllerState.
            otherwise: Start of the error sentence.

        Returns:
            The first new state for which the predicate holds.

        Raises:
            AssertionError: There is none within TIMEOUT_S.
        """
        states = self.relay.states
        states.clear()
        found: list[Any] = []

        def look() -> bool:
            """Collect matching states."""
            found.extend(state for state in states if is_so(state))
            return bool(found)

        if not self._session.spin_until(look, TIMEOUT_S):
            raise AssertionError(f"{otherwise}: {_summary(states)}")
        return found[0]

    def spin(self, seconds: float) -> None:
        """Spin for a duration.

        Args:
            seconds: s.
        """
        self._session.spin(seconds)

    def process_id(self, name: str) -> int:
        """Return the process id of a node.

        Args:
            name: The node.

        Returns:
            The process id.
        """
        return self._group.process_id(name)

    def suspend(self, name: str, seconds: float) -> None:
        """Suspend the process of a node for a duration.

        Args:
            name: The node.
            seconds: s.
        """
        os.kill(self.process_id(name), signal.SIGSTOP)
        self.spin(seconds)
        os.kill(self.process_id(name), signal.SIGCONT)

    def _ask_for(self, mode: str) -> None:
        """Request a mode until it is accepted."""
        until = time.monotonic() + TIMEOUT_S
        while not (answer := self._call(SetMode, "controller/set_mode", mode=mode)).success:
            assert time.monotonic() < until, f"mode {mode}: {answer.message}"
            self.spin(0.2)

    def _call(self, kind: Any, service: str, **fields: Any) -> Any:
        """Call a service."""
        return self._session.call(kind, [service], lambda: f"{service} is not there", **fields)


def is_named(fault: TopicFault, state: ControllerState) -> bool:
    """Return whether the operator sees the fault.

    Args:
        fault: The fault.
        state: A ControllerState.

    Returns:
        True if the state reports the fault by its name, or by a finding if the robot continues.
    """
    return (
        any(fault.finding_text in finding for finding in state.findings)
        if fault.finding_text
        else state.fault == fault.name
    )


def _report_text(fault: TopicFault, state: ControllerState) -> str:
    """Return the text that reports the fault."""
    return (
        next((f for f in state.findings if fault.finding_text in f), "")
        if fault.finding_text
        else state.reason
    )


def _summary(states: list[Any]) -> str:
    """Summarise the last state for an error sentence."""
    if not states:
        return "controller/state: no message"
    last = states[-1]
    return f"{last.mode_name}, fault '{last.fault}', {last.reason}; findings {list(last.findings)}"


# Modifications of messages.


def _set(**values: Any) -> Change:
    """Replace fields by values, or by functions of the old values."""

    def change(relay: Relay, message: Message) -> Message:
        for field, value in values.items():
            before = np.array(getattr(message, field), np.float32)
            after = value(before) if callable(value) else np.broadcast_to(np.asarray(value), before.shape)
            setattr(message, field, np.asarray(after, np.float32))
        return message

    return change


def _at(joint: int, value: float) -> Callable[[Any], Any]:
    """Return a function that replaces the value of one joint."""
    return lambda before: np.where(np.arange(12) == joint, value, before)


def _out_of_range(relay: Relay, message: Message) -> Message:
    """Move one joint beyond its mechanical range."""
    return _set(q=_at(FAULTY_JOINT, float(relay.robot.upper[FAULTY_JOINT]) + 0.5))(relay, message)


def _plus(joint: int, value: float) -> Callable[[Any], Any]:
    """Return a function that adds to the value of one joint."""
    return lambda before: before + value * (np.arange(12) == joint)


def _drop(relay: Relay, message: Message) -> None:
    """Drop every message."""
    return None


def _keep_first(relay: Relay, message: Message) -> None:
    """Keep the first message and drop all."""
    relay.memory.setdefault("state", message)


def _repeat(robot: TopicRobot) -> None:
    """Repeat one state with new stamps, as a hanging simulator does."""
    relay = robot.relay

    def send() -> None:
        if (state := relay.memory.get("state")) is not None:
            state.stamp = relay.node.get_clock().now().to_msg()
            relay.send("low_state", state)

    timer = relay.node.create_timer(0.005, send)
    robot.wait_for(lambda state: bool(state.fault), "a simulator that hangs is not noticed")
    relay.node.destroy_timer(timer)


def _stuck(*fields: str, joint: int | None = None) -> Change:
    """Repeat the first value of fields, or of one joint of them."""

    def change(relay: Relay, message: Message) -> Message:
        for field in fields:
            now = getattr(message, field)
            first = relay.memory.setdefault(field, np.array(now) if np.ndim(now) else now)
            held = first if joint is None else np.where(np.arange(12) == joint, first, np.array(now))
            setattr(message, field, held if not np.ndim(now) else np.asarray(held, np.float32))
        return message

    return change


def _earlier(seconds: float) -> Change:
    """Shift stamps back by a duration, s."""

    def change(relay: Relay, message: Message) -> Message:
        nanoseconds = message.stamp.sec * 10**9 + message.stamp.nanosec - round(1e9 * seconds)
        message.stamp.sec, message.stamp.nanosec = divmod(nanoseconds, 10**9)
        return message

    return change


Path = Callable[[float], tuple[float, float]]
"""Displacement (rad) and speed (rad/s) of a joint as a function of time (s)."""


def _ramp(by: float, within: float) -> Path:
    """Return a ramp of `by` rad within a duration, s."""
    return lambda t: (by * min(t / within, 1.0), by / within if t < within else 0.0)


def _swing(speed: float) -> Path:
    """Path that bends by 0.8 rad in 0.1 s, before the robot tips over, and returns with a speed, rad/s."""

    def path(t: float) -> tuple[float, float]:
        back = 0.1 + 0.8 / speed
        return (
            (-8.0 * t, -8.0) if t < 0.1 else (min(speed * (t - 0.1) - 0.8, 0.0), speed if t < back else 0.0)
        )

    return path


def _prescribed_motion(joints: Sequence[int], path: Path) -> Change:
    """Move joints along a path in robot time regardless of commands.

    Encoders and drives report it consistently.
    """
    there = np.isin(np.arange(12), joints)

    def change(relay: Relay, message: Message) -> Message:
        first, began = relay.memory.setdefault("first", (np.array(message.q), message.tick))
        moved, speed = path(1e-3 * (message.tick - began))
        q = np.where(there, first + moved, np.array(message.q))
        dq = np.where(there, speed, np.array(message.dq))
        tau = np.array(message.tau)
        # The drive law tau = tau_ff + kp (q_des - q) + kd (dq_des - dq), clipped to the torque limit.
        if (command := relay.last_command) is not None:
            asked = np.array(command.tau) + np.array(command.kp) * (np.array(command.q) - q)
            asked += np.array(command.kd) * (np.array(command.dq) - dq)
            tau = np.where(there, np.clip(asked, -relay.robot.torque_limit, relay.robot.torque_limit), tau)
        message.q, message.dq, message.tau = (np.asarray(v, np.float32) for v in (q, dq, tau))
        return message

    return change


def _not_a_velocity(relay: Relay, message: Message) -> Message:
    """Set the commanded velocity to NaN."""
    message.twist.linear.x = float("nan")
    return message


def _faster(by: float) -> Change:
    """Add to the estimated forward velocity, m/s."""

    def change(relay: Relay, message: Message) -> Message:
        message.twist.twist.linear.x += by
        return message

    return change


def _late(count: int) -> Change:
    """Hold every message back until `count` later ones have come."""

    def change(relay: Relay, message: Message) -> Message | None:
        held = relay.memory.setdefault("held", deque())
        held.append(message)
        return held.popleft() if len(held) > count else None

    return change


def _hot(relay: Relay, message: Message) -> Message:
    """Report overheated motors."""
    message.temperature = np.full(12, 95.0, np.float32)
    return message


def _dropped_out(relay: Relay, message: Message) -> Message:
    """Report a motor that dropped out."""
    message.dropped_out = [joint == FAULTY_JOINT for joint in range(12)]
    return message


def _second_publisher(robot: TopicRobot) -> None:
    """Publish low_state from a second node."""
    node = robot.relay.node
    other = node.create_publisher(LowState, "low_state", 1)
    robot.wait_for(lambda state: state.fault == "duplicate_publisher", "a second robot is not noticed")
    node.destroy_publisher(other)


def _too_fast(robot: TopicRobot) -> None:
    """Command a velocity beyond the limits of the policy."""
    robot.relay.velocity = 4.4


CALVES = (2, 5, 8, 11)
TILTED = (np.cos(0.65), 0.0, np.sin(0.65), 0.0)
FAULTS = (
    TopicFault("duplicate_publisher", begin=_second_publisher),
    TopicFault("state_not_finite", change=_set(q=np.nan)),
    TopicFault("attitude_not_unit", change=_set(orientation_wxyz=lambda before: 1.2 * before)),
    TopicFault("state_back_in_time", change=_earlier(0.1)),
    TopicFault("state_stale", change=_drop),
    TopicFault("controller_stopped", begin=lambda robot: robot.suspend("controller", 2.0)),
    TopicFault("state_frozen", change=_keep_first, begin=_repeat),
    TopicFault("tilted", change=_set(orientation_wxyz=TILTED)),
    TopicFault("joint_out_of_range", change=_out_of_range),
    TopicFault("joint_too_fast", change=_set(dq=_at(FAULTY_JOINT, 50.0))),
    TopicFault("encoder_inconsistent", change=_set(q=_plus(FAULTY_JOINT, 0.4))),
    TopicFault("encoder_frozen", change=_stuck("q", "dq", joint=2), mode="stand_up"),
    TopicFault(
        "imu_inconsistent", change=_set(angular_velocity=lambda before: before + np.array([0.0, 0.0, 1.5]))
    ),
    TopicFault("drive_does_not_answer", change=_set(tau=_plus(FAULTY_JOINT, 25.0))),
    TopicFault("joint_stuck", change=_prescribed_motion([FAULTY_JOINT], _ramp(-0.29, within=0.3))),
    TopicFault(
        "stand_up_failed", change=_prescribed_motion([FAULTY_JOINT], _ramp(0.4, within=2.0)), mode="stand_up"
    ),
    TopicFault("imu_frozen", change=_stuck("orientation_wxyz", "angular_velocity"), mode="walk"),
    TopicFault("accelerometer_implausible", change=_set(linear_acceleration=lambda before: before + 15.0)),
    TopicFault(
        "estimate_stale", "velocity_estimate", _drop, mode="walk", finding_text="no fresh velocity estimate"
    ),
    TopicFault(
        "estimate_wrong",
        "velocity_estimate",
        _faster(1.5),
        mode="walk",
        finding_text="off the Kalman filter's",
    ),
    TopicFault("command_stale", "command", _drop, mode="walk", finding_text="There is no fresh command"),
    TopicFault(
        "command_not_finite", "command", _not_a_velocity, mode="walk", finding_text="expected finite numbers"
    ),
    TopicFault(
        "command_out_of_range", begin=_too_fast, mode="walk", finding_text="exceeds the limits of the policy"
    ),
    TopicFault(
        "foot_force_frozen", change=_stuck("foot_force"), mode="walk", finding_text="the force of foot"
    ),
    TopicFault("target_out_of_range", begin=_too_fast, mode="walk"),
    *(
        TopicFault(name, change=_prescribed_motion(CALVES, _swing(speed=17.0)))  # drives reach 16 rad/s
        for name in ("torque_jumps", "torque_too_large", "joint_at_speed_limit")
    ),
    TopicFault("power_too_large", change=_prescribed_motion(CALVES, _swing(speed=15.0))),
)
"""Faults of a simulated robot."""
BOARD_FAULTS = (
    TopicFault("motor_hot", "motor_status", _hot),
    TopicFault("motor_dropped_out", "motor_status", _dropped_out),
    TopicFault("overruns", change=_late(2)),
)
"""Faults that only a board reports, or whose lateness a simulated robot waits for."""


def _known(names: list[str]) -> list[str]:
    """Check names of faults."""
    known = [fault.name for fault in (*FAULTS, *BOARD_FAULTS)]
    for name in names:
        if name not in known:
            raise typer.BadParameter(f"'{name}', expected one of: {', '.join(known)}")
    return names


def _provoke_all(wanted: set[str]) -> int:
    """Inject the named faults, or all; return how many were not reported."""
    missed = 0
    for low_level, faults in (("sim", FAULTS), ("board", BOARD_FAULTS)):
        chosen = [fault for fault in faults if not wanted or fault.name in wanted]
        if not chosen:
            continue
        with TopicRobot(Stack(low_level=low_level)) as robot:
            for fault in chosen:
                try:
                    state = robot.provoke(fault)
                    text = robot.relay.limits.get(fault.name) or _report_text(fault, state)
                except AssertionError as error:
                    text, missed = f"MISSED: {error}", missed + 1
                print(f"{fault.name}: {text}", flush=True)
    return missed


def main(
    names: Annotated[
        list[str], typer.Argument(callback=_known, help="Rows of docs/faults.md (default: all).")
    ] = [],  # noqa: B006 typer copies it
) -> None:
    """Start a simulated robot, inject faults on its topics, and print how each is reported.

    No other robot may run on this ROS domain. Exit code 1 if a fault was not reported.
    """
    with exit_with_sentence("topic_faults"), only_robot():
        missed = _provoke_all(set(names))
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    typer.run(main)

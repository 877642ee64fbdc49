"""Faults on the topics of a running robot: its processes with the parameters of `quadvel up`, and a relay in the middle.

`quadvel faults` lets the classes fail from many seeds and measures how soon they react; this shows that what they find arises from
messages, too, and that its name reaches the operator: `python -m quadvel_bringup.topic_faults`. Needs `rclpy`.
"""

from __future__ import annotations

import os
import signal
import sys
import time
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

from quadvel_description.robot import TORQUE_LIMIT, UPPER
from quadvel_msgs.msg import ControllerState, LowCmd, LowState, MotorStatus, VelocityCommand
from quadvel_msgs.srv import ResetSim, SetMode
from quadvel_policy.command_limits import LIMITS

from .processes import ProcessGroup
from .session import Session
from .stack import Stack

Message = Any
Change = Callable[["Relay", Message], Message | None]
"""What becomes of a message on its way; None: it is lost"""

KINDS = {
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
"""Who publishes the topics that go through the relay"""
WALKS = 0.4  # m/s, forward, where a fault needs a robot that walks
PATIENCE = 60.0  # s, for what a robot does in a few seconds on an idle machine
JOINT = 5  # whose encoder or drive is at fault: FL_calf


@attrs.frozen
class TopicFault:
    """One row of docs/faults.md, and how it comes about.

    name: in the table. topic, change: what happens to the messages there. begin: what happens besides. mode: "stance", "walk" or
    "stand_up". says: what `findings` holds where the robot goes on.
    """

    name: str
    topic: str = "low_state"
    change: Change | None = None
    begin: Callable[[TopicRobot], None] = lambda robot: None
    mode: str = "stance"
    says: str = ""


class Relay:
    """Receives each of KINDS in place of the other nodes and sends it on, changed while a fault lasts."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.velocity = 0.0
        self.states: list[Message] = []
        self.asked: Message | None = None
        self.memory: dict[str, Any] = {}  # of the fault that there is
        self.limits: dict[str, str] = {}  # what /diagnostics shows of each limit of commands
        self._fault: TopicFault | None = None
        self._senders = {topic: node.create_publisher(kind, topic, 10) for topic, kind in KINDS.items()}
        for topic, kind in KINDS.items():
            node.create_subscription(
                kind, f"before/{topic}", partial(self._pass_on, topic), QoSProfile(depth=10)
            )
        node.create_subscription(LowCmd, "low_cmd", self._hear, 1)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._read_limits, 10)
        node.create_subscription(ControllerState, "controller/state", self.states.append, 10)
        self._drive = node.create_publisher(Twist, "cmd_vel_teleop", 1)
        node.create_timer(0.05, self._command)

    def begin(self, fault: TopicFault) -> None:
        """From now on the fault is there."""
        self.memory.clear()
        self._fault = fault

    def end(self) -> None:
        """All is well again."""
        self._fault = None

    def send(self, topic: str, message: Message) -> None:
        """Send a message as it is."""
        self._senders[topic].publish(message)

    def _hear(self, message: Message) -> None:
        self.asked = message

    def _read_limits(self, message: Message) -> None:
        values = {pair.key: pair.value for status in message.status for pair in status.values}
        self.limits |= {name: values[f"limit {name}"] for name in LIMITS if f"limit {name}" in values}

    def _command(self) -> None:
        twist = Twist()
        twist.linear.x = self.velocity
        self._drive.publish(twist)

    def _pass_on(self, topic: str, message: Message | None) -> None:
        fault = self._fault
        if fault is not None and fault.topic == topic and fault.change is not None:
            message = fault.change(self, message)
        if message is not None:
            self.send(topic, message)


class TopicRobot:
    """The processes of a robot, and the relay between them. To be entered."""

    def __init__(self, stack: Stack, output: Callable[[str, str], None] = lambda name, line: None) -> None:
        self._stack = stack
        self._session = Session("relay")
        self._group = ProcessGroup(output)
        self._simulator = "board" if stack.low_level == "board" else "sim_node"

    def __enter__(self) -> TopicRobot:
        self._session.__enter__()
        self.relay = Relay(self._session.node)
        for name, words in self._stack.commands().items():
            topics = [topic for topic, senders in SENDERS.items() if name in senders]
            renamed = [word for topic in topics for word in ("-r", f"{topic}:=before/{topic}")]
            self._group.start(name, [*words, *renamed])
        try:
            self.until(lambda state: state.mode_name != "passive", "it does not report")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: Any) -> None:
        self._session.__exit__(None, None, None)
        self._group.stop()

    def provoke(self, fault: TopicFault) -> ControllerState:
        """Bring the fault about in a healthy robot; what the controller said when it was named.

        AssertionError, with what it said instead, where it is not within PATIENCE.
        """
        self.prepare(fault.mode)
        before = self.relay.limits.get(fault.name)
        self.relay.begin(fault)
        fault.begin(self)
        try:
            if fault.name in LIMITS:
                return self.until(
                    lambda state: self.relay.limits.get(fault.name) != before,
                    f"{fault.name} is not counted: {self.relay.limits}",
                )
            return self.until(lambda state: is_named(fault, state), f"{fault.name} is not named")
        finally:
            self.relay.end()
            self.relay.velocity = 0.0

    def prepare(self, mode: str) -> None:
        """A robot that stands, walks, or begins to stand up."""
        self.relay.velocity = 0.0
        self._ask_for("passive")
        self._call(ResetSim, f"{self._simulator}/reset", keyframe="lie")
        self.spin(1.5)  # until what the guards remember of the fault before has faded
        self._ask_for("stand_up")
        if mode != "stand_up":
            self.until(lambda state: state.mode_name == "stance", "it does not stand up")
            self.spin(0.5)
        if mode == "walk":
            self.until(lambda state: state.walk_allowed, "it is not ready")
            self.relay.velocity = WALKS
            self.until(lambda state: state.mode_name == "walk", "it does not walk")
            self.spin(1.0)

    def until(self, is_so: Callable[[Any], bool], otherwise: str) -> ControllerState:
        """Serve until the controller says so from now on; returns what it said."""
        states = self.relay.states
        states.clear()
        found: list[Any] = []

        def look() -> bool:
            found.extend(state for state in states if is_so(state))
            return bool(found)

        if not self._session.spin_until(look, PATIENCE):
            raise AssertionError(f"{otherwise}: {_summary(states)}")
        return found[0]

    def spin(self, seconds: float) -> None:
        """Serve for so long (s)."""
        self._session.spin(seconds)

    def process(self, name: str) -> int:
        """The process id of a node."""
        return self._group.process_id(name)

    def stop(self, name: str, seconds: float) -> None:
        """Stop the process of a node for so long (s), and let it go on."""
        os.kill(self.process(name), signal.SIGSTOP)
        self.spin(seconds)
        os.kill(self.process(name), signal.SIGCONT)

    def _ask_for(self, mode: str) -> None:
        until = time.monotonic() + PATIENCE
        while not (answer := self._call(SetMode, "controller/set_mode", mode=mode)).success:
            assert time.monotonic() < until, f"mode {mode}: {answer.message}"
            self.spin(0.2)

    def _call(self, kind: Any, service: str, **fields: Any) -> Any:
        return self._session.call(kind, [service], lambda: f"{service} is not there", **fields)


def is_named(fault: TopicFault, state: ControllerState) -> bool:
    """Whether the operator reads of this fault: by its name, or in words where the robot goes on."""
    return (
        any(fault.says in finding for finding in state.findings) if fault.says else state.fault == fault.name
    )


def _told(fault: TopicFault, state: ControllerState) -> str:
    return next((f for f in state.findings if fault.says in f), "") if fault.says else state.reason


def _summary(states: list[Any]) -> str:
    if not states:
        return "controller/state: nothing came"
    last = states[-1]
    return f"{last.mode_name}, fault '{last.fault}', {last.reason}; findings {list(last.findings)}"


# What becomes of messages.


def _set(**values: Any) -> Change:
    """Fields whose numbers are replaced, by others or by what a function makes of them."""

    def change(relay: Relay, message: Message) -> Message:
        for field, value in values.items():
            before = np.array(getattr(message, field), np.float32)
            after = value(before) if callable(value) else np.broadcast_to(np.asarray(value), before.shape)
            setattr(message, field, np.asarray(after, np.float32))
        return message

    return change


def _at(joint: int, value: float) -> Callable[[Any], Any]:
    return lambda before: np.where(np.arange(12) == joint, value, before)


def _plus(joint: int, value: float) -> Callable[[Any], Any]:
    return lambda before: before + value * (np.arange(12) == joint)


def _lost(relay: Relay, message: Message) -> None:
    return None


def _kept(relay: Relay, message: Message) -> None:
    relay.memory.setdefault("state", message)


def _repeat(robot: TopicRobot) -> None:
    """A simulator that hangs sends one state again and again, as if it was new."""
    relay = robot.relay

    def send() -> None:
        if (state := relay.memory.get("state")) is not None:
            state.stamp = relay.node.get_clock().now().to_msg()
            relay.send("low_state", state)

    timer = relay.node.create_timer(0.005, send)
    robot.until(lambda state: bool(state.fault), "a simulator that hangs is not noticed")
    relay.node.destroy_timer(timer)


def _stuck(*fields: str, joint: int | None = None) -> Change:
    """Fields, or one joint of them, that repeat what they held first."""

    def change(relay: Relay, message: Message) -> Message:
        for field in fields:
            now = getattr(message, field)
            first = relay.memory.setdefault(field, np.array(now) if np.ndim(now) else now)
            held = first if joint is None else np.where(np.arange(12) == joint, first, np.array(now))
            setattr(message, field, held if not np.ndim(now) else np.asarray(held, np.float32))
        return message

    return change


def _earlier(seconds: float) -> Change:
    def change(relay: Relay, message: Message) -> Message:
        nanoseconds = message.stamp.sec * 10**9 + message.stamp.nanosec - round(1e9 * seconds)
        message.stamp.sec, message.stamp.nanosec = divmod(nanoseconds, 10**9)
        return message

    return change


Path = Callable[[float], tuple[float, float]]
"""How far a joint has moved (rad), and how fast it moves (rad/s), at a time (s)"""


def _ramp(by: float, within: float) -> Path:
    return lambda t: (by * min(t / within, 1.0), by / within if t < within else 0.0)


def _swing(t: float) -> tuple[float, float]:
    """Bent by 0.8 rad in 0.4 s, and back faster than a drive can."""
    return (-2.0 * t, -2.0) if t < 0.4 else (min(17.0 * (t - 0.4) - 0.8, 0.0), 17.0 if t < 0.447 else 0.0)


def _led(joints: Sequence[int], path: Path) -> Change:
    """Joints that move along a path in the robot's time, whatever they are asked for; encoders and drives agree about it."""
    there = np.isin(np.arange(12), joints)

    def change(relay: Relay, message: Message) -> Message:
        first, began = relay.memory.setdefault("first", (np.array(message.q), message.tick))
        moved, speed = path(1e-3 * (message.tick - began))
        q = np.where(there, first + moved, np.array(message.q))
        dq = np.where(there, speed, np.array(message.dq))
        tau = np.array(message.tau)
        if (command := relay.asked) is not None:
            asked = np.array(command.tau) + np.array(command.kp) * (np.array(command.q) - q)
            asked += np.array(command.kd) * (np.array(command.dq) - dq)
            tau = np.where(there, np.clip(asked, -TORQUE_LIMIT, TORQUE_LIMIT), tau)
        message.q, message.dq, message.tau = (np.asarray(v, np.float32) for v in (q, dq, tau))
        return message

    return change


def _not_a_velocity(relay: Relay, message: Message) -> Message:
    message.twist.linear.x = float("nan")
    return message


def _faster(by: float) -> Change:
    def change(relay: Relay, message: Message) -> Message:
        message.twist.twist.linear.x += by
        return message

    return change


def _late(seconds: float) -> Change:
    def change(relay: Relay, message: Message) -> Message:
        time.sleep(seconds)
        return message

    return change


def _hot(relay: Relay, message: Message) -> Message:
    message.temperature = np.full(12, 95.0, np.float32)
    return message


def _dropped_out(relay: Relay, message: Message) -> Message:
    message.dropped_out = [joint == JOINT for joint in range(12)]
    return message


def _second_publisher(robot: TopicRobot) -> None:
    node = robot.relay.node
    other = node.create_publisher(LowState, "low_state", 1)
    robot.until(lambda state: state.fault == "duplicate_publisher", "a second robot is not noticed")
    node.destroy_publisher(other)


def _too_fast(robot: TopicRobot) -> None:
    robot.relay.velocity = 4.4


CALVES = (2, 5, 8, 11)
TILTED = (np.cos(0.65), 0.0, np.sin(0.65), 0.0)
FAULTS = (
    TopicFault("duplicate_publisher", begin=_second_publisher),
    TopicFault("state_not_finite", change=_set(q=np.nan)),
    TopicFault("attitude_not_unit", change=_set(orientation_wxyz=lambda before: 1.2 * before)),
    TopicFault("state_back_in_time", change=_earlier(0.1)),
    TopicFault("state_stale", change=_lost),
    TopicFault("controller_stopped", begin=lambda robot: robot.stop("controller", 2.0)),
    TopicFault("state_frozen", change=_kept, begin=_repeat),
    TopicFault("tilted", change=_set(orientation_wxyz=TILTED)),
    TopicFault("joint_out_of_range", change=_set(q=_at(JOINT, float(UPPER[JOINT]) + 0.5))),
    TopicFault("joint_too_fast", change=_set(dq=_at(JOINT, 50.0))),
    TopicFault("encoder_inconsistent", change=_set(q=_plus(JOINT, 0.4))),
    TopicFault("encoder_frozen", change=_stuck("q", "dq", joint=2), mode="stand_up"),
    TopicFault(
        "imu_inconsistent", change=_set(angular_velocity=lambda before: before + np.array([0.0, 0.0, 1.5]))
    ),
    TopicFault("drive_does_not_answer", change=_set(tau=_plus(JOINT, 25.0))),
    TopicFault("joint_stuck", change=_led([JOINT], _ramp(-0.29, within=0.3))),
    TopicFault("stand_up_failed", change=_led([JOINT], _ramp(0.4, within=2.0)), mode="stand_up"),
    TopicFault("imu_frozen", change=_stuck("orientation_wxyz", "angular_velocity"), mode="walk"),
    TopicFault("accelerometer_implausible", change=_set(linear_acceleration=lambda before: before + 15.0)),
    TopicFault("estimate_stale", "velocity_estimate", _lost, mode="walk", says="no fresh velocity estimate"),
    TopicFault(
        "estimate_wrong", "velocity_estimate", _faster(1.5), mode="walk", says="off the Kalman filter's"
    ),
    TopicFault("command_stale", "command", _lost, mode="walk", says="There is no fresh command"),
    TopicFault("command_not_finite", "command", _not_a_velocity, mode="walk", says="expected finite numbers"),
    TopicFault(
        "command_out_of_range", begin=_too_fast, mode="walk", says="beyond what the policy can follow"
    ),
    TopicFault("foot_force_frozen", change=_stuck("foot_force"), mode="walk", says="the force of foot"),
    TopicFault("target_out_of_range", begin=_too_fast, mode="walk"),
    *(
        TopicFault(name, change=_led(CALVES, _swing))
        for name in ("torque_jumps", "torque_too_large", "joint_at_speed_limit", "power_too_large")
    ),
)
"""Of a simulated robot"""
BOARD_FAULTS = (
    TopicFault("motor_hot", "motor_status", _hot),
    TopicFault("motor_dropped_out", "motor_status", _dropped_out),
    TopicFault("overruns", change=_late(0.008)),
)
"""What a board alone can report, or that a simulated robot waits for"""


def _known(names: list[str]) -> list[str]:
    known = [fault.name for fault in (*FAULTS, *BOARD_FAULTS)]
    for name in names:
        if name not in known:
            raise typer.BadParameter(f"'{name}', expected names out of: {', '.join(known)}")
    return names


def main(
    names: Annotated[
        list[str], typer.Argument(callback=_known, help="Rows of docs/faults.md (none: all of them).")
    ] = [],  # noqa: B006 typer copies it
) -> None:
    """Provoke faults on the topics of a running robot, and print how each was named. Exit code 1 where one was not."""
    wanted, missed = set(names), 0
    for low_level, faults in (("sim", FAULTS), ("board", BOARD_FAULTS)):
        chosen = [fault for fault in faults if not wanted or fault.name in wanted]
        if not chosen:
            continue
        with TopicRobot(Stack(low_level=low_level)) as robot:
            for fault in chosen:
                try:
                    state = robot.provoke(fault)
                    told = robot.relay.limits.get(fault.name) or _told(fault, state)
                except AssertionError as error:
                    told, missed = f"MISSED: {error}", missed + 1
                print(f"{fault.name}: {told}", flush=True)
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    typer.run(main)

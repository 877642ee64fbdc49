"""The node `controller`: answers the robot's states with joint commands, 200 times a second.

It is locked to the phase of the states: a tick runs when the state that is due arrives, so that the latency
is small and constant. What is due lies on an absolute grid in the states' own time (`TickGrid`), so that
states may come faster than 200 Hz; the deadline of a tick is one period after its state held. When states
stop, a timer notices. With simulated time the same holds on that time, and the answer waits until estimator
and mux have kept up, so that no node is outrun. What a tick decides is the supervisor's matter.

All times but that of the clock are the robot's own (`RobotTime`): a stall of the whole machine, simulator
included, is no gap in them.
"""

from __future__ import annotations

import gc
import math
import time
from typing import Any

import attrs
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool

from quadvel_description.state import JointCommand, RobotState
from quadvel_msgs.msg import ControllerState, LowCmd, LowState, VelocityCommand
from quadvel_msgs.srv import SetMode
from quadvel_nodes.diagnostics import QUIET, diagnostics
from quadvel_nodes.messages import MessageError, Refusals, read_low_state, seconds, write_low_cmd
from quadvel_nodes.node import read_parameters, run
from quadvel_nodes.robot_time import RobotTime
from quadvel_nodes.scheduling import Scheduling
from quadvel_nodes.tick_grid import TickGrid

from .announcements import Announcements
from .loop_stats import LoopStats
from .observation import RATE_HZ
from .pauses import Pauses
from .policy_file import SHIPPED_POLICY, PolicyFile
from .received import Array, StampCheck, linear_velocity, planar_velocity
from .supervisor import MODES, Supervisor, SupervisorConfig, setting

PERIOD = 1.0 / RATE_HZ
STATE_PERIOD = 0.02  # s, of controller/state and of looking whether states still come
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)  # a state is of use only while it is new

LONGEST = 0.5
"""s that a robot may have stood still, with all of the machine, before its next state; longer is a fault"""
HELD_UP = 10
"""Simulated states that wait for a command, one after the other, where none comes any more"""

PATIENCE = 5
"""s without any state after which the log says that the controller waits for one"""

Stamped = tuple[float, Array]
"""Time (s) and value"""


@attrs.frozen(kw_only=True)
class ControllerParameters(SupervisorConfig, Scheduling):
    """The supervisor's settings and the scheduling, and what the node adds to them."""

    policy: str = setting("", "ONNX file of the policy; empty: the one that is shipped", positive=False)
    max_velocity_age: float = setting(
        0.05, "oldest velocity estimate that walking may use before it is a fault, s"
    )
    command_timeout: float = setting(0.5, "oldest command that is followed; after that the robot stands, s")
    robot_waits: bool = setting(
        False,
        "whether the robot's time stands still until a late answer comes, as a simulator's does: then lateness is no fault",
        positive=False,
    )
    max_overruns: int = setting(20, "deadlines missed in a row before a fault")


class Controller(Node):
    """Topics, services and timing around a Supervisor."""

    def __init__(self) -> None:
        super().__init__("controller")
        self._settings = read_parameters(self, ControllerParameters)
        self._patience = 0.0  # s by which a message may be late because nobody ran, the robot neither
        if self._settings.robot_waits:
            self._patience = math.inf
            self._settings = attrs.evolve(self._settings, max_state_age=math.inf)
        policy = PolicyFile(self._settings.policy or SHIPPED_POLICY)
        policy.prepare()  # now, as the first time is slow
        self._supervisor = Supervisor(policy, self._settings)
        self._sim_time: bool = self.get_parameter("use_sim_time").value
        self._stats, self._refusals = LoopStats(), Refusals()
        self._robot_time, self._pauses = RobotTime(), Pauses(STATE_PERIOD, PERIOD)
        self._refused_before = self._overruns_before = self._pauses_before = 0
        self._grid = TickGrid(PERIOD)
        self._state: RobotState | None = None
        self._waiting: RobotState | None = None  # for the estimator or the mux, on simulated time
        self._answer, self._message = JointCommand.damping(), LowCmd()
        self._velocity: Stamped | None = None
        self._command: Stamped | None = None
        self._checks = {
            "low_state": StampCheck(self._settings.max_state_age),
            "velocity_estimate": StampCheck(self._settings.max_velocity_age + self._patience),
            "command": StampCheck(self._settings.command_timeout),
        }
        self._announcements = Announcements(self._supervisor)
        self._reports = 0
        self._create_interfaces()
        if not self._sim_time:  # where time waits for the node there is no hurry
            self._settings.apply(self.get_logger().warning)
        gc.freeze()  # what exists by now stays: the collector need not look at it in the middle of a tick

    def _create_interfaces(self) -> None:
        self._low_cmd = self.create_publisher(LowCmd, "low_cmd", 1)
        self._controller_state = self.create_publisher(ControllerState, "controller/state", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # A robot's driver may send its states as best it can; a simulator in lockstep waits for the answer to each.
        of_states = (
            NEWEST if self._sim_time else QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self._states = self.create_subscription(LowState, "low_state", self._on_state, of_states)
        self.create_subscription(TwistWithCovarianceStamped, "velocity_estimate", self._on_velocity, NEWEST)
        self.create_subscription(VelocityCommand, "command", self._on_command, NEWEST)
        self.create_service(SetMode, "~/set_mode", self._on_set_mode)
        self.create_service(SetBool, "~/enable_walking", self._on_enable_walking)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on where the system's clock is set back
        self.create_timer(STATE_PERIOD, self._watch, clock=self.get_clock() if self._sim_time else steady)
        self.create_timer(1.0, self._report, clock=steady)

    def _now(self, stamp: float = 0.0) -> float:
        """The clock of the stamps, s. Simulated time may reach this node after what was stamped with it."""
        now = float(1e-9 * self.get_clock().now().nanoseconds)
        return max(now, stamp) if self._sim_time else now

    def _accept(self, topic: str, stamp: float) -> float:
        """The clock of the stamps, s. Raises MessageError where the stamp (s) is not fit."""
        now = self._now(stamp)
        self._checks[topic].check(stamp, now)
        return now

    def _on_state(self, message: Any) -> None:
        start = time.perf_counter()
        try:
            state = read_low_state(message)
            now = self._accept("low_state", state.time)
        except MessageError as error:
            self._refusals.add("low_state", error)
            return
        self._pauses.look(now)
        longest = max(LONGEST if self._pauses.since_heard else 0.0, self._settings.max_state_age)
        state.time = self._robot_time.follow(state.time, state.tick, longest)
        self._pauses.heard()
        sent_again = self._waiting is not None and self._waiting.time == state.time
        if self._outruns_others(state) and not sent_again:
            self._waiting = state
        else:
            self._take(state, now, start)

    def _outruns_others(self, state: RobotState) -> bool:
        """Whether a simulator shall wait until the estimator, and in lockstep the mux, have kept up.

        Not for long: it sends a state again or goes on, and states that come after a while are no longer held up.
        """
        if not (self._sim_time or self._settings.robot_waits):
            return False
        held_up = [(self._velocity, 1.5 * PERIOD, self._settings.max_velocity_age)]
        if self._sim_time:
            late = 0.5 * self._settings.command_timeout
            held_up.append((self._command, late, late + HELD_UP * PERIOD))
        return any(last is not None and least < state.time - last[0] <= most for last, least, most in held_up)

    def _take(self, state: RobotState, now: float, start: float) -> None:
        """Answer the state if it is due. now, start: when that began, s, on the clock and on the steady clock."""
        self._waiting = None
        periods = self._grid.periods(state.time)
        if periods:
            self._tick(state, now)
            compute = time.perf_counter() - start
            late = self._now() - self._robot_time.stalled - state.time > PERIOD
            self._stats.add(start, compute, self._supervisor.inference_seconds, periods - 1 + late)
            self._supervisor.prepare()
        elif self._sim_time:  # a simulator in lockstep waits for the answer to each of its states
            self._answer.tick = state.tick
            self._publish()

    def _tick(self, state: RobotState, now: float) -> None:
        """One tick of the supervisor, and its command. now: s, on the clock; it is judged by what was known then."""
        overruns = 0 if self._settings.robot_waits else self._stats.in_a_row
        if overruns > self._settings.max_overruns:
            self._supervisor.fail(f"{self._stats.in_a_row} deadlines were missed in a row")
        self._state = state
        now -= self._robot_time.stalled
        velocity = _fresh(self._velocity, state.time, self._settings.max_velocity_age, self._patience)
        command = _fresh(self._command, now, self._settings.command_timeout)
        self._answer = self._supervisor.tick(now, state, velocity, command)
        self._publish()
        self._tell()

    def _publish(self) -> None:
        self._message.stamp = self.get_clock().now().to_msg()
        write_low_cmd(self._answer, self._message)
        self._low_cmd.publish(self._message)

    def _on_velocity(self, message: Any) -> None:
        try:
            stamp = seconds(message.header.stamp)
            now = self._accept("velocity_estimate", stamp)
            self._velocity = self._robot_time.at(stamp), linear_velocity(message.twist.twist)
        except MessageError as error:
            self._refusals.add("velocity_estimate", error)
            return
        self._resume(now)

    def _on_command(self, message: Any) -> None:
        try:
            stamp = seconds(message.stamp)
            now = self._accept("command", stamp)
            command = np.append(planar_velocity(message.twist), float(message.stance))
            self._command = self._robot_time.at(stamp), command
        except MessageError as error:
            self._refusals.add("command", error)
            return
        self._resume(now)

    def _resume(self, now: float) -> None:
        """Answer the state that waited, if nothing is behind any more."""
        if self._waiting is not None and not self._outruns_others(self._waiting):
            self._take(self._waiting, now, time.perf_counter())

    def _on_set_mode(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._supervisor.request(request.mode)
        if not response.success:
            self.get_logger().warning(f"refused mode {request.mode}: {response.message}")
        self._tell()
        return response

    def _on_enable_walking(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._supervisor.enable_walking(request.data)
        self.get_logger().info(f"the operator {'allows' if request.data else 'forbids'} walking")
        self._tell()
        return response

    def _tell(self) -> None:
        log = self.get_logger()
        for is_fault, sentence in self._announcements.now():
            (log.error if is_fault else log.info)(sentence)

    def _watch(self) -> None:
        """50 times a second: the supervisor learns when states stop, and controller/state is published."""
        now = self._now()
        self._pauses.look(now)
        silence = 0.0 if self._state is None else now - self._robot_time.stalled - self._state.time
        if self._state and silence > self._settings.max_state_age and not self._pauses.excuse(now):
            self._tick(self._state, now)
        self._controller_state.publish(self._describe())

    def _describe(self) -> Any:
        supervisor, stats = self._supervisor, self._stats.summary(time.perf_counter())
        message = ControllerState(
            stamp=self.get_clock().now().to_msg(),
            mode=MODES.index(supervisor.mode),
            mode_name=supervisor.mode,
            reason=supervisor.reason,
            walk_allowed=not supervisor.walk_refusal,
            walk_refusal=supervisor.walk_refusal,
            stance=bool(supervisor.command[3]),
            refused=self._refusals.total,
            **attrs.asdict(stats),
        )
        twist = message.command
        twist.linear.x, twist.linear.y, twist.angular.z = supervisor.command[:3].tolist()
        return message

    def _report(self) -> None:
        """Once a second: /diagnostics, and a look whether the robot is alone."""
        self._supervisor.obstacle = self._rival()
        level, summary = self._judge()
        values = {
            "mode": self._supervisor.mode,
            "reason": self._supervisor.reason,
            "policy": self._settings.policy or f"the shipped one ({SHIPPED_POLICY.name})",
            **{
                name: f"{value:.4g}"
                for name, value in attrs.asdict(self._stats.summary(time.perf_counter())).items()
            },
            "pauses": self._pauses.count,
            "stalled_s": f"{self._robot_time.stalled:.3f}",
            **self._refusals.values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))
        self._log(level, summary)

    def _log(self, level: bytes, summary: str) -> None:
        """Once a second: what keeps the robot from moving, and what an operator should look at, now and then."""
        log = self.get_logger()
        self._reports += 1
        for sentence in self._announcements.waiting():
            log.info(sentence)
        if self._supervisor.obstacle:
            log.error(self._supervisor.obstacle, throttle_duration_sec=QUIET)
        elif self._state is None:
            if self._reports == PATIENCE:
                log.warning(f"no message on low_state in {PATIENCE} s: is a simulator or a driver running?")
        elif level == DiagnosticStatus.WARN:
            log.warning(summary, throttle_duration_sec=QUIET)

    def _rival(self) -> str | None:
        """A sentence where more than one robot reports: what the states say then fits neither."""
        count = self._states.get_publisher_count()
        return (
            f"low_state has {count} publishers, expected 1: stop the other simulator" if count > 1 else None
        )

    def _judge(self) -> tuple[bytes, str]:
        """Level and summary of the last second."""
        refused = self._refusals.total - self._refused_before
        missed = self._stats.overruns - self._overruns_before
        paused = self._pauses.count - self._pauses_before
        self._refused_before, self._overruns_before = self._refusals.total, self._stats.overruns
        self._pauses_before = self._pauses.count
        status = f"{self._supervisor.mode}: {self._supervisor.reason}"
        if self._supervisor.mode == "fault":
            return DiagnosticStatus.ERROR, status
        if self._supervisor.obstacle:
            return DiagnosticStatus.ERROR, self._supervisor.obstacle
        if self._state is None:
            return DiagnosticStatus.WARN, "no message on low_state yet"
        if refused:
            return DiagnosticStatus.WARN, f"{refused} messages refused in the last second; {status}"
        if paused:
            return DiagnosticStatus.WARN, f"could not run {paused} times in the last second; {status}"
        if not self._stats.summary(time.perf_counter()).rate_hz:
            return DiagnosticStatus.WARN, f"no state came for a second; {status}"
        if missed:
            return DiagnosticStatus.WARN, f"{missed} deadlines missed in the last second; {status}"
        return DiagnosticStatus.OK, status


def _fresh(stamped: Stamped | None, now: float, limit: float, ahead: float = 0.0) -> Array | None:
    """The value, unless its time is more than `limit` (s) off, to come where the clock was set back.

    ahead: how much more it may be to come, s: of a state after a standstill that this node does not know of yet.
    """
    return stamped[1] if stamped is not None and -limit - ahead <= now - stamped[0] <= limit else None


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(Controller, args)

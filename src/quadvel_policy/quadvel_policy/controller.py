"""The node `controller`: answers the robot's states with joint commands at 200 Hz.

`ControlLoop` decides when to tick, the supervisor what to command.
"""

from __future__ import annotations

import gc
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

from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.state import JointCommand
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_msgs.msg import ControllerState, LowCmd, LowState, MotorStatus, VelocityCommand, Waiting
from quadvel_msgs.srv import SetMode
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.flat_messages import decode_estimate, decode_low_state, encode_low_cmd
from quadvel_nodes.messages import MessageError, Refusals, read_numbers, seconds
from quadvel_nodes.node import create_only_publisher, read_parameters, run
from quadvel_nodes.number_text import counted, number_text
from quadvel_nodes.robot_check import RobotCheck
from quadvel_nodes.scheduling import Scheduling
from quadvel_nodes.silence import SILENCE_LIMIT_S, SilenceWarning

from .control_loop import WATCH_PERIOD_S, ControlConfig, ControlLoop
from .loop_stats import LoopSummary
from .operator_log import OperatorLog
from .policy_file import SHIPPED_POLICY, chosen_policy
from .received import planar_velocity
from .supervisor import Supervisor
from .tick_input import MotorStatus as Motors
from .transitions import MODES

# Only the newest state is useful.
LATEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


@attrs.frozen(kw_only=True)
class ControllerParameters:
    """Parameters of the node and of its parts."""

    scheduling: Scheduling = Scheduling()
    control: ControlConfig = ControlConfig()
    robot: str = field(DEFAULT_ROBOT, "the robot: its name, or the path of a robot.yaml")
    policy: str = field("", "ONNX file of the policy; empty: the shipped one; none: only stand")


class Controller(Node):
    """Connects a ControlLoop to topics and services."""

    def __init__(self) -> None:
        super().__init__("controller")
        self._settings = read_parameters(self, ControllerParameters)
        robot = load_robot(self._settings.robot)
        self._robot_check = RobotCheck(self, robot)
        policy = chosen_policy(robot, self._settings.policy)
        self._supervisor = Supervisor(
            robot, policy, self._settings.control.supervisor, KalmanEstimator(robot)
        )
        self._sim_time: bool = self.get_parameter("use_sim_time").value
        self._loop = ControlLoop(
            self._supervisor,
            self._settings.control,
            self._publish,
            self._now,
            self._sim_time,
            None if self._sim_time else time.monotonic,
        )
        self._refusals = Refusals()
        self._overruns_before = self._pauses_before = 0
        self._operator_log = OperatorLog(self._supervisor)
        self._loop_summary = LoopSummary()  # of the last second
        self._silent_reports = 0  # since the last low_state
        self._silence = SilenceWarning(
            self.get_logger().warning, "low_state", "is a simulator or a driver running?"
        )
        self._create_interfaces()
        if not self._sim_time:  # simulated time waits for the node, so it needs no priority
            self._settings.scheduling.apply(self.get_logger().warning)
        gc.freeze()  # exclude existing objects from garbage collection, which would delay a tick

    def _create_interfaces(self) -> None:
        self._low_cmd = create_only_publisher(self, LowCmd, "low_cmd", 1)
        self._controller_state = self.create_publisher(ControllerState, "controller/state", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Best effort suits a robot's driver; a simulator in lockstep waits for the answer to each state.
        state_qos = (
            LATEST_QOS if self._sim_time else QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self._states = self.create_subscription(LowState, "low_state", self._on_state, state_qos, raw=True)
        self.create_subscription(Waiting, "waiting", self._on_waiting, LATEST_QOS)
        self.create_subscription(
            TwistWithCovarianceStamped, "velocity_estimate", self._on_velocity, LATEST_QOS, raw=True
        )
        self.create_subscription(VelocityCommand, "command", self._on_command, LATEST_QOS)
        self.create_subscription(MotorStatus, "motor_status", self._on_motors, 1)
        self.create_service(SetMode, "~/set_mode", self._on_set_mode)
        self.create_service(SetBool, "~/enable_walking", self._on_enable_walking)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # continues if the system clock is set back
        self.create_timer(WATCH_PERIOD_S, self._watch, clock=self.get_clock() if self._sim_time else steady)
        self.create_timer(1.0, self._report, clock=steady)

    def _now_ns(self) -> int:
        """Return the ROS time, ns; the system's time directly, as it is needed several times a tick."""
        return int(self.get_clock().now().nanoseconds) if self._sim_time else time.time_ns()

    def _now(self) -> float:
        return 1e-9 * self._now_ns()

    def _on_state(self, data: bytes) -> None:
        self._silent_reports = 0
        try:
            self._loop.on_state(decode_low_state(data)[1])
        except MessageError as error:
            self._refuse("low_state", error)

    def _on_waiting(self, message: Any) -> None:
        self._silent_reports = 0
        try:
            self._loop.on_waiting(seconds(message.stamp), message.tick)
        except MessageError as error:
            self._refuse("waiting", error)

    def _on_velocity(self, data: bytes) -> None:
        try:
            self._loop.on_velocity(*decode_estimate(data))
        except MessageError as error:
            self._refuse("velocity_estimate", error)

    def _on_command(self, message: Any) -> None:
        try:
            self._loop.on_command(seconds(message.stamp), planar_velocity(message.twist), message.stance)
        except MessageError as error:
            self._refuse("command", error)

    def _refuse(self, topic: str, error: MessageError) -> None:
        self._refusals.add(topic, error)
        self._loop.refuse(topic, error)

    def _on_motors(self, message: Any) -> None:
        try:
            temperature = read_numbers(message, "temperature", 12)
        except MessageError as error:
            self._refusals.add("motor_status", error)
            return
        self._loop.inputs.motors = Motors(temperature, np.array(message.dropped_out, bool))

    def _publish(self, answer: JointCommand) -> None:
        stamp = divmod(self._now_ns(), 10**9)
        self._low_cmd.publish(encode_low_cmd(stamp, answer))
        self._log_changes()

    def _on_set_mode(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._supervisor.request(request.mode, request.requester)
        if not response.success:
            self.get_logger().warning(f"refused mode {request.mode}: {response.message}")
        self._log_changes()
        return response

    def _on_enable_walking(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._supervisor.enable_walking(request.data)
        self.get_logger().info(f"{'allow' if request.data else 'forbid'} walking: {response.message}")
        self._log_changes()
        return response

    def _log_changes(self) -> None:
        log = self.get_logger()
        for is_fault, sentence in self._operator_log.changes():
            if is_fault:
                log.error(sentence)
            else:  # rclpy requires one severity per call site
                log.info(sentence)

    def _watch(self) -> None:
        """Run the watchdog of the loop and publish controller/state, at 50 Hz; its percentiles at 1 Hz."""
        self._loop.watch()
        if self._controller_state.get_subscription_count():
            self._controller_state.publish(self._state_message())

    def _state_message(self) -> Any:
        supervisor = self._supervisor
        stats = attrs.evolve(self._loop_summary, overruns=self._loop.stats.overruns)
        message = ControllerState(
            stamp=self.get_clock().now().to_msg(),
            mode=MODES.index(supervisor.mode),
            mode_name=supervisor.mode,
            reason=supervisor.reason,
            fault=supervisor.fault,
            findings=[finding.sentence for finding in supervisor.findings],
            walk_allowed=not supervisor.walk_refusal,
            walk_refusal=supervisor.walk_refusal,
            stance=bool(supervisor.command[3]),
            refused=self._refusals.total,
            **attrs.asdict(stats),
        )
        for twist, axes in (
            (message.command, supervisor.command[:3].tolist()),
            (message.trim, supervisor.trim),
        ):
            twist.linear.x, twist.linear.y, twist.angular.z = axes
        return message

    def _report(self) -> None:
        """Publish /diagnostics and check for a second publisher of states, at 1 Hz."""
        self._loop.inputs.duplicate_publisher = self._duplicate_publisher()
        self._loop_summary = self._loop.stats.summary(time.perf_counter())
        self._silent_reports += 1
        # In lockstep, where time stands still then, a robot that reported before counts as lost.
        if self._sim_time and self._loop.inputs.state is not None and self._silent_reports > SILENCE_LIMIT_S:
            self._supervisor.fail(
                f"no state came for {SILENCE_LIMIT_S} s: the simulator is silent", "state_stale"
            )
        level, summary = self._status()
        values = {
            "mode": self._supervisor.mode,
            "reason": self._supervisor.reason,
            "robot": self._settings.robot,
            "policy": self._settings.policy or f"the shipped one ({SHIPPED_POLICY.name})",
            **{name: number_text(value, ".4g") for name, value in attrs.asdict(self._loop_summary).items()},
            "velocity_trim": "{:.3f}, {:.3f} m/s, {:.3f} rad/s".format(*self._supervisor.trim),
            "pauses": self._loop.stall_detector.count,
            "stalled_s": f"{self._loop.stalled:.3f}",
            **{f"limit {name}": f"acted in {count} ticks" for name, count in self._supervisor.limits.items()},
            **self._refusals.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))
        self._log_status(level, summary)

    def _log_status(self, level: bytes, summary: str) -> None:
        """Log what keeps the robot from moving, and warnings, at 1 Hz or less."""
        log = self.get_logger()
        for sentence in self._operator_log.walk_refusals():
            log.info(sentence)
        if self._loop.inputs.duplicate_publisher:
            log.error(self._loop.inputs.duplicate_publisher, throttle_duration_sec=LOG_THROTTLE_S)
        elif self._loop.inputs.state is None:
            self._silence.report(False, str(self._loop.inputs.refused.get("low_state", "")))
        elif level == DiagnosticStatus.WARN:
            log.warning(summary, throttle_duration_sec=LOG_THROTTLE_S)

    def _duplicate_publisher(self) -> str | None:
        """Return a sentence if more than one node publishes states, which fit no single robot, else None."""
        count = self._states.get_publisher_count()
        return (
            f"low_state has {count} publishers, expected 1: stop the other simulator" if count > 1 else None
        )

    def _missing_state_text(self) -> str:
        refusal = self._loop.inputs.refused.get("low_state")
        return f"no valid message on low_state ({refusal})" if refusal else "no message on low_state"

    def _status(self) -> tuple[bytes, str]:
        """Return diagnostics level and summary of the last second."""
        refused = self._refusals.last_second()
        missed = self._loop.stats.overruns - self._overruns_before
        paused = self._loop.stall_detector.count - self._pauses_before
        self._overruns_before, self._pauses_before = (
            self._loop.stats.overruns,
            self._loop.stall_detector.count,
        )
        status = f"{self._supervisor.mode}: {self._supervisor.reason}"
        if self._supervisor.fault:
            return DiagnosticStatus.ERROR, status
        if self._loop.inputs.duplicate_publisher:
            return DiagnosticStatus.ERROR, self._loop.inputs.duplicate_publisher
        if self._loop.inputs.state is None:
            return DiagnosticStatus.WARN, f"{self._missing_state_text()} yet"
        writers = self.count_publishers(self._low_cmd.topic_name)
        if writers > 1:  # no fault: a silent one does no harm
            return DiagnosticStatus.WARN, f"low_cmd has {writers} publishers, expected 1; {status}"
        if self._supervisor.findings:
            return DiagnosticStatus.WARN, f"{self._supervisor.findings[0].sentence}; {status}"
        if refused:
            return DiagnosticStatus.WARN, f"{refused}; {status}"
        if paused:
            stalls = f"the controller's process stalled {counted(paused, 'time')} in the last second"
            return DiagnosticStatus.WARN, f"{stalls}: this computer was busy or suspended; {status}"
        if not self._loop.stats.summary(time.perf_counter()).rate_hz:
            return DiagnosticStatus.WARN, f"no state came for a second; {status}"
        if missed:
            return DiagnosticStatus.WARN, f"{counted(missed, 'deadline')} missed in the last second; {status}"
        return DiagnosticStatus.OK, status


def main(args: list[str] | None = None) -> None:
    """Run the node `controller`.

    Args:
        args: Command line arguments; None for those of the process.
    """
    run(Controller, args)

"""The node `sim_node`: the simulated robot on the topics of the real one. How it runs is `loop`'s matter."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from threading import Thread
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from quadvel_description.frames import BASE, ODOM, Placed
from quadvel_description.state import RobotState
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_msgs.srv import Push, ResetSim, StepSim
from quadvel_nodes.diagnostics import diagnostics
from quadvel_nodes.messages import Refusals, read_low_cmd, write_low_state
from quadvel_nodes.node import end, read_parameters, run
from quadvel_nodes.robot_view import RobotView, fill_quaternion, fill_vector, transforms
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.loop import REALTIME, LoopReport, SimulationLoop
from quadvel_sim.parameters import SimParameters
from quadvel_sim.simulator import Simulator, Truth

TRUTH_PERIOD = 5  # ms
VIEW_PERIOD = 20  # ms, of what `RobotView` publishes
STAMP_TOLERANCE = 10**6  # ns that system and monotonic clock may drift apart before the stamps follow


class SimNode(Node):
    """Topics and services around a SimulationLoop, which runs in a thread of its own."""

    def __init__(self, make_simulator: Callable[[SimulatorConfig], Simulator] = Simulator) -> None:
        super().__init__("sim_node")
        self._settings = read_parameters(self, SimParameters)
        simulator = make_simulator(self._settings.config())
        simulator.reset(self._settings.keyframe)
        self._refusals = Refusals()
        self._refused_before = self._unanswered_before = 0
        self._given_up_before = 0.0
        self._to_system_time = time.time_ns() - time.monotonic_ns()
        self._samples = 0
        self._failure = ""
        mode, period, timeout = self._settings.mode, self._settings.period, self._settings.answer_timeout
        self._loop = SimulationLoop(simulator, self._publish, mode, period, timeout)
        self._create_publishers()
        noise = simulator.config.noise
        self._view = RobotView(self, noise.orientation, noise.angular_velocity, noise.linear_acceleration)
        self.create_subscription(LowCmd, "low_cmd", self._on_command, 10)
        self.create_service(ResetSim, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(StepSim, "~/step", self._on_step)
        self.create_service(Push, "~/push", self._on_push)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        gc.freeze()  # what exists by now stays: the collector need not look at it in the middle of a period
        self._thread = Thread(target=self._simulate, name="simulation")
        self._thread.start()

    def destroy_node(self) -> None:
        """Stop the simulation, then the node."""
        self._loop.stop()
        self._thread.join()
        super().destroy_node()

    def _create_publishers(self) -> None:
        self._low_state = self.create_publisher(LowState, "low_state", 10)
        self._truth = self.create_publisher(Odometry, "ground_truth/odom", 10)
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        self._clock_publisher = self.create_publisher(ClockMessage, "/clock", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    # In the simulation's thread.

    def _simulate(self) -> None:
        try:
            if self._settings.mode == REALTIME:  # elsewhere nothing has to keep up with a clock
                self._settings.apply(self.get_logger().warning)
            self._loop.run()
        except Exception as error:  # whatever it was, the node must not go on without its robot
            self._failure = f"{type(error).__name__}: {error}"

    def _publish(self, state: RobotState, instant: float) -> None:
        if not self.context.ok():
            self._loop.stop()
            return
        stamp = self._stamp(instant)
        if self._settings.mode != REALTIME:
            self._clock_publisher.publish(ClockMessage(clock=stamp))
        message = LowState(stamp=stamp)
        write_low_state(state, message)
        self._low_state.publish(message)
        view = self._samples % max(1, VIEW_PERIOD // self._settings.period) == 0
        if self._samples % max(1, TRUTH_PERIOD // self._settings.period) == 0:
            self._publish_truth(stamp, self._loop.simulator.truth(), view and self._settings.publish_tf)
        if view:
            self._view.publish(stamp, state)
        self._samples += 1

    def _stamp(self, instant: float) -> Any:
        """The instant of a sample as a message; in real time in the time of the system clock."""
        nanoseconds = round(instant * 1e9)
        if self._settings.mode == REALTIME:
            shift = time.time_ns() - time.monotonic_ns()
            if abs(shift - self._to_system_time) > STAMP_TOLERANCE:  # else stamps would inherit its jitter
                self._to_system_time = shift
            nanoseconds += self._to_system_time
        return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

    def _publish_truth(self, stamp: Any, truth: Truth, transform: bool) -> None:
        message = Odometry(child_frame_id=BASE)
        message.header.stamp = stamp
        message.header.frame_id = ODOM
        fill_vector(message.pose.pose.position, truth.position)
        fill_quaternion(message.pose.pose.orientation, truth.quaternion)
        fill_vector(message.twist.twist.linear, truth.linear_velocity)
        fill_vector(message.twist.twist.angular, truth.angular_velocity)
        self._truth.publish(message)
        if transform:
            base = Placed(ODOM, BASE, truth.position, truth.quaternion)
            self._tf.publish(TFMessage(transforms=transforms(stamp, [base])))

    # In the executor's thread.

    def _on_command(self, message: Any) -> None:
        try:
            self._loop.submit(read_low_cmd(message))
        except ValueError as error:
            self._refusals.add("low_cmd", error)

    def _on_reset(self, request: Any, response: Any) -> Any:
        keyframe = request.keyframe or "lie"
        return _answer(response, f"the robot is back in posture {keyframe}", self._loop.reset, keyframe)

    def _on_pause(self, request: Any, response: Any) -> Any:
        done = "paused" if request.data else "running"
        return _answer(response, done, self._loop.pause, request.data)

    def _on_step(self, request: Any, response: Any) -> Any:
        return _answer(response, f"advances by {request.steps} ms", self._loop.step, request.steps)

    def _on_push(self, request: Any, response: Any) -> Any:
        force, torque = ([v.x, v.y, v.z] for v in (request.wrench.force, request.wrench.torque))
        body = request.body or "trunk"
        return _answer(response, f"{body} is pushed", self._loop.push, body, force, torque, request.duration)

    def _report(self) -> None:
        """Once a second: how the simulation does."""
        if self._failure:
            end(self, f"sim_node: {self._failure}")
            return
        report = self._loop.report()
        level, summary = self._judge(report)
        values = {
            "mode": self._settings.mode,
            "realtime_factor": f"{report.realtime_factor:.3f}",
            "worst_lateness_ms": f"{1e3 * report.worst_lateness:.2f}",
            "given_up_s": f"{report.given_up:.3f}",
            "unanswered": report.unanswered,
            "braking": report.braking,
            "fallen": report.fallen,
            **self._refusals.values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))

    def _judge(self, report: LoopReport) -> tuple[bytes, str]:
        """Level and summary of the last second."""
        refused = self._refusals.total - self._refused_before
        unanswered = report.unanswered - self._unanswered_before
        given_up = report.given_up - self._given_up_before
        self._refused_before, self._unanswered_before = self._refusals.total, report.unanswered
        self._given_up_before = report.given_up
        if refused:
            return DiagnosticStatus.WARN, f"{refused} messages refused in the last second"
        if unanswered:
            return DiagnosticStatus.WARN, "waiting for the LowCmd that answers the last state"
        if given_up:
            return DiagnosticStatus.WARN, f"this machine is too slow: {given_up:.2f} s of real time given up"
        if self._loop.paused:
            return DiagnosticStatus.OK, "paused"
        return DiagnosticStatus.OK, "no command: the drives brake" if report.braking else "running"


def _answer(response: Any, done: str, order: Any, *arguments: Any) -> Any:
    """Carry out an order and tell how it went."""
    try:
        order(*arguments)
        response.success, response.message = True, done
    except ValueError as error:
        response.success, response.message = False, str(error)
    return response


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(SimNode, args)

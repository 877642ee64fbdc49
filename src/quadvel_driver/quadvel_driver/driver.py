"""The node `driver`: connects the real robot to the topics of the controller.

A `Link` runs in its own thread and calls back with each state; commands arrive in the executor's
thread. Commands of the operator's remote become cmd_vel_teleop, command_lock and calls of the
controller's services.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from functools import partial
from threading import Thread
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quadvel_description.robot import Robot
from quadvel_msgs.msg import LowCmd, LowState, MotorStatus
from quadvel_msgs.srv import SetMode
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.flat_messages import decode_low_cmd, encode_low_state
from quadvel_nodes.messages import Refusals
from quadvel_nodes.node import create_only_publisher, read_parameters, request_exit, run
from quadvel_nodes.robot_check import RobotCheck
from quadvel_nodes.robot_view import RobotView
from quadvel_nodes.system_time import SystemTime

from .board_state import BoardState
from .decimator import Decimator
from .dry_run import DryRun
from .health import Health, Level, diagnostic_values, dropped_out
from .link import SILENCE_LIMIT_S
from .open_link import open_link
from .parameters import DriverParameters
from .remote import OperatorCommand, RemotePilot

OPERATOR_PERIOD_S = 0.02  # period of processing the remote and of cmd_vel_teleop
PERIODS_PER_LOCK = 5  # a stop is published repeatedly, for nodes that start later
STARTUP_REPORTS = 3  # number of reports (1 Hz) without a warning, while the board may be starting
VIEW_RATE_HZ = 50  # rate of `RobotView`
MOTOR_RATE_HZ = 10  # rate of motor_status
# Standard deviations of the IMU, rad, rad/s, m/s^2: typical values; those of the AlienGo are unknown.
ORIENTATION_STD_RAD, ANGULAR_VELOCITY_STD, LINEAR_ACCELERATION_STD = 0.002, 0.01, 0.1


class Driver(Node):
    """Publishes the states of a `Link` and forwards commands to it."""

    def __init__(self) -> None:
        super().__init__("driver")
        self._settings = settings = read_parameters(self, DriverParameters)
        opened = open_link(settings, self._on_state)
        self._link, self._robot = opened.link, opened.robot
        self._health = Health(opened.board, self._robot)
        self._pilot = RemotePilot(settings)
        self._orders: deque[OperatorCommand] = deque()
        self._newest: BoardState | None = None
        self._refusals = Refusals()
        self._system_time = SystemTime()
        self._state_decimator, self._view_decimator = Decimator(settings.state_rate), Decimator(VIEW_RATE_HZ)
        self._motor_decimator = Decimator(MOTOR_RATE_HZ)
        self._operator_ticks = 0
        self._reports = 0
        self._passive_wanted = False
        self._last_logged = ""
        self._last_level = Level.ERROR
        self._failure = ""
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self._enable_walking = self.create_client(SetBool, "controller/enable_walking")
        self.create_subscription(LowCmd, "low_cmd", self._on_command, 1, raw=True)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if opened.dry_run:  # it may run next to a simulator, so it must not publish as a robot
            self.create_timer(1.0, partial(self._show, opened.dry_run), clock=steady)
            self._robot_check = RobotCheck(self, self._robot)
        else:
            self._create_publishers()
            self.create_timer(OPERATOR_PERIOD_S, self._serve_operator, clock=steady)
            self.create_timer(1.0, self._report, clock=steady)
        gc.freeze()  # exclude existing objects from garbage collection, which would delay a period
        self._thread = Thread(target=self._serve_link, name="link")
        self._thread.start()

    def destroy_node(self) -> None:
        """Stop the link, which brakes the robot, then destroy the node."""
        self._link.stop()
        self._thread.join()
        super().destroy_node()

    def _create_publishers(self) -> None:
        self._low_state = create_only_publisher(self, LowState, "low_state", 10)
        self._motors = self.create_publisher(MotorStatus, "motor_status", 1)
        self._view = RobotView(
            self, self._robot, ORIENTATION_STD_RAD, ANGULAR_VELOCITY_STD, LINEAR_ACCELERATION_STD
        )
        self._teleop = self.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._lock = self.create_publisher(Bool, "command_lock", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    # Methods of the link's thread.

    def _serve_link(self) -> None:
        try:
            self._settings.apply(self.get_logger().warning)
            self._link.run()
        except Exception as error:  # the node must not continue without its robot
            self._failure = f"{type(error).__name__}: {error}"

    def _on_state(self, state: BoardState) -> None:
        self._newest = state
        order = self._pilot.update(state.remote, time.monotonic())
        if order is OperatorCommand.STOP:
            self._link.brake()
        if order is not None:
            self._orders.append(order)
        if not self.context.ok():
            return
        robot = state.robot
        stamp = self._system_time.stamp(robot.time)
        if self._state_decimator.accepts(robot.tick):
            self._low_state.publish(encode_low_state((stamp.sec, stamp.nanosec), robot))
        if self._view_decimator.accepts(robot.tick):
            self._view.publish(stamp, robot)
        if self._motor_decimator.accepts(robot.tick):
            self._motors.publish(motor_status(stamp, state, self._robot))

    # Methods of the executor's thread.

    def _on_command(self, data: bytes) -> None:
        try:
            self._link.submit(decode_low_cmd(data))
        except ValueError as error:
            self._refusals.add("low_cmd", error)

    def _serve_operator(self) -> None:
        """Execute the remote's commands and publish its velocity, at 50 Hz."""
        while self._orders:
            self._execute(self._orders.popleft())
        velocity = self._pilot.velocity(time.monotonic())
        if velocity is not None and not self._is_silent():
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._teleop.publish(twist)
        self._operator_ticks += 1
        if self._pilot.stopped and self._operator_ticks % PERIODS_PER_LOCK == 0:
            self._lock.publish(Bool(data=True))
            if self._passive_wanted:
                self._request_mode("passive")

    def _execute(self, order: OperatorCommand) -> None:
        self.get_logger().info(f"remote: {order.value}")
        if order is OperatorCommand.STOP:
            self._passive_wanted = True
            self._lock.publish(Bool(data=True))
            self._request_mode("passive")
        elif order is OperatorCommand.RELEASE:
            self._release()
        elif order in (OperatorCommand.STAND_UP, OperatorCommand.LIE_DOWN):
            self._request_mode(order.value.replace(" ", "_"))
        else:
            allowed = order is OperatorCommand.ALLOW_WALKING
            self._call(self._enable_walking, SetBool.Request(data=allowed), order.value)

    def _release(self) -> None:
        why_not = self._link.release()
        if why_not:
            self.get_logger().warning(f"the stop is not released: {why_not}")
            return
        self._pilot.stopped = self._passive_wanted = False
        self._lock.publish(Bool(data=False))

    def _request_mode(self, mode: str) -> None:
        requester = "the stop of the remote" if self._pilot.stopped else "the remote"
        self._call(self._set_mode, SetMode.Request(mode=mode, requester=requester), mode)

    def _call(self, client: Any, request: Any, what: str) -> None:
        """Call a service of the controller and log the result."""
        if not client.service_is_ready():
            self._log_once(f"{what}: the controller is not running")
            return

        def answered(future: Any) -> None:
            response = future.result()
            if what == "passive" and response.success:
                self._passive_wanted = False
            self._log_once(
                f"{what}: {response.message}" if response.success else f"{what} refused: {response.message}"
            )

        client.call_async(request).add_done_callback(answered)

    def _log_once(self, text: str) -> None:
        """Log a sentence if it differs from the last one."""
        if text != self._last_logged:
            self.get_logger().info(text)
        self._last_logged = text

    def _is_silent(self) -> bool:
        """Return whether the newest data of the remote is too old to be used."""
        return self._newest is None or time.monotonic() - self._newest.robot.time > SILENCE_LIMIT_S

    def _has_failed(self) -> bool:
        """Return whether the link has ended by an error; the node then ends, too."""
        if self._failure:
            request_exit(self, f"driver: {self._failure}")
        return bool(self._failure)

    def _show(self, dry_run: DryRun) -> None:
        """Log the packets that a dry run keeps back, at 1 Hz."""
        if not self._has_failed():
            self.get_logger().info(dry_run.summary())

    def _report(self) -> None:
        """Publish /diagnostics, at 1 Hz."""
        if self._has_failed():
            return
        report = self._link.report()
        level, summary = self._health.assess(report, self._newest, self._pilot.stopped)
        values = {
            **diagnostic_values(report, self._newest, self._robot),
            "stopped": self._pilot.stopped,
            **self._refusals.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), bytes([level]), summary, values))
        self._reports += 1
        if level > Level.OK and self._reports > STARTUP_REPORTS:
            self.get_logger().warning(summary, throttle_duration_sec=LOG_THROTTLE_S)
        elif level == Level.OK != self._last_level:
            self.get_logger().info(f"the joints of {self._robot.title} are under control: {summary}")
        self._last_level = level


def motor_status(stamp: Any, state: BoardState, robot: Robot) -> Any:
    """Build the motor_status message of a state.

    Args:
        stamp: Time of the state, a builtin_interfaces/Time.
        state: State of the board.
        robot: Codes of the board.

    Returns:
        A quadvel_msgs/MotorStatus.
    """
    return MotorStatus(
        stamp=stamp,
        temperature=state.temperature.astype(np.float32),
        dropped_out=dropped_out(state, robot).tolist(),
    )


def main(args: list[str] | None = None) -> None:
    """Run the node `driver`.

    Args:
        args: Command line arguments; None for those of the process.
    """
    run(Driver, args)

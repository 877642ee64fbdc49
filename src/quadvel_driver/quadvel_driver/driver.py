"""The node `driver`: the real robot on the topics that the controller knows.

Topics around a `UdpLink`, which runs in a thread of its own and hands on the states in it; commands come in the executor's
thread. What the operator's remote asks for becomes cmd_vel_teleop, command_lock and calls of the controller's services.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from threading import Thread
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quadvel_msgs.msg import LowCmd, LowState, MotorStatus
from quadvel_msgs.srv import SetMode
from quadvel_nodes.diagnostics import QUIET, diagnostics
from quadvel_nodes.messages import Refusals, read_low_cmd, write_low_state
from quadvel_nodes.node import end, read_parameters, run
from quadvel_nodes.robot_view import RobotView
from quadvel_nodes.system_time import SystemTime

from .decimator import Decimator
from .dry_run import DryRun
from .health import DROPPED_OUT, Health, Level, figures
from .link import SILENCE, UdpLink
from .parameters import DriverParameters
from .remote import Order, RemotePilot
from .wire import BoardState

OPERATOR_PERIOD = 0.02  # s, of looking at the remote's orders and of cmd_vel_teleop
LOCK_EVERY = 5  # of these periods: a stop is said again, to whoever came later
GRACE = 3  # reports, one a second, in which a board may be silent that is only being started
VIEW_RATE = 50  # Hz, of what `RobotView` publishes
MOTOR_RATE = 10  # Hz, of temperatures and of what the board switched off
# Standard deviations of the IMU, rad, rad/s, m/s^2: of its class; those of the AlienGo's own are not known.
ORIENTATION, ANGULAR_VELOCITY, LINEAR_ACCELERATION = 0.002, 0.01, 0.1


class Driver(Node):
    """Topics around one link."""

    def __init__(self) -> None:
        super().__init__("driver")
        self._settings = settings = read_parameters(self, DriverParameters)
        self._dry_run = DryRun() if settings.dry_run else None
        self._link = UdpLink(settings, self._on_state, settings.correction(), self._dry_run)
        self._health = Health(f"{settings.board_address}:{settings.board_port}")
        self._pilot = RemotePilot(settings)
        self._orders: deque[Order] = deque()
        self._newest: BoardState | None = None
        self._refusals = Refusals()
        self._system_time = SystemTime()
        self._thinning, self._view_thinning = Decimator(settings.state_rate), Decimator(VIEW_RATE)
        self._motor_thinning = Decimator(MOTOR_RATE)
        self._operator_ticks = 0
        self._reports = 0
        self._passive_wanted = False
        self._said = ""
        self._failure = ""
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self._enable_walking = self.create_client(SetBool, "controller/enable_walking")
        self.create_subscription(LowCmd, "low_cmd", self._on_command, 1)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if self._dry_run:  # beside a simulator, whose topics are not to be taken for a robot's
            show = self._dry_run.shown
            self.create_timer(1.0, lambda: self.get_logger().info(show()), clock=steady)
        else:
            self._create_publishers()
            self.create_timer(OPERATOR_PERIOD, self._serve_operator, clock=steady)
            self.create_timer(1.0, self._report, clock=steady)
        gc.freeze()  # what exists by now stays: the collector need not look at it in the middle of a period
        self._thread = Thread(target=self._serve_link, name="link")
        self._thread.start()

    def destroy_node(self) -> None:
        """Leave the robot braking, then end the node."""
        self._link.stop()
        self._thread.join()
        super().destroy_node()

    def _create_publishers(self) -> None:
        self._low_state = self.create_publisher(LowState, "low_state", 10)
        self._motors = self.create_publisher(MotorStatus, "motor_status", 1)
        self._view = RobotView(self, ORIENTATION, ANGULAR_VELOCITY, LINEAR_ACCELERATION)
        self._teleop = self.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._lock = self.create_publisher(Bool, "command_lock", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    # In the link's thread.

    def _serve_link(self) -> None:
        try:
            self._settings.apply(self.get_logger().warning)
            self._link.run()
        except Exception as error:  # whatever it was, the node must not go on without its robot
            self._failure = f"{type(error).__name__}: {error}"

    def _on_state(self, state: BoardState) -> None:
        self._newest = state
        order = self._pilot.follow(state.remote, time.monotonic())
        if order is Order.STOP:
            self._link.brake()
        if order is not None:
            self._orders.append(order)
        if not self.context.ok():
            return
        robot = state.robot
        stamp = self._system_time.stamp(robot.time)
        if self._thinning.passes(robot.tick):
            message = LowState(stamp=stamp)
            write_low_state(robot, message)
            self._low_state.publish(message)
        if self._view_thinning.passes(robot.tick):
            self._view.publish(stamp, robot)
        if self._motor_thinning.passes(robot.tick):
            self._motors.publish(motor_status(stamp, state))

    # In the executor's thread.

    def _on_command(self, message: Any) -> None:
        try:
            self._link.submit(read_low_cmd(message))
        except ValueError as error:
            self._refusals.add("low_cmd", error)

    def _serve_operator(self) -> None:
        """50 times a second: carry out what the remote asked for."""
        while self._orders:
            self._carry_out(self._orders.popleft())
        velocity = self._pilot.velocity(time.monotonic())
        if velocity is not None and not self._is_silent():
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._teleop.publish(twist)
        self._operator_ticks += 1
        if self._pilot.stopped and self._operator_ticks % LOCK_EVERY == 0:
            self._lock.publish(Bool(data=True))
            if self._passive_wanted:
                self._ask_for_mode("passive")

    def _carry_out(self, order: Order) -> None:
        self.get_logger().info(f"the remote says: {order.value}")
        if order is Order.STOP:
            self._passive_wanted = True
            self._lock.publish(Bool(data=True))
            self._ask_for_mode("passive")
        elif order is Order.RELEASE:
            self._release()
        elif order in (Order.STAND_UP, Order.LIE_DOWN):
            self._ask_for_mode(order.value.replace(" ", "_"))
        else:
            allowed = order is Order.ALLOW_WALKING
            self._call(self._enable_walking, SetBool.Request(data=allowed), order.value)

    def _release(self) -> None:
        why_not = self._link.release()
        if why_not:
            self.get_logger().warning(f"the stop stays: {why_not}")
            return
        self._pilot.stopped = self._passive_wanted = False
        self._lock.publish(Bool(data=False))

    def _ask_for_mode(self, mode: str) -> None:
        self._call(self._set_mode, SetMode.Request(mode=mode), mode)

    def _call(self, client: Any, request: Any, what: str) -> None:
        """Call a service of the controller and say how it went."""
        if not client.service_is_ready():
            self._say(f"{what}: the controller is not there")
            return

        def answered(future: Any) -> None:
            response = future.result()
            if what == "passive" and response.success:
                self._passive_wanted = False
            self._say(
                f"{what}: {response.message}" if response.success else f"{what} refused: {response.message}"
            )

        client.call_async(request).add_done_callback(answered)

    def _say(self, text: str) -> None:
        """Log a sentence, once while it stays the same."""
        if text != self._said:
            self.get_logger().info(text)
        self._said = text

    def _is_silent(self) -> bool:
        """Whether what the remote said last is of long ago."""
        return self._newest is None or time.monotonic() - self._newest.robot.time > SILENCE

    def _report(self) -> None:
        """Once a second: /diagnostics."""
        if self._failure:
            end(self, f"driver: {self._failure}")
            return
        report = self._link.report()
        level, summary = self._health.judge(report, self._newest, self._pilot.stopped)
        values = {**figures(report, self._newest), "stopped": self._pilot.stopped, **self._refusals.values()}
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), bytes([level]), summary, values))
        self._reports += 1
        if level > Level.OK and self._reports > GRACE:
            self.get_logger().warning(summary, throttle_duration_sec=QUIET)


def motor_status(stamp: Any, state: BoardState) -> Any:
    """The message."""
    return MotorStatus(
        stamp=stamp,
        temperature=state.temperature.astype(np.float32),
        dropped_out=(state.motor_mode == DROPPED_OUT).tolist(),
    )


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(Driver, args)

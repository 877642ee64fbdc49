"""Base class of the simulation's ROS nodes: time, ground truth, services and diagnostics.

The subclasses in `sim_node` and `board_node` define how the robot is commanded and how it reports.
"""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable
from threading import Thread
from time import monotonic
from typing import Any, Generic, TypeVar

import attrs
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker

from quadvel_description.frames import BASE, ODOM, FramePose
from quadvel_description.state import RobotState
from quadvel_msgs.srv import Push, ResetSim, StepSim
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.node import read_parameters, request_exit
from quadvel_nodes.robot_view import LATCHED, fill_quaternion, fill_vector, transform_messages
from quadvel_nodes.system_time import SystemTime, as_time
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.loop import REALTIME, LoopReport
from quadvel_sim.parameters import PlantParameters
from quadvel_sim.simulator import Simulator, Truth
from quadvel_sim.slowness import SlownessLog
from quadvel_sim.terrain import Terrain
from quadvel_sim.world_view import WorldView

TRUTH_PERIOD_MS = 5
VIEW_PERIOD_MS = 20
"""Period of the topics for display."""
GROUND_SIZE_M, GROUND_SPACING_M = 16.0, 0.16
"""Edge of the displayed square of ground, and distance of its points."""
GROUND_RGBA = (0.25, 0.29, 0.32, 1.0)

Settings = TypeVar("Settings", bound=PlantParameters)


class SimulationNode(Node, ABC, Generic[Settings]):
    """Services and ground truth around a SimulationLoop in a thread that `start` begins."""

    def __init__(
        self,
        name: str,
        parameters: type[Settings],
        make_simulator: Callable[[SimulatorConfig], Simulator] = Simulator,
    ) -> None:
        """Read the parameters and create the simulation; `start` runs it.

        Args:
            name: Name of the node.
            parameters: Class of the parameters.
            make_simulator: Creates the simulator from its configuration.
        """
        super().__init__(name)
        self._settings, self._make_simulator = read_parameters(self, parameters), make_simulator
        simulator = make_simulator(self._settings.config())
        simulator.reset(self._settings.keyframe)
        has_model = simulator.config.robot.actuator_file.exists()
        self._own_actuator = (
            "the robot's own" if has_model else "a plain PD law: the robot has no actuator.yaml"
        )
        self._system_time = SystemTime()
        self._samples = 0
        self._given_up_before = 0.0
        self._slowness = SlownessLog()
        self._has_fallen = False
        self._failure = ""
        self._loop = self._settings.make_loop(simulator, self._publish, self.publish_waiting)
        world = simulator.config.world
        self._world_view = None if world is None else WorldView(self, world)
        self._thread = Thread(target=self._simulate, name="simulation")
        self._truth = self.create_publisher(Odometry, "ground_truth/odom", 10)
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        self._ground = self.create_publisher(Marker, "ground", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(ResetSim, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(StepSim, "~/step", self._on_step)
        self.create_service(Push, "~/push", self._on_push)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def start(self) -> None:
        """Start the simulation; call it when everything that `publish_sample` needs exists."""
        self._publish_ground(self._loop.simulator.config.terrain)
        gc.freeze()  # shortens garbage collections during a period: present objects are permanent
        self._thread.start()

    def destroy_node(self) -> None:
        """Stop the simulation, then the node."""
        self._loop.stop()
        self._thread.join()
        super().destroy_node()

    # Interface of the subclasses.

    @abstractmethod
    def publish_sample(self, state: RobotState, instant: float, view_is_due: bool) -> None:
        """Publish one state; called in the thread of the simulation.

        Args:
            state: State of the robot.
            instant: Time of the state, s: of the monotonic clock in real time, else simulated.
            view_is_due: Whether topics for display are due, too.
        """

    @abstractmethod
    def diagnostic_values(self) -> dict[str, object]:
        """Return further values for /diagnostics.

        Returns:
            Values by name.
        """

    @abstractmethod
    def warning_text(self, report: LoopReport) -> str:
        """Return a warning about the last second beyond those of the loop.

        Args:
            report: Statistics of the loop.

        Returns:
            Short text; empty without a warning.
        """

    def publish_waiting(self, tick: int, instant: float) -> None:
        """Report that simulated time stands still; the default does nothing.

        Args:
            tick: Tick at which time stands still.
            instant: Present time, s.
        """

    def stamp(self, instant: float) -> Any:
        """Convert the time of a sample to a ROS time message.

        Args:
            instant: Time of the sample, s; in real time it is converted to the system clock.

        Returns:
            A builtin_interfaces/Time.
        """
        if self._loop.mode == REALTIME:
            return self._system_time.stamp(instant)
        return as_time(round(instant * 1e9))

    def _publish_ground(self, terrain: Terrain) -> None:
        """Publish the ground as a latched marker in the frame odom; delete it if it is flat."""
        flat = terrain.kind == "flat"
        marker = Marker(ns="ground", type=Marker.TRIANGLE_LIST, action=Marker.DELETE if flat else Marker.ADD)
        marker.header.frame_id = ODOM
        marker.pose.orientation.w = marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        marker.color.r, marker.color.g, marker.color.b, marker.color.a = GROUND_RGBA
        step = GROUND_SPACING_M if terrain.is_grid else GROUND_SIZE_M
        corners = [] if flat else terrain.triangles(GROUND_SIZE_M, step).tolist()
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in corners]
        self._ground.publish(marker)

    # In the simulation's thread.

    def _simulate(self) -> None:
        """Run the loop; keep its error for `_report`."""
        try:
            if self._loop.mode == REALTIME:  # other modes need no real-time scheduling
                self._settings.apply(self.get_logger().warning)
            self._loop.run()
        except Exception as error:  # the node must not continue without its robot
            self._failure = f"{type(error).__name__}: {error}"

    def _publish(self, state: RobotState, instant: float) -> None:
        if not self.context.ok():
            self._loop.stop()
            return
        view = self._samples % max(1, VIEW_PERIOD_MS // self._settings.period) == 0
        self.publish_sample(state, instant, view)
        if self._world_view is not None:
            self._world_view.publish(self.stamp(instant), self._loop.simulator, view)
        truth = self._samples % max(1, TRUTH_PERIOD_MS // self._settings.period) == 0
        transform = view and self._settings.publish_tf
        if truth and (transform or self._truth.get_subscription_count()):
            self._publish_truth(self.stamp(instant), self._loop.simulator.truth(), transform)
        self._samples += 1

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
            base = FramePose(ODOM, BASE, truth.position, truth.quaternion)
            self._tf.publish(TFMessage(transforms=transform_messages(stamp, [base])))

    # In the executor's thread.

    def _on_reset(self, request: Any, response: Any) -> Any:
        keyframe, terrain = request.keyframe or "lie", request.terrain
        done = f"the robot is back in posture {keyframe}" + (f", on {terrain} ground" if terrain else "")
        return self._respond(response, done, self._reset, keyframe, terrain, request.slope)

    def _reset(self, keyframe: str, terrain: str, slope: float) -> None:
        """Reset the robot; a terrain name replaces the simulator."""
        if not terrain:
            if slope:
                raise ValueError(
                    f"slope: found {slope:g} rad without a terrain, expected terrain slope or rough"
                )
            self._loop.reset(keyframe)
            return
        ground = self._settings.make_terrain(terrain, slope)
        config = attrs.evolve(self._loop.simulator.config, terrain=ground)
        self._loop.reset(keyframe, self._make_simulator(config))
        self._publish_ground(ground)

    def _on_pause(self, request: Any, response: Any) -> Any:
        done = "paused" if request.data else "running"
        return self._respond(response, done, self._loop.pause, request.data)

    def _on_step(self, request: Any, response: Any) -> Any:
        return self._respond(response, f"advances by {request.steps} ms", self._loop.step, request.steps)

    def _on_push(self, request: Any, response: Any) -> Any:
        force, torque = ([v.x, v.y, v.z] for v in (request.wrench.force, request.wrench.torque))
        body = request.body or "trunk"
        return self._respond(
            response, f"{body} is pushed", self._loop.push, body, force, torque, request.duration
        )

    def _respond(self, response: Any, success_text: str, action: Any, *arguments: Any) -> Any:
        """Execute an action; report its success or its error to caller and log."""
        try:
            action(*arguments)
            response.success, response.message = True, success_text
            self.get_logger().info(success_text)
        except ValueError as error:
            response.success, response.message = False, str(error)
            self.get_logger().warning(f"refused: {error}")
        return response

    def _report(self) -> None:
        """Publish the diagnostics of the last second."""
        if self._failure:
            request_exit(self, f"{self.get_name()}: {self._failure}")
            return
        report = self._loop.report()
        warning = self.warning_text(report)
        level, summary = self._level_and_summary(report, warning)
        values = {
            "mode": self._loop.mode,
            "actuator": self._settings.actuator_file or self._own_actuator,
            "realtime_factor": f"{report.realtime_factor:.3f}",
            "worst_lateness_ms": f"{1e3 * report.worst_lateness:.2f}",
            "given_up_s": f"{report.given_up:.3f}",
            "unanswered": report.unanswered,
            "braking": report.braking,
            "fallen": report.fallen,
            **self._world_values(report),
            **self.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))
        if warning:
            self.get_logger().warning(warning, throttle_duration_sec=LOG_THROTTLE_S)
        if slow := self._slowness.next_line(monotonic(), report.given_up):
            self.get_logger().warning(slow)
        if report.fallen and not self._has_fallen:
            self.get_logger().warning(
                "the robot has fallen, or lies down: quadvel reset (service ~/reset) puts it back"
            )
        self._has_fallen = report.fallen

    def _world_values(self, report: LoopReport) -> dict[str, object]:
        """Return the diagnostic values of a world, if there is one."""
        if self._world_view is None:
            return {}
        touched = ", ".join(f"{name} {count}" for name, count in sorted(report.touch_counts.items()))
        return {"world": self._settings.world, "touched": touched or "nothing"}

    def _level_and_summary(self, report: LoopReport, warning: str) -> tuple[bytes, str]:
        """Return diagnostic level and summary of the last second."""
        given_up = report.given_up - self._given_up_before
        self._given_up_before = report.given_up
        if warning:
            return DiagnosticStatus.WARN, warning
        if given_up:
            return DiagnosticStatus.WARN, f"this machine is too slow: {given_up:.2f} s of real time given up"
        if self._loop.paused:
            return DiagnosticStatus.OK, "paused"
        return DiagnosticStatus.OK, "no command: the drives brake" if report.braking else "running"

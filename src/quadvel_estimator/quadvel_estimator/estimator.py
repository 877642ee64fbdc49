"""The node `estimator`: converts low_state and low_cmd to velocity_estimate, odom and /tf.

`learned` and `kalman` estimate the velocity; `tracker` selects the states that they process.
"""

from __future__ import annotations

import gc
from time import perf_counter
from typing import Any

import attrs
import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from quadvel_description.arrays import Array
from quadvel_description.fields import field, positive
from quadvel_description.frames import BASE, ODOM, FramePose, footprint
from quadvel_description.kinematics import rotate
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.state import RobotState
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.flat_messages import Stamp, decode_low_cmd, decode_low_state, encode_estimate
from quadvel_nodes.messages import MessageError, Refusals
from quadvel_nodes.node import create_only_publisher, read_parameters, run
from quadvel_nodes.robot_check import RobotCheck
from quadvel_nodes.robot_view import fill_quaternion, fill_vector, transform_messages
from quadvel_nodes.scheduling import Scheduling
from quadvel_nodes.silence import SilenceWarning
from quadvel_nodes.stall_free_clock import StallFreeClock

from .kalman import KalmanEstimator
from .learned import LearnedEstimator
from .tracker import Estimate, Estimator, VelocityTracker

KINDS = ("learned", "kalman")
ESTIMATES_PER_ODOMETRY = 4  # odometry at 50 Hz
GYRO_VARIANCE = 1e-4  # (rad/s)^2, of the angular velocity that is passed on
ORIENTATION_VARIANCE = 1e-4  # rad^2, of the orientation that is passed on
HEIGHT_VARIANCE = 1e6
"""m^2, of z in `odom`: so large that a filter which fuses `odom` ignores z."""
_ANGULAR = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])  # selects the rotations about x, y, z


@attrs.frozen
class EstimatorParameters(Scheduling):
    """Parameters of the node `estimator`.

    Attributes:
        robot: Name of the robot, or path of a robot.yaml.
        kind: "learned" or "kalman".
        model: ONNX file of the learned estimator; empty for the shipped one.
        reset_gap: Time without a state after which the estimator is reset, s.
        odom_frame: Parent frame of the odometry.
        body_frame: Child frame of the odometry; velocities are in this frame.
        publish_tf: Whether to publish transforms on /tf.
    """

    robot: str = field(DEFAULT_ROBOT, "the robot: its name, or the path of a robot.yaml")
    kind: str = field("learned", f"how velocity is estimated: {' or '.join(KINDS)}", one_of=KINDS)
    model: str = field("", "file of the learned estimator's network, ONNX; empty: the shipped one")
    reset_gap: float = positive(0.1, "time without a state after which the estimator is reset, s")
    odom_frame: str = field(ODOM, "frame of the odometry's pose")
    body_frame: str = field(BASE, "frame of the velocities, the odometry's child")
    publish_tf: bool = field(
        True, "whether to publish the transforms of body_frame in odom_frame and of base_footprint"
    )

    def make_estimator(self, robot: Robot) -> Estimator:
        """Create the estimator that `kind` names.

        Args:
            robot: The robot, loaded.

        Returns:
            The estimator.

        Raises:
            NetworkFileError: The file of the network is missing or does not fit.
        """
        if self.kind == "kalman":
            return KalmanEstimator(robot)
        return LearnedEstimator(robot, self.model or None)


class EstimatorNode(Node):
    """Publishes an estimate from the callback of each state, before the next tick of the controller."""

    def __init__(self) -> None:
        super().__init__("estimator")
        self._settings = read_parameters(self, EstimatorParameters)
        self._robot = load_robot(self._settings.robot)
        self._robot_check = RobotCheck(self, self._robot)
        self._tracker = VelocityTracker(self._settings.make_estimator(self._robot), self._settings.reset_gap)
        self._robot_time = StallFreeClock()
        self._refusals = Refusals()
        self._reported = _ReportedCounts()
        self._silence = SilenceWarning(
            self.get_logger().warning, "low_state", "is a simulator or a driver running?"
        )
        self._count = 0
        self._busy_s = 0.0  # computing time of all estimates
        self._velocity = create_only_publisher(self, TwistWithCovarianceStamped, "velocity_estimate", 10)
        self._odom = self.create_publisher(Odometry, "odom", 10)
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Subscribe to the command first: if both are pending, the command answers the previous state.
        self.create_subscription(LowCmd, "low_cmd", self._on_command, qos_profile_sensor_data, raw=True)
        self.create_subscription(LowState, "low_state", self._on_state, qos_profile_sensor_data, raw=True)
        self.create_service(Trigger, "~/reset_odometry", self._on_reset_odometry)
        self.create_timer(1.0, self._report)
        if not self.get_parameter(
            "use_sim_time"
        ).value:  # simulated time waits for the node, so it needs no priority
            self._settings.apply(self.get_logger().warning)
        gc.freeze()  # exclude existing objects from garbage collection, which would delay an estimate

    def _on_command(self, data: bytes) -> None:
        try:
            command = decode_low_cmd(data)
            self._tracker.set_command(self._robot, command.q, command.mode)
        except MessageError as error:
            self._refusals.add("low_cmd", error)

    def _on_state(self, data: bytes) -> None:
        start = perf_counter()
        try:
            stamp, state = decode_low_state(data)
            state.time = self._robot_time.update(state.time, state.tick)
            estimate = self._tracker.process(state)
        except (MessageError, FloatingPointError) as error:
            self._refusals.add("low_state", error)
            return
        if estimate is None:
            return
        self._publish_velocity(stamp, state, estimate)
        self._count += 1
        self._busy_s += perf_counter() - start
        if self._count % ESTIMATES_PER_ODOMETRY == 0 and (
            self._odom.get_subscription_count() or self._tf.get_subscription_count()
        ):
            self._publish_odometry(Time(sec=stamp[0], nanosec=stamp[1]), state, estimate)

    def _on_reset_odometry(self, request: Any, response: Any) -> Any:
        self._tracker.reset_position()
        response.success, response.message = True, "odometry starts at zero"
        self.get_logger().info(response.message)
        return response

    def _publish_velocity(self, stamp: Stamp, state: RobotState, estimate: Estimate) -> None:
        covariance = _covariance(estimate.covariance, GYRO_VARIANCE)
        velocities = estimate.velocity, state.angular_velocity
        self._velocity.publish(encode_estimate(stamp, self._settings.body_frame, *velocities, covariance))

    def _publish_odometry(self, stamp: Any, state: RobotState, estimate: Estimate) -> None:
        """Publish x and y by dead reckoning and the orientation of the IMU; z is the height above the lowest foot."""
        floor = footprint(self._robot, state.q, state.quaternion)
        position = np.array([*estimate.position[:2], -rotate(state.quaternion, floor.position)[2]])
        variances = np.array([*estimate.position_deviation[:2] ** 2, HEIGHT_VARIANCE])
        message = Odometry(child_frame_id=self._settings.body_frame)
        message.header.stamp = stamp
        message.header.frame_id = self._settings.odom_frame
        fill_vector(message.pose.pose.position, position)
        fill_quaternion(message.pose.pose.orientation, state.quaternion)
        message.pose.covariance = _covariance(np.diag(variances), ORIENTATION_VARIANCE)
        fill_vector(message.twist.twist.linear, np.zeros(3) if estimate.stays else estimate.velocity)
        fill_vector(message.twist.twist.angular, state.angular_velocity)
        message.twist.covariance = _covariance(estimate.covariance, GYRO_VARIANCE)
        self._odom.publish(message)
        if self._settings.publish_tf:
            frames = self._settings
            base = FramePose(frames.odom_frame, frames.body_frame, position, state.quaternion)
            below = attrs.evolve(floor, parent=frames.body_frame)
            self._tf.publish(TFMessage(transforms=transform_messages(stamp, [base, below])))

    def _report(self) -> None:
        """Publish /diagnostics about the last second."""
        count, busy = self._count - self._reported.count, self._busy_s - self._reported.busy
        self._reported, refused = _ReportedCounts(self._count, self._busy_s), self._refusals.last_second()
        self._silence.report(self._count > 0, refused)
        if count == 0:
            level, summary = DiagnosticStatus.WARN, "no valid low_state in the last second"
        elif refused:
            level, summary = DiagnosticStatus.WARN, refused
            self.get_logger().warning(summary, throttle_duration_sec=LOG_THROTTLE_S)
        else:
            level, summary = DiagnosticStatus.OK, "estimating"
        values = {
            "robot": self._settings.robot,
            "kind": self._settings.kind,
            "rate_hz": count,
            "compute_mean_us": f"{1e6 * busy / count:.0f}" if count else "",
            "restarts": self._tracker.restarts,
            "stalled_s": f"{self._robot_time.stalled:.3f}",
            **self._refusals.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))


@attrs.frozen
class _ReportedCounts:
    """Counters at the last report: estimates, computing time (s)."""

    count: int = 0
    busy: float = 0.0


def _covariance(linear: Array, angular_variance: float) -> Array:
    """Return the 36 numbers of a 6 x 6 covariance, row by row: x, y, z and the rotations about them."""
    matrix = angular_variance * _ANGULAR
    matrix[:3, :3] = linear
    return matrix.ravel()


def main(args: list[str] | None = None) -> None:
    """Run the node `estimator`.

    Args:
        args: Command line arguments; None for those of the process.
    """
    run(EstimatorNode, args)

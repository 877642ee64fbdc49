"""ROS node `follow_planner`: scan, odom and people in, velocity cmd_vel_follow out.

Only messages, diagnostics and parameters are handled here. `follow_planner` plans; `person_tracker`
finds the people; the command mux passes `cmd_vel_follow` on to the controller.

Units: m, rad, s. Poses and positions of people are in the odometry frame; the velocity that is
published, and the measured one, are in the body frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from quadvel_msgs.msg import ControllerState, Persons
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.messages import MessageError, Refusals, seconds
from quadvel_nodes.node import read_parameters, run

from .follow_planner import PERIOD_S, FollowConfig, FollowPlanner, Plan, State
from .person_tracker import deviation
from .planar import planar_pose, planar_twist, scan_ranges
from .state_log import StateLog

OK_STATES = (State.FOLLOWING, State.WAITING)


class FollowPlannerNode(Node):
    """ROS node around a FollowPlanner."""

    def __init__(self) -> None:
        super().__init__("follow_planner")
        self._planner = FollowPlanner(read_parameters(self, FollowConfig))
        self._refusals = Refusals()
        self._frame, self._state_text = "", ""
        self._log = StateLog()
        self._plan: Plan | None = None
        self._velocity = self.create_publisher(Twist, "cmd_vel_follow", 10)
        self._state = self.create_publisher(String, "follow_planner/state", 10)
        self._way = self.create_publisher(Path, "follow_planner/path", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, qos_profile_sensor_data)
        self.create_subscription(Odometry, "odom", self._on_odom, qos_profile_sensor_data)
        self.create_subscription(Odometry, "person/odometry", self._on_person, 10)
        self.create_subscription(Persons, "persons", self._on_persons, 10)
        self.create_subscription(ControllerState, "controller/state", self._on_robot, 1)
        self.create_timer(PERIOD_S, self._step)
        self.create_timer(1.0, self._report)

    def _now(self) -> float:
        """Return the time of the node's clock, s."""
        return float(1e-9 * self.get_clock().now().nanoseconds)

    def _on_scan(self, message: Any) -> None:
        try:
            self._planner.on_scan(
                self._now(),
                seconds(message.header.stamp),
                scan_ranges(message),
                message.angle_min,
                message.angle_increment,
            )
        except ValueError as error:
            self._refusals.add("scan", MessageError(str(error)))

    def _on_odom(self, message: Any) -> None:
        try:
            pose, velocity = planar_pose(message.pose.pose), planar_twist(message.twist.twist)
            self._planner.on_odometry(self._now(), seconds(message.header.stamp), pose, velocity)
        except ValueError as error:
            self._refusals.add("odom", MessageError(str(error)))
            return
        self._frame = message.header.frame_id

    def _on_person(self, message: Any) -> None:
        """Receive the followed person; its velocity is in the person's own frame, x ahead."""
        try:
            x, y, yaw = planar_pose(message.pose.pose)
            ahead, left, _ = planar_twist(message.twist.twist)
            c, s = np.cos(yaw), np.sin(yaw)
            person = (x, y, c * ahead - s * left, s * ahead + c * left)
            spread = np.reshape(message.pose.covariance, (6, 6))[:2, :2]
            self._planner.on_person(self._now(), seconds(message.header.stamp), person, deviation(spread))
        except ValueError as error:  # numpy's LinAlgError, too
            self._refusals.add("person/odometry", MessageError(str(error)))

    def _on_persons(self, message: Any) -> None:
        """Receive all people, the followed one included; positions and velocities are planar."""
        try:
            persons = [(one.x, one.y, one.vx, one.vy) for one in message.persons]
            self._planner.on_others(self._now(), seconds(message.header.stamp), persons)
        except ValueError as error:
            self._refusals.add("persons", MessageError(str(error)))

    def _on_robot(self, message: Any) -> None:
        """Receive the reason why the controller would refuse to walk now; empty if it would walk."""
        self._planner.on_robot(self._now(), message.walk_refusal)

    def _step(self) -> None:
        """Plan, and publish velocity, state and path."""
        self._plan = plan = self._planner.step(self._now())
        twist = Twist()
        twist.linear.x, twist.linear.y, twist.angular.z = plan.velocity.tolist()
        self._velocity.publish(twist)
        text = f"{plan.state.value}: {plan.reason}"
        self._state_text = text
        if line := self._log.next_line(self._now(), text):
            self.get_logger().info(line)
        self._state.publish(String(data=text))
        self._way.publish(self._path(plan))

    def _path(self, plan: Plan) -> Any:
        """Convert the planned poses to a path message in the frame of odom."""
        message = Path()
        message.header.stamp, message.header.frame_id = self.get_clock().now().to_msg(), self._frame
        for x, y, yaw in plan.path.tolist():
            place = PoseStamped(header=message.header)
            place.pose.position.x, place.pose.position.y = x, y
            place.pose.orientation.z, place.pose.orientation.w = np.sin(yaw / 2), np.cos(yaw / 2)
            message.poses.append(place)
        return message

    def _report(self) -> None:
        """Publish the diagnostics of the last second."""
        refused = self._refusals.last_second()
        level = DiagnosticStatus.OK if self._plan and self._plan.state in OK_STATES else DiagnosticStatus.WARN
        summary = self._state_text or "starts"
        if refused:
            level, summary = DiagnosticStatus.WARN, refused
            self.get_logger().warning(summary, throttle_duration_sec=LOG_THROTTLE_S)
        values = {
            "state": self._plan.state.value if self._plan else "none",
            **self._refusals.diagnostic_values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))


def main(args: list[str] | None = None) -> None:
    """Run the node `follow_planner`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(FollowPlannerNode, args)

"""The node `trajectory_planner`: a way from a file to cmd_vel, in open loop or closed on odom. `trajectory` holds the ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from quadvel_nodes.messages import MessageError, Refusals
from quadvel_nodes.node import read_parameters, request_exit, run

from .planar import planar_pose
from .trajectory import SHIPPED, STEP, Trajectory, TrajectoryFollower, load

SILENT = 0.2  # s, without odometry, after which a robot that is led by it stops


@attrs.frozen
class TrajectoryParameters:
    """The node's parameters."""

    file: str = attrs.field(
        default="zju", metadata={"description": "CSV or GPX file, or a shipped one: zju, eight"}
    )
    closed_loop: bool = attrs.field(
        default=False, metadata={"description": "whether what the robot is off, by odom, is corrected"}
    )
    speed: float = attrs.field(
        default=0.5,
        validator=attrs.validators.gt(0.0),
        metadata={"description": "speed along a file of places, m/s"},
    )

    def load(self) -> Trajectory:
        """Raises ValueError for a file that is none."""
        shipped = SHIPPED / f"{self.file}.csv"
        return load(shipped if shipped.is_file() else Path(self.file), self.speed)


class TrajectoryPlanner(Node):
    """Starts at once, in closed loop with the first odometry; ends with 0 when the way is walked."""

    def __init__(self) -> None:
        super().__init__("trajectory_planner")
        settings = read_parameters(self, TrajectoryParameters)
        self._trajectory = settings.load()
        self.get_logger().info(f"{settings.file}: {self._trajectory.summary()}")
        self._follower = TrajectoryFollower(self._trajectory, settings.closed_loop)
        self._closed = settings.closed_loop
        self._pose: np.ndarray | None = None
        self._heard = -np.inf  # s, when odometry came last
        self._began: float | None = None
        self._refusals = Refusals()
        self._velocity = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odom", self._on_odom, qos_profile_sensor_data)
        self.create_timer(STEP, self._step)

    def _now(self) -> float:
        return float(1e-9 * self.get_clock().now().nanoseconds)

    def _on_odom(self, message: Any) -> None:
        pose = np.array(planar_pose(message.pose.pose))
        if np.isfinite(pose).all():
            self._pose, self._heard = pose, self._now()
        else:
            self._refusals.add("odom", MessageError(f"pose is {pose.tolist()}, expected finite numbers"))

    def _step(self) -> None:
        now = self._now()
        if self._closed and now - self._heard > SILENT:
            if self._began is not None:
                request_exit(self, f"trajectory_planner: odom is silent for more than {SILENT} s")
            return
        if self._began is None:
            self._began = now
            self.get_logger().info("sets off")
        try:
            velocity = self._follower.step(now - self._began, self._pose)
        except ValueError as error:
            request_exit(self, f"trajectory_planner: {error}")
            return
        twist = Twist()
        if velocity is None:
            request_exit(self)
        else:
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
        self._velocity.publish(twist)


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(TrajectoryPlanner, args)

"""ROS node `trajectory_planner`: publishes cmd_vel along a trajectory from a file.

In open loop, or in closed loop on odom. `trajectory` reads the file and sets the velocities in time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from quadvel_description.fields import field, positive
from quadvel_nodes.messages import MessageError, Refusals
from quadvel_nodes.node import read_parameters, request_exit, run

from .planar import planar_pose
from .trajectory import SHIPPED_FOLDER, STEP_S, Trajectory, TrajectoryFollower, load_trajectory

ODOM_TIMEOUT_S = 0.2
"""Silence of the odometry after which a closed-loop trajectory ends."""


@attrs.frozen
class TrajectoryParameters:
    """Parameters of the node `trajectory_planner`."""

    file: str = field("zju", "CSV or GPX file, or a shipped one: zju, eight")
    closed_loop: bool = field(False, "whether deviations of odom from the trajectory are corrected")
    speed: float = positive(
        0.5, "speed along the points of a CSV (x, y) or GPX file, m/s; times in a GPX file are ignored"
    )

    def load(self) -> Trajectory:
        """Load the trajectory.

        Returns:
            The trajectory. ValueError propagates for a wrong file.
        """
        shipped = SHIPPED_FOLDER / f"{self.file}.csv"
        return load_trajectory(shipped if shipped.is_file() else Path(self.file), self.speed)


class TrajectoryPlanner(Node):
    """ROS node that executes a trajectory; in closed loop it starts with the first odometry."""

    def __init__(self) -> None:
        super().__init__("trajectory_planner")
        settings = read_parameters(self, TrajectoryParameters)
        self._trajectory = settings.load()
        self.get_logger().info(f"{settings.file}: {self._trajectory.summary()}")
        self._follower = TrajectoryFollower(self._trajectory, settings.closed_loop)
        self._closed_loop = settings.closed_loop
        self._pose: np.ndarray | None = None
        self._odom_received_at = -np.inf  # s
        self._started_at: float | None = None
        self._refusals = Refusals()
        self._publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odom", self._on_odom, qos_profile_sensor_data)
        self.create_timer(STEP_S, self._step)

    def _now(self) -> float:
        return float(1e-9 * self.get_clock().now().nanoseconds)

    def _on_odom(self, message: Any) -> None:
        pose = np.array(planar_pose(message.pose.pose))
        if np.isfinite(pose).all():
            self._pose, self._odom_received_at = pose, self._now()
        else:
            self._refusals.add("odom", MessageError(f"pose is {pose.tolist()}, expected finite numbers"))

    def _step(self) -> None:
        now = self._now()
        if self._closed_loop and now - self._odom_received_at > ODOM_TIMEOUT_S:
            if self._started_at is not None:
                request_exit(self, f"trajectory_planner: odom is silent for more than {ODOM_TIMEOUT_S} s")
            return
        if self._started_at is None:
            self._started_at = now
            self.get_logger().info("starts")
        try:
            velocity = self._follower.step(now - self._started_at, self._pose)
        except ValueError as error:
            request_exit(self, f"trajectory_planner: {error}")
            return
        twist = Twist()
        if velocity is None:  # the trajectory has ended: zero
            self.get_logger().info("arrived")
            request_exit(self)
        else:
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
        self._publisher.publish(twist)


def main(args: list[str] | None = None) -> None:
    """Run the node `trajectory_planner`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(TrajectoryPlanner, args)

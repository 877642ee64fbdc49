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
from quadvel_msgs.msg import ControllerState
from quadvel_nodes.messages import MessageError, Refusals
from quadvel_nodes.node import read_parameters, request_exit, run

from .planar import planar_pose
from .trajectory import SHIPPED_FOLDER, STEP_S, Trajectory, TrajectoryFollower, load_trajectory

ODOM_TIMEOUT_S = 0.2
"""Silence of the odometry after which a closed-loop trajectory ends."""

SILENCE_S = 2.0
"""Time for other nodes to be found, before the node says what it waits for."""


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
    """ROS node that executes a trajectory.

    It starts once somebody listens to its velocities, the robot would follow them, and, in closed loop,
    odometry arrives. Until then it commands zero and says what it waits for. It ends with exit code 1
    where the robot does not follow its velocities any more.
    """

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
        self._refusal = self._said = ""  # why the robot would not walk; what was said last
        self._findings: set[str] = set()  # findings of the controller that were logged
        self._since: float | None = None  # s, when the node began to wait
        self._refusals = Refusals()
        self._publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odom", self._on_odom, qos_profile_sensor_data)
        self.create_subscription(ControllerState, "controller/state", self._on_robot, 1)
        self.create_timer(STEP_S, self._step)

    def _now(self) -> float:
        return float(1e-9 * self.get_clock().now().nanoseconds)

    def _on_odom(self, message: Any) -> None:
        pose = np.array(planar_pose(message.pose.pose))
        if np.isfinite(pose).all():
            self._pose, self._odom_received_at = pose, self._now()
        else:
            self._refusals.add("odom", MessageError(f"pose is {pose.tolist()}, expected finite numbers"))

    def _on_robot(self, message: Any) -> None:
        self._refusal = message.walk_refusal
        if self._started_at is not None:
            for finding in set(message.findings) - self._findings:
                self.get_logger().warning(f"controller: {finding}")
            self._findings.update(message.findings)

    def _missing(self, now: float) -> str:
        """What the start waits for; "" if nothing is missing."""
        if not self._publisher.get_subscription_count():
            return "a subscriber of cmd_vel; start the robot: quadvel up"
        if self._refusal:
            return f"the robot, which does not walk: {self._refusal}"
        return "odometry on odom" if self._is_blind(now) else ""

    def _is_blind(self, now: float) -> bool:
        return self._closed_loop and now - self._odom_received_at > ODOM_TIMEOUT_S

    def _step(self) -> None:
        now = self._now()
        if self._started_at is None:
            missing = self._missing(now)
            if missing:
                self._say(f"waits for {missing}", now)
                self._publisher.publish(Twist())  # a robot follows velocities after a zero one
                return
            self._started_at = now
            self.get_logger().info("starts")
        if self._refusal:
            self._give_up(f"the robot does not walk any more: {self._refusal}")
            return
        if self._is_blind(now):
            self._give_up(f"odom is silent for more than {ODOM_TIMEOUT_S} s")
            return
        try:
            velocity = self._follower.step(now - self._started_at, self._pose)
        except ValueError as error:
            self._give_up(str(error))
            return
        twist = Twist()
        if velocity is None:  # the trajectory has ended: zero
            self.get_logger().info("arrived")
            request_exit(self)
        else:
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
        self._publisher.publish(twist)

    def _give_up(self, reason: str) -> None:
        """Command zero and end with exit code 1."""
        self._publisher.publish(Twist())
        request_exit(self, f"trajectory_planner: {reason}")

    def _say(self, sentence: str, now: float) -> None:
        """Log what the node waits for, once, if it still does after SILENCE_S."""
        if self._since is None:
            self._since = now
        if now - self._since > SILENCE_S and sentence != self._said:
            self._said = sentence
            self.get_logger().info(sentence)


def main(args: list[str] | None = None) -> None:
    """Run the node `trajectory_planner`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(TrajectoryPlanner, args)

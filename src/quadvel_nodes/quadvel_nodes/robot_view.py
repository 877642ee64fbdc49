"""The robot on standard ROS topics, for RViz, Foxglove and Nav2. Needs rclpy.

A node that publishes `low_state` (simulator or driver) also publishes joint angles and IMU data as
sensor_msgs, the transforms of the links, and the robot description.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from quadvel_description.arrays import Array
from quadvel_description.frames import IMU, FramePose, fixed_links, moving_links
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class RobotView:
    """Publishes imu, joint_states, /tf, and once /tf_static and robot_description, on behalf of a node."""

    def __init__(
        self,
        node: Node,
        robot: Robot,
        orientation: float,
        angular_velocity: float,
        linear_acceleration: float,
    ) -> None:
        """Create the publishers and publish the latched topics.

        Args:
            node: The node that owns the publishers.
            robot: The robot.
            orientation: Standard deviation of the IMU's orientation about each axis, rad.
            angular_velocity: Standard deviation of the angular velocity, rad/s.
            linear_acceleration: Standard deviation of the acceleration, m/s^2.
        """
        self._robot = robot
        self._joint_states = node.create_publisher(JointState, "joint_states", 10)
        self._tf = node.create_publisher(TFMessage, "/tf", 100)
        self._imu = node.create_publisher(Imu, "imu", 10)
        self._noise = Imu()
        self._noise.orientation_covariance = _covariance(orientation)
        self._noise.angular_velocity_covariance = _covariance(angular_velocity)
        self._noise.linear_acceleration_covariance = _covariance(linear_acceleration)
        self._latched = [
            node.create_publisher(TFMessage, "/tf_static", LATCHED),
            node.create_publisher(String, "robot_description", LATCHED),
        ]
        stamp = node.get_clock().now().to_msg()
        self._latched[0].publish(TFMessage(transforms=transform_messages(stamp, fixed_links(robot))))
        self._latched[1].publish(String(data=robot.urdf_file.read_text(encoding="utf-8")))

    def publish(self, stamp: Any, state: RobotState) -> None:
        """Publish one state on the topics to which somebody subscribes.

        Args:
            stamp: Time of the state, a builtin_interfaces/Time.
            state: The state.
        """
        if self._joint_states.get_subscription_count():
            joints = JointState(name=list(JOINT_NAMES))
            joints.header.stamp = stamp
            joints.position, joints.velocity = state.q.tolist(), state.dq.tolist()
            joints.effort = state.tau.tolist()
            self._joint_states.publish(joints)
        if self._tf.get_subscription_count():
            self._tf.publish(
                TFMessage(transforms=transform_messages(stamp, moving_links(self._robot, state.q)))
            )
        if self._imu.get_subscription_count():
            imu = self._noise
            imu.header.stamp = stamp
            imu.header.frame_id = IMU
            fill_quaternion(imu.orientation, state.quaternion)
            fill_vector(imu.angular_velocity, state.angular_velocity)
            fill_vector(imu.linear_acceleration, state.linear_acceleration)
            self._imu.publish(imu)


def transform_messages(stamp: Any, placed: Sequence[FramePose]) -> list[Any]:
    """Convert frames to transform messages.

    Args:
        stamp: Stamp of the messages, a builtin_interfaces/Time.
        placed: Frames, each with its parent, position (m) and quaternion.

    Returns:
        One geometry_msgs/TransformStamped per frame.
    """
    messages = []
    for frame in placed:
        message = TransformStamped(child_frame_id=frame.child)
        message.header.stamp = stamp
        message.header.frame_id = frame.parent
        fill_vector(message.transform.translation, frame.position)
        fill_quaternion(message.transform.rotation, frame.quaternion)
        messages.append(message)
    return messages


def fill_vector(message: Any, vector: Array) -> None:
    """Fill a geometry_msgs Vector3 or Point.

    Args:
        message: The message, changed in place.
        vector: x, y, z, shape (3,).
    """
    message.x, message.y, message.z = vector.tolist()


def fill_quaternion(message: Any, wxyz: Array) -> None:
    """Fill a geometry_msgs/Quaternion.

    Args:
        message: The message, changed in place.
        wxyz: Quaternion (w, x, y, z), shape (4,).
    """
    message.w, message.x, message.y, message.z = wxyz.tolist()


def _covariance(deviation: float) -> Array:
    return np.diag(np.full(3, deviation**2)).ravel()

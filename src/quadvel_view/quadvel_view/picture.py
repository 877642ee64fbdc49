"""State of a robot as known from its topics, live or recorded. No ROS, no drawing.

`scene` draws it, `panel` turns it into readings, and `view_node` or `playback` fills it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import foot_positions, rotate
from quadvel_description.quadruped import joint_index
from quadvel_description.robot import Robot

TOPICS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/odom": "nav_msgs/msg/Odometry",
    "/command": "quadvel_msgs/msg/VelocityCommand",
    "/controller/state": "quadvel_msgs/msg/ControllerState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/person_tracker/markers": "visualization_msgs/msg/MarkerArray",
    "/follow_planner/path": "nav_msgs/msg/Path",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/ground": "visualization_msgs/msg/Marker",
}
"""Topics that update a picture, live or recorded."""
LOW_STATE = "/low_state"
"""Fallback topic of recordings without joint_states; live it would arrive at 200 Hz."""
LATCHED = ("/tf_static", "/ground")
"""Topics with transient-local durability."""
FRESH_S = 1.0
"""Age from which the last message of a topic is stale."""
MAX_DIAGNOSTICS_AGE_S = 3.0
"""Age from which a node on /diagnostics is stale; nodes report once a second."""
TRAIL_SPACING_M = 0.05
"""Distance between two points of the trail."""
TRAIL_LENGTH = 600
"""Number of points of the trail."""
JUMP_M = 1.0
"""Distance between two poses that no walk explains."""
RESTART_VARIANCE_RATIO = 0.5
"""Ratio of new to old position variance below which odometry was restarted.

The variance of dead reckoning only grows.
"""
CYLINDER, TRIANGLES = 3, 11
"""Types of visualization_msgs/Marker."""
LEVELS = ("ok", "warning", "error", "stale")
"""Levels of diagnostic_msgs/DiagnosticStatus, by number."""


@attrs.frozen
class Person:
    """A tracked person.

    Attributes:
        position: (2,) m, frame odom.
        id: The track.
        colour: Red, green, blue, 0 to 255, as the tracker assigned it.
    """

    position: Array
    id: int
    colour: tuple[int, int, int]


@attrs.frozen
class NodeHealth:
    """The last diagnostics of a node.

    Attributes:
        level: One of LEVELS.
        text: The message.
        received_at: s, on the clock of the picture.
    """

    level: str
    text: str
    received_at: float


@attrs.frozen
class Ground:
    """A triangulated surface.

    Attributes:
        vertices: (N, 3) m, frame odom; three consecutive vertices form a triangle.
    """

    vertices: Array

    def height(self, x: float, y: float) -> float:
        """Interpolate the height at a point; points outside get the height at the edge.

        In the triangle a, b, c with barycentric weights u, v, 1 - u - v >= 0 the height is a + u (b
        - a) + v (c - a).

        Args:
            x: m, frame odom.
            y: m, frame odom.

        Returns:
            Height, m; 0 if all triangles are vertical.
        """
        low, high = self.vertices[:, :2].min(axis=0), self.vertices[:, :2].max(axis=0)
        a, b, c = self.vertices.reshape(-1, 3, 3).transpose(1, 0, 2)
        # Cramer's rule in the plane: u = (ap x ac) / (ab x ac), v = (ab x ap) / (ab x ac).
        ab, ac, ap = b - a, c - a, np.clip((x, y), low, high) - a[:, :2]
        area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
        area[area == 0.0] = np.nan  # a vertical triangle
        u = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
        v = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
        outside = np.nan_to_num(np.max([-u, -v, u + v - 1.0], axis=0), nan=np.inf)
        i = outside.argmin()
        return float(a[i, 2] + u[i] * ab[i, 2] + v[i] * ac[i, 2]) if np.isfinite(outside[i]) else 0.0


@attrs.define
class RobotPicture:
    """The newest value of everything that is shown.

    Joint order FR, FL, RR, RL, each hip, thigh, calf.

    Attributes:
        q: (12,) rad.
        torque: (12,) N m; NaN if unknown.
        position: (3,) m, base in the frame odom.
        quaternion: (4,) w, x, y, z, base in the frame odom.
        measured: (3,) vx, vy (m/s), wz (rad/s), body frame.
        commanded: (3,) vx, vy (m/s), wz (rad/s) of the command in effect, body frame.
        source: Selected input of the command mux.
        state: The newest controller/state, or None.
        nodes: Diagnostics by node.
        scan: (N, 3) m, laser points in the frame odom.
        persons: The tracked people.
        path: (N, 3) m, planned path in the frame odom.
        ground: The ground, or None if flat.
        trail: Past positions (3,) m, frame odom.
        rejected: Error of the newest message of a topic, if it was invalid.
    """

    robot: Robot
    q: Array = attrs.Factory(lambda self: np.array(self.robot.nominal_q), takes_self=True)
    torque: Array = attrs.field(factory=lambda: np.zeros(12))
    position: Array = attrs.Factory(
        lambda self: np.array([0.0, 0.0, self.robot.nominal_height]), takes_self=True
    )
    quaternion: Array = attrs.field(factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    measured: Array = attrs.field(factory=lambda: np.zeros(3))
    commanded: Array = attrs.field(factory=lambda: np.zeros(3))
    source: str = "none"
    state: Any = None
    nodes: dict[str, NodeHealth] = attrs.field(factory=dict)
    scan: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    persons: Sequence[Person] = ()
    path: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    ground: Ground | None = None
    trail: deque[Array] = attrs.field(factory=lambda: deque(maxlen=TRAIL_LENGTH))
    rejected: dict[str, str] = attrs.field(factory=dict)

    _position_variance: float = 0.0
    _heard: dict[str, float] = attrs.field(factory=dict)
    _fixed: dict[str, tuple[str, Array, Array]] = attrs.field(factory=dict)

    def update_lazily(self, topic: str, read: Callable[[], Any], now: float) -> None:
        """Deserialise a message and update the picture.

        Errors go to `rejected`, so that no message ends the page and its STOP.

        Args:
            topic: The topic.
            read: Returns the message.
            now: s, on the clock of `update`.
        """
        try:
            self.update(topic, read(), now)
        except Exception as error:  # decoders raise many kinds of errors for invalid bytes
            self.rejected[topic] = f"{error}" or type(error).__name__
        else:
            self.rejected.pop(topic, None)

    def update(self, topic: str, message: Any, now: float) -> None:
        """Update the picture by a message of TOPICS or LOW_STATE; other topics are ignored.

        Args:
            topic: The topic.
            message: The message. Wrong joints or non-finite positions raise ValueError.
            now: s, on any monotonic clock.
        """
        take = _HANDLERS.get(topic)
        if take is not None:
            take(self, message, now)
            self._heard[topic] = now

    def is_fresh(self, topic: str, now: float) -> bool:
        """Return whether a topic had a message within the last second.

        Args:
            topic: The topic.
            now: s.

        Returns:
            True if the last message is younger than FRESH_S.
        """
        return now - self._heard.get(topic, -np.inf) < FRESH_S

    def has_fresh_joints(self, now: float) -> bool:
        """Return whether joint angles and torques are at most a second old.

        Args:
            now: s.

        Returns:
            True if a topic with joint states is fresh.
        """
        return self.is_fresh("/joint_states", now) or self.is_fresh(LOW_STATE, now)

    def ground_below_feet(self) -> tuple[float, float]:
        """Return the ground below the lowest foot and the clearance of that foot.

        The clearance is mostly the drift of odometry relative to the ground.

        Returns:
            Height of the ground in the frame odom, m, and height of the foot above it, m.
        """
        feet = rotate(self.quaternion, foot_positions(self.robot, self.q)) + self.position
        x, y, z = feet[feet[:, 2].argmin()]
        floor = 0.0 if self.ground is None else self.ground.height(x, y)
        return floor, float(z) - self.robot.foot_radius - floor

    def silence(self, topic: str, now: float) -> float:
        """Return the time since the last message of a topic.

        Args:
            topic: The topic.
            now: s.

        Returns:
            s; 0 if there was no message yet.
        """
        return now - self._heard.get(topic, now)

    def clear_history(self) -> None:
        """Forget messages, trail and diagnostics, after a jump in time."""
        self._heard.clear()
        self.trail.clear()
        self.nodes.clear()
        self.rejected.clear()
        self._position_variance = 0.0
        self.scan, self.path, self.persons, self.state = np.zeros((0, 3)), np.zeros((0, 3)), (), None

    # Handlers of the topics.

    def _joint_states(self, message: Any, now: float) -> None:
        """Update angles and torques."""
        order = joint_index(message.name)
        self.q[order] = _finite("position", message.position)
        self.torque[order] = message.effort if len(message.effort) == len(order) else np.nan

    def _low_state(self, message: Any, now: float) -> None:
        """Update joints and orientation, unless better topics are fresh."""
        if not self.is_fresh("/joint_states", now):
            self.q, self.torque = _finite("q", message.q), np.array(message.tau, float)
        if not self.is_fresh("/odom", now):
            self.quaternion = _finite("orientation_wxyz", message.orientation_wxyz)

    def _odom(self, message: Any, now: float) -> None:
        """Update pose, velocity and trail; a restart of odometry clears the trail."""
        self.position = _vector(message.pose.pose.position)
        self.quaternion = _quaternion(message.pose.pose.orientation)
        self.measured = _planar(message.twist.twist)
        here = self.position * [1.0, 1.0, 0.0]
        variance = float(message.pose.covariance[0])
        if variance < RESTART_VARIANCE_RATIO * self._position_variance or (
            self.trail and np.linalg.norm(here - self.trail[-1]) > JUMP_M
        ):
            self.trail.clear()
        self._position_variance = variance
        if not self.trail or np.linalg.norm(here - self.trail[-1]) > TRAIL_SPACING_M:
            self.trail.append(here)

    def _command(self, message: Any, now: float) -> None:
        """Update the source of the command."""
        self.source = message.source

    def _controller_state(self, message: Any, now: float) -> None:
        """Update the state of the controller and the command in effect."""
        self.state = message
        self.commanded = _planar(message.command)

    def _diagnostics(self, message: Any, now: float) -> None:
        """Update the diagnostics of the nodes, and mark stale ones."""
        for one in message.status:
            level = one.level if isinstance(one.level, int) else ord(one.level)
            self.nodes[one.name] = NodeHealth(LEVELS[min(level, 3)], one.message, now)
        gone = [name for name, node in self.nodes.items() if now - node.received_at > MAX_DIAGNOSTICS_AGE_S]
        for name in gone:
            self.nodes[name] = attrs.evolve(
                self.nodes[name], level="stale", text=f"no diagnostics for {MAX_DIAGNOSTICS_AGE_S:g} s"
            )

    def _tf_static(self, message: Any, now: float) -> None:
        """Store fixed transforms, by child frame."""
        for one in message.transforms:
            placed = _vector(one.transform.translation), _quaternion(one.transform.rotation)
            self._fixed[one.child_frame_id] = (one.header.frame_id, *placed)

    def _scan(self, message: Any, now: float) -> None:
        """Transform the valid ranges of a scan to points in the frame odom."""
        ranges = np.array(message.ranges, float)
        _finite("angles", [message.angle_min, message.angle_increment])
        seen = (ranges >= message.range_min) & (ranges < message.range_max)
        angles = (message.angle_min + message.angle_increment * np.arange(len(ranges)))[seen]
        flat = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
        points, frame = flat * ranges[seen, None], message.header.frame_id
        for _ in self._fixed:  # no branch of a tree is longer; this bounds the loop if frames form a cycle
            if frame in self._fixed:
                frame, origin, turn = self._fixed[frame]
                points = rotate(turn, points) + origin
        self.scan = rotate(self.quaternion, points) + self.position

    def _markers(self, message: Any, now: float) -> None:
        """Update the tracked people."""
        self.persons = [
            Person(
                _vector(one.pose.position)[:2],
                one.id,
                (round(255 * one.color.r), round(255 * one.color.g), round(255 * one.color.b)),
            )
            for one in message.markers
            if one.type == CYLINDER and one.action == 0
        ]

    def _path(self, message: Any, now: float) -> None:
        """Update the planned path."""
        self.path = np.array([_vector(one.pose.position) for one in message.poses]).reshape(-1, 3)

    def _ground(self, message: Any, now: float) -> None:
        """Update the ground."""
        self.ground = None
        if message.type == TRIANGLES and message.points:
            points = _finite("points", [(p.x, p.y, p.z) for p in message.points])
            if len(points) % 3:
                raise ValueError(f"points are {len(points)}, expected three for each triangle")
            self.ground = Ground(points)


_HANDLERS: dict[str, Callable[[RobotPicture, Any, float], None]] = {
    "/joint_states": RobotPicture._joint_states,
    "/odom": RobotPicture._odom,
    "/command": RobotPicture._command,
    "/controller/state": RobotPicture._controller_state,
    "/diagnostics": RobotPicture._diagnostics,
    "/scan": RobotPicture._scan,
    "/person_tracker/markers": RobotPicture._markers,
    "/follow_planner/path": RobotPicture._path,
    "/tf_static": RobotPicture._tf_static,
    "/ground": RobotPicture._ground,
    LOW_STATE: RobotPicture._low_state,
}


def _finite(field: str, values: Any) -> Array:
    """Convert values to an array, or raise ValueError if one is not finite."""
    found = np.array(values, float)
    if not np.isfinite(found).all():
        raise ValueError(f"{field} is {found[~np.isfinite(found)][0]}, expected finite numbers")
    return found


def _vector(message: Any) -> Array:
    """Convert a Vector3 or Point to (3,)."""
    return _finite("place", [message.x, message.y, message.z])


def _quaternion(message: Any) -> Array:
    """Convert a Quaternion to (4,) w, x, y, z."""
    return _finite("orientation", [message.w, message.x, message.y, message.z])


def _planar(twist: Any) -> Array:
    """Convert a Twist to (3,) vx, vy (m/s), wz (rad/s)."""
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z], float)

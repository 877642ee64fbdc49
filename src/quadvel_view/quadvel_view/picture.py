"""What is known of a robot from its topics, live or recorded: `RobotPicture`. No ROS, and nothing of how it is drawn."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description import robot
from quadvel_description.kinematics import foot_positions, rotate

Array = NDArray[np.float64]

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
"""What a picture is made of, live"""
LOW_STATE = "/low_state"
"""What it is made of where a recording has nothing better; live it would come 200 times a second"""
LATCHED = ("/tf_static", "/ground")
"""Published once and kept for those who come later"""
FRESH = 1.0  # s, after which what came counts as silent
LONGEST_SILENCE = 3.0  # s, of a node on /diagnostics, which speaks once a second
TRAIL_STEP = 0.05  # m between two points of the way behind
TRAIL = 600  # points of it
JUMP = 1.0  # m between two poses: nobody walked this way
STARTED_AGAIN = 0.5  # share of the variance of a position before: one that grows by dead reckoning falls where that starts again
CYLINDER, TRIANGLES = 3, 11  # of visualization_msgs/Marker
LEVELS = ("ok", "warning", "error", "stale")  # of diagnostic_msgs/DiagnosticStatus


@attrs.frozen
class Person:
    """Where a tracked person stands, (2,) m in odom, the id of its track, and the colour that the tracker gave it."""

    position: Array
    id: int
    colour: tuple[int, int, int]


@attrs.frozen
class NodeHealth:
    """What a node said last on /diagnostics, and when, s."""

    level: str
    text: str
    heard: float


@attrs.frozen
class Ground:
    """A surface in the frame odom: vertices (N, 3) m; each three of them are a triangle."""

    vertices: Array

    def height(self, x: float, y: float) -> float:
        """Height at a place, m; beyond the edge that of the edge.

        It is a + u (b - a) + v (c - a) in the triangle a, b, c for which the weights u, v and 1 - u - v are not negative.
        """
        low, high = self.vertices[:, :2].min(axis=0), self.vertices[:, :2].max(axis=0)
        a, b, c = self.vertices.reshape(-1, 3, 3).transpose(1, 0, 2)
        ab, ac, ap = b - a, c - a, np.clip((x, y), low, high) - a[:, :2]
        area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
        area[area == 0.0] = np.nan  # a triangle that stands upright
        u = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
        v = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
        outside = np.nan_to_num(np.max([-u, -v, u + v - 1.0], axis=0), nan=np.inf)
        i = outside.argmin()
        return float(a[i, 2] + u[i] * ab[i, 2] + v[i] * ac[i, 2]) if np.isfinite(outside[i]) else 0.0


@attrs.define
class RobotPicture:
    """The newest of everything. Joint order as everywhere; positions in the frame odom; velocities in the body frame."""

    q: Array = attrs.field(factory=lambda: np.array(robot.NOMINAL_Q))
    torque: Array = attrs.field(factory=lambda: np.zeros(12))
    position: Array = attrs.field(factory=lambda: np.array([0.0, 0.0, robot.NOMINAL_HEIGHT]))
    quaternion: Array = attrs.field(factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    measured: Array = attrs.field(factory=lambda: np.zeros(3))
    """vx, vy (m/s), wz (rad/s)"""
    commanded: Array = attrs.field(factory=lambda: np.zeros(3))
    """the command in effect"""
    source: str = "none"
    """which input of the command mux counts"""
    state: Any = None
    """the newest controller/state"""
    nodes: dict[str, NodeHealth] = attrs.field(factory=dict)
    scan: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    persons: Sequence[Person] = ()
    path: Array = attrs.field(factory=lambda: np.zeros((0, 3)))
    ground: Ground | None = None
    trail: deque[Array] = attrs.field(factory=lambda: deque(maxlen=TRAIL))
    refused: dict[str, str] = attrs.field(factory=dict)
    """by topic: what was wrong with its newest message, where that could not be taken"""
    _position_variance: float = 0.0
    _heard: dict[str, float] = attrs.field(factory=dict)
    _fixed: dict[str, tuple[str, Array, Array]] = attrs.field(factory=dict)

    def read(self, topic: str, read: Callable[[], Any], now: float) -> None:
        """Take what `read` returns, or note in `refused` what is wrong with it: no message ends the page, and STOP with it."""
        try:
            self.take(topic, read(), now)
        except Exception as error:  # bytes that are no message fail in as many ways as there are decoders
            self.refused[topic] = f"{error}" or type(error).__name__
        else:
            self.refused.pop(topic, None)

    def take(self, topic: str, message: Any, now: float) -> None:
        """Note a message of one of TOPICS, or of LOW_STATE; others are left alone. now: s, on any clock that goes on.

        Raises ValueError for a message whose joints are not the robot's, or whose places are not finite.
        """
        take = _TAKES.get(topic)
        if take is not None:
            take(self, message, now)
            self._heard[topic] = now

    def is_fresh(self, topic: str, now: float) -> bool:
        """Whether something came on a topic within the last second."""
        return now - self._heard.get(topic, -np.inf) < FRESH

    def shows_joints(self, now: float) -> bool:
        """Whether the joints' angles and torques are those of the last second."""
        return self.is_fresh("/joint_states", now) or self.is_fresh(LOW_STATE, now)

    def floor(self) -> tuple[float, float]:
        """The ground below the lowest foot, m in odom, and how far that foot is above it, m.

        The latter is what odometry and ground are off each other, mostly.
        """
        feet = rotate(self.quaternion, foot_positions(self.q)) + self.position
        x, y, z = feet[feet[:, 2].argmin()]
        floor = 0.0 if self.ground is None else self.ground.height(x, y)
        return floor, float(z) - robot.FOOT_RADIUS - floor

    def silence(self, topic: str, now: float) -> float:
        """For how long nothing came on a topic, s; 0 where nothing ever came."""
        return now - self._heard.get(topic, now)

    def forget_the_past(self) -> None:
        """As after a jump in time: nothing was heard, and there is no way behind."""
        self._heard.clear()
        self.trail.clear()
        self.nodes.clear()
        self.refused.clear()
        self._position_variance = 0.0
        self.scan, self.path, self.persons, self.state = np.zeros((0, 3)), np.zeros((0, 3)), (), None

    # How each message is taken.

    def _joint_states(self, message: Any, now: float) -> None:
        order = robot.joint_index(message.name)
        self.q[order] = _finite("position", message.position)
        self.torque[order] = message.effort if len(message.effort) == len(order) else np.nan

    def _low_state(self, message: Any, now: float) -> None:
        if not self.is_fresh("/joint_states", now):
            self.q, self.torque = _finite("q", message.q), np.array(message.tau, float)
        if not self.is_fresh("/odom", now):
            self.quaternion = _finite("orientation_wxyz", message.orientation_wxyz)

    def _odom(self, message: Any, now: float) -> None:
        self.position = _vector(message.pose.pose.position)
        self.quaternion = _quaternion(message.pose.pose.orientation)
        self.measured = _planar(message.twist.twist)
        here = self.position * [1.0, 1.0, 0.0]
        variance = float(message.pose.covariance[0])
        if variance < STARTED_AGAIN * self._position_variance or (
            self.trail and np.linalg.norm(here - self.trail[-1]) > JUMP
        ):
            self.trail.clear()
        self._position_variance = variance
        if not self.trail or np.linalg.norm(here - self.trail[-1]) > TRAIL_STEP:
            self.trail.append(here)

    def _command(self, message: Any, now: float) -> None:
        self.source = message.source

    def _controller_state(self, message: Any, now: float) -> None:
        self.state = message
        self.commanded = _planar(message.command)

    def _diagnostics(self, message: Any, now: float) -> None:
        for one in message.status:
            level = one.level if isinstance(one.level, int) else ord(one.level)
            self.nodes[one.name] = NodeHealth(LEVELS[min(level, 3)], one.message, now)
        gone = [name for name, node in self.nodes.items() if now - node.heard > LONGEST_SILENCE]
        for name in gone:
            self.nodes[name] = attrs.evolve(
                self.nodes[name], level="stale", text=f"no diagnostics for {LONGEST_SILENCE:g} s"
            )

    def _tf_static(self, message: Any, now: float) -> None:
        for one in message.transforms:
            placed = _vector(one.transform.translation), _quaternion(one.transform.rotation)
            self._fixed[one.child_frame_id] = (one.header.frame_id, *placed)

    def _scan(self, message: Any, now: float) -> None:
        ranges = np.array(message.ranges, float)
        _finite("angles", [message.angle_min, message.angle_increment])
        seen = (ranges >= message.range_min) & (ranges < message.range_max)
        angles = (message.angle_min + message.angle_increment * np.arange(len(ranges)))[seen]
        flat = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
        points, frame = flat * ranges[seen, None], message.header.frame_id
        for _ in self._fixed:  # a tree has no longer branch; what is none does not keep us here
            if frame in self._fixed:
                frame, origin, turn = self._fixed[frame]
                points = rotate(turn, points) + origin
        self.scan = rotate(self.quaternion, points) + self.position

    def _markers(self, message: Any, now: float) -> None:
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
        self.path = np.array([_vector(one.pose.position) for one in message.poses]).reshape(-1, 3)

    def _ground(self, message: Any, now: float) -> None:
        self.ground = None
        if message.type == TRIANGLES and message.points:
            points = _finite("points", [(p.x, p.y, p.z) for p in message.points])
            if len(points) % 3:
                raise ValueError(f"points are {len(points)}, expected three for each triangle")
            self.ground = Ground(points)


_TAKES: dict[str, Callable[[RobotPicture, Any, float], None]] = {
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
    """The values (...) as an array. Raises ValueError where one of them is not finite."""
    found = np.array(values, float)
    if not np.isfinite(found).all():
        raise ValueError(f"{field} is {found[~np.isfinite(found)][0]}, expected finite numbers")
    return found


def _vector(message: Any) -> Array:
    return _finite("place", [message.x, message.y, message.z])


def _quaternion(message: Any) -> Array:
    return _finite("orientation", [message.w, message.x, message.y, message.z])


def _planar(twist: Any) -> Array:
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z], float)

"""The node `person_tracker`: scan and odom to person, person/odometry, persons and markers, and the service select_person.

How persons are tracked is `person_tracker`'s matter, which of them is meant `selection`'s.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from visualization_msgs.msg import Marker, MarkerArray

from quadvel_msgs.msg import Person, Persons
from quadvel_msgs.srv import SelectPerson
from quadvel_nodes.diagnostics import QUIET, diagnostics
from quadvel_nodes.messages import MessageError, Refusals, seconds
from quadvel_nodes.node import read_parameters, run

from .leg_detector import SHIPPED_MODEL, LegDetector
from .person_tracker import PersonTracker, Track
from .planar import planar_pose, scan_ranges
from .pose_history import PoseHistory
from .selection import Selection

SET_BACK = 1.0  # s, by which a scan is older than the one before, from which time was set back
UNKNOWN = 1e6  # variance of what is not estimated
HEIGHT = 1.7  # m, of a marker
COLOURS = {"meant": (0.1, 0.8, 0.2, 0.9), "person": (0.2, 0.4, 1.0, 0.8), "perhaps": (0.6, 0.6, 0.6, 0.4)}


def _parameter(default: Any, description: str) -> Any:
    return attrs.field(default=default, metadata={"description": description})


@attrs.frozen
class PersonTrackerParameters:
    """The node's parameters."""

    model: str = _parameter("", "file of the network that knows legs, ONNX; empty: the shipped one")
    use_odom: bool = _parameter(
        True, "whether the robot's pose comes on odom; else tracks are in the frame of the scans"
    )
    laser_x: float = _parameter(0.25, "where the laser is on the robot: forward, m; as in the shipped worlds")
    laser_y: float = _parameter(0.0, "where the laser is on the robot: to the left, m")
    laser_yaw: float = _parameter(0.0, "where the laser looks on the robot: to the left, rad")
    select_nearest: bool = _parameter(
        True, "whether the nearest person ahead is meant until select_person says who"
    )

    def __attrs_post_init__(self) -> None:
        for name in ("laser_x", "laser_y", "laser_yaw"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}, expected a finite number")

    def make_detector(self) -> LegDetector:
        """Raises ValueError for a file that is no such network."""
        return LegDetector(Path(self.model) if self.model else SHIPPED_MODEL)


class PersonTrackerNode(Node):
    """A scan waits until the odometry has passed its time, for at most some scans."""

    def __init__(self) -> None:
        super().__init__("person_tracker")
        self._settings = read_parameters(self, PersonTrackerParameters)
        self._detector = self._settings.make_detector()
        self._tracker = PersonTracker(detector=self._detector)
        self._selection = Selection(self._settings.select_nearest)
        self._poses = PoseHistory((self._settings.laser_x, self._settings.laser_y, self._settings.laser_yaw))
        self._frame = ""
        self._waiting: deque[Any] = deque(maxlen=5)
        self._time = -np.inf  # s, of the newest scan that was used
        self._tracks: list[Track] = []
        self._pose = np.zeros(3)
        self._refusals = Refusals()
        self._used, self._reported, self._refused = 0, 0, 0
        self._person = self.create_publisher(PoseStamped, "person", 10)
        self._odometry = self.create_publisher(Odometry, "person/odometry", 10)
        self._persons = self.create_publisher(Persons, "persons", 10)
        self._markers = self.create_publisher(MarkerArray, "person_tracker/markers", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(SelectPerson, "select_person", self._on_select)
        self.create_subscription(LaserScan, "scan", self._on_scan, qos_profile_sensor_data)
        if self._settings.use_odom:
            self.create_subscription(Odometry, "odom", self._on_odom, qos_profile_sensor_data)
        self.create_timer(1.0, self._report)

    def _on_odom(self, message: Any) -> None:
        try:
            self._poses.add(seconds(message.header.stamp), planar_pose(message.pose.pose))
        except ValueError as error:
            self._refusals.add("odom", MessageError(str(error)))
            return
        self._frame = message.header.frame_id
        while self._waiting and seconds(self._waiting[0].header.stamp) <= self._poses.newest:
            self._use(self._waiting.popleft())

    def _on_scan(self, message: Any) -> None:
        if self._settings.use_odom:
            self._waiting.append(message)
        else:
            self._frame = message.header.frame_id
            self._use(message)

    def _use(self, message: Any) -> None:
        time = seconds(message.header.stamp)
        if time < self._time - SET_BACK:
            self._tracker = PersonTracker(detector=self._detector)
        try:
            pose = self._poses.sensor_at(time) if self._settings.use_odom else None
            self._tracks = self._tracker.update(
                time,
                scan_ranges(message),
                message.angle_min,
                message.angle_increment,
                None if pose is None else pose.tolist(),
            )
        except ValueError as error:
            self._refusals.add("scan", MessageError(str(error)))
            return
        self._time, self._pose = time, np.zeros(3) if pose is None else pose
        self._used += 1
        meant = self._selection.update(time, self._tracks, self._pose.tolist())
        self._publish(message.header.stamp, meant)

    def _publish(self, stamp: Any, meant: Track | None) -> None:
        if meant is not None:
            odometry = Odometry(child_frame_id=f"person_{meant.id}")
            odometry.header.stamp, odometry.header.frame_id = stamp, self._frame
            _fill_odometry(odometry, meant)
            self._odometry.publish(odometry)
            self._person.publish(PoseStamped(header=odometry.header, pose=odometry.pose.pose))
        self._persons.publish(self._all_persons(stamp))
        self._markers.publish(self._all_markers(stamp, meant))

    def _all_persons(self, stamp: Any) -> Any:
        """Those who are confirmed."""
        message = Persons(persons=[_person(track) for track in self._tracks if track.confirmed])
        message.header.stamp, message.header.frame_id = stamp, self._frame
        return message

    def _all_markers(self, stamp: Any, meant: Track | None) -> Any:
        """A column for each track and its id above, in place of those before."""
        markers = [Marker(action=Marker.DELETEALL)]
        for track in self._tracks:
            kind = "meant" if meant and track.id == meant.id else "person" if track.confirmed else "perhaps"
            for shape, size, height in (
                (Marker.CYLINDER, 0.4, 0.5 * HEIGHT),
                (Marker.TEXT_VIEW_FACING, 0.3, HEIGHT + 0.2),
            ):
                marker = Marker(ns="body" if shape == Marker.CYLINDER else "id", id=track.id, type=shape)
                marker.pose.position.x, marker.pose.position.y = track.position.tolist()
                marker.pose.position.z, marker.pose.orientation.w = height, 1.0
                marker.scale.x = marker.scale.y = size
                marker.scale.z = HEIGHT if shape == Marker.CYLINDER else size
                marker.color.r, marker.color.g, marker.color.b, marker.color.a = COLOURS[kind]
                marker.text = str(track.id)
                markers.append(marker)
        for marker in markers:
            marker.header.stamp, marker.header.frame_id = stamp, self._frame
        return MarkerArray(markers=markers)

    def _on_select(self, request: Any, response: Any) -> Any:
        pose = self._pose - [0.0, 0.0, self._settings.laser_yaw]
        try:
            response.selected = self._selection.select(request.id, self._tracks, pose.tolist()).id
        except ValueError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f"person {response.selected} is meant now"
            self.get_logger().info(response.message)
        return response

    def _report(self) -> None:
        """Once a second: how the last second went."""
        used, refused = self._used - self._reported, self._refusals.total - self._refused
        self._reported, self._refused = self._used, self._refusals.total
        if refused:
            level, summary = DiagnosticStatus.WARN, f"{refused} messages refused in the last second"
            self.get_logger().warning(summary, throttle_duration_sec=QUIET)
        elif used:
            level, summary = DiagnosticStatus.OK, "tracking"
        elif self._waiting:
            level, summary = (
                DiagnosticStatus.WARN,
                "scans wait for odom, which does not come; without odometry set use_odom to false",
            )
        else:
            level, summary = DiagnosticStatus.WARN, "no scan in the last second"
        persons = sum(track.confirmed for track in self._tracks)
        values = {"rate_hz": used, "persons": persons, **self._refusals.diagnostic_values()}
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))


def _person(track: Track) -> Any:
    (x, y), (vx, vy) = track.position.tolist(), track.velocity.tolist()
    return Person(id=track.id, x=x, y=y, vx=vx, vy=vy, deviation=track.deviation)


def _fill_odometry(message: Any, track: Track) -> None:
    """Position, the direction in which it walks, and velocity in the person's own frame, x ahead."""
    speed, heading = float(np.hypot(*track.velocity)), float(np.arctan2(track.velocity[1], track.velocity[0]))
    message.pose.pose.position.x, message.pose.pose.position.y = track.position.tolist()
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = (
        np.sin(heading / 2),
        np.cos(heading / 2),
    )
    message.twist.twist.linear.x = speed
    place, motion = np.diag([UNKNOWN] * 6), np.diag([UNKNOWN] * 6)
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s], [-s, c]])
    place[:2, :2], motion[:2, :2] = track.covariance[:2, :2], turn @ track.covariance[2:, 2:] @ turn.T
    message.pose.covariance, message.twist.covariance = place.ravel(), motion.ravel()


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(PersonTrackerNode, args)

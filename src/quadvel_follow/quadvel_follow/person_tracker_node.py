"""ROS node `person_tracker`: scan and odom in; person, person/odometry, persons and markers out.

The service select_person selects the followed person, see `selection`.
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

from quadvel_description.fields import field
from quadvel_msgs.msg import Person, Persons
from quadvel_msgs.srv import SelectPerson
from quadvel_nodes.diagnostics import LOG_THROTTLE_S, diagnostics
from quadvel_nodes.messages import MessageError, Refusals, seconds
from quadvel_nodes.node import read_parameters, run
from quadvel_nodes.silence import SilenceWarning

from .leg_detector import SHIPPED_MODEL, LegDetector
from .person_tracker import PersonTracker, Track
from .planar import planar_pose, scan_ranges
from .pose_history import PoseHistory
from .selection import Selection

CLOCK_RESET_S = 1.0
"""A scan that is older than the previous one by this time means that the clock was set back."""
UNKNOWN_VARIANCE = 1e6
"""Variance of quantities that are not estimated."""
MARKER_HEIGHT_M = 1.7
MARKER_RGBA = {
    "selected": (0.1, 0.8, 0.2, 0.9),
    "person": (0.2, 0.4, 1.0, 0.8),
    "perhaps": (0.6, 0.6, 0.6, 0.4),
}


@attrs.frozen
class PersonTrackerParameters:
    """Parameters of the node `person_tracker`.

    Raises:
        ValueError: A number is not finite.
    """

    model: str = field("", "ONNX file of the leg classifier; empty: the shipped one")
    use_odom: bool = field(
        True, "whether the robot's pose comes from odom; else tracks are in the frame of the scans"
    )
    laser_x: float = field(
        0.25, "position of the laser on the robot: forward, m; as in the shipped worlds", at_least=-np.inf
    )
    laser_y: float = field(0.0, "position of the laser on the robot: left, m", at_least=-np.inf)
    laser_yaw: float = field(0.0, "yaw of the laser on the robot, rad", at_least=-np.inf)
    select_nearest: bool = field(
        True, "whether the nearest person ahead is selected until select_person is called"
    )

    def make_detector(self) -> LegDetector:
        """Load the leg detector.

        Returns:
            The detector. Its ValueError for a wrong file propagates.
        """
        return LegDetector(Path(self.model) if self.model else SHIPPED_MODEL)


class PersonTrackerNode(Node):
    """ROS node around a PersonTracker; a scan waits until newer odometry has arrived."""

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
        self._scan_count = self._scan_count_before = 0
        warn = self.get_logger().warning
        self._no_scan = SilenceWarning(warn, "scan", "is a laser or `quadvel up --world` running?")
        self._no_odom = SilenceWarning(warn, "odom", "without odometry set use_odom to false")
        self._has_odom = not self._settings.use_odom
        self._person_message = self.create_publisher(PoseStamped, "person", 10)
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
        self._has_odom = True
        self._frame = message.header.frame_id
        while self._waiting and seconds(self._waiting[0].header.stamp) <= self._poses.newest:
            self._track_scan(self._waiting.popleft())

    def _on_scan(self, message: Any) -> None:
        if self._settings.use_odom:
            self._waiting.append(message)
        else:
            self._frame = message.header.frame_id
            self._track_scan(message)

    def _track_scan(self, message: Any) -> None:
        """Update the tracker with a scan message and publish the result."""
        time = seconds(message.header.stamp)
        if time < self._time - CLOCK_RESET_S:
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
        self._scan_count += 1
        selected = self._selection.update(time, self._tracks, self._pose.tolist())
        self._publish(message.header.stamp, selected)

    def _publish(self, stamp: Any, selected: Track | None) -> None:
        """Publish the selected person, all people and the markers."""
        if selected is not None:
            odometry = Odometry(child_frame_id=f"person_{selected.id}")
            odometry.header.stamp, odometry.header.frame_id = stamp, self._frame
            _fill_odometry(odometry, selected)
            self._odometry.publish(odometry)
            self._person_message.publish(PoseStamped(header=odometry.header, pose=odometry.pose.pose))
        self._persons.publish(self._all_persons(stamp))
        self._markers.publish(self._all_markers(stamp, selected))

    def _all_persons(self, stamp: Any) -> Any:
        """Return the message of all confirmed people."""
        message = Persons(persons=[_person_message(track) for track in self._tracks if track.confirmed])
        message.header.stamp, message.header.frame_id = stamp, self._frame
        return message

    def _all_markers(self, stamp: Any, selected: Track | None) -> Any:
        """Return markers that replace the previous ones: a column with an id for each track."""
        markers = [Marker(action=Marker.DELETEALL)]
        for track in self._tracks:
            kind = (
                "selected"
                if selected and track.id == selected.id
                else "person"
                if track.confirmed
                else "perhaps"
            )
            for shape, size, height in (
                (Marker.CYLINDER, 0.4, 0.5 * MARKER_HEIGHT_M),
                (Marker.TEXT_VIEW_FACING, 0.3, MARKER_HEIGHT_M + 0.2),
            ):
                marker = Marker(ns="body" if shape == Marker.CYLINDER else "id", id=track.id, type=shape)
                marker.pose.position.x, marker.pose.position.y = track.position.tolist()
                marker.pose.position.z, marker.pose.orientation.w = height, 1.0
                marker.scale.x = marker.scale.y = size
                marker.scale.z = MARKER_HEIGHT_M if shape == Marker.CYLINDER else size
                marker.color.r, marker.color.g, marker.color.b, marker.color.a = MARKER_RGBA[kind]
                marker.text = str(track.id)
                markers.append(marker)
        for marker in markers:
            marker.header.stamp, marker.header.frame_id = stamp, self._frame
        return MarkerArray(markers=markers)

    def _on_select(self, request: Any, response: Any) -> Any:
        """Select the person that the request names."""
        pose = self._pose - [0.0, 0.0, self._settings.laser_yaw]
        try:
            response.selected = self._selection.select(request.id, self._tracks, pose.tolist()).id
        except ValueError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f"person {response.selected} is selected"
            self.get_logger().info(response.message)
        return response

    def _report(self) -> None:
        """Publish the diagnostics of the last second."""
        used, self._scan_count_before = self._scan_count - self._scan_count_before, self._scan_count
        refused = self._refusals.last_second()
        self._no_scan.report(bool(self._scan_count or self._waiting), refused)
        self._no_odom.report(self._has_odom, refused)
        if refused:
            level, summary = DiagnosticStatus.WARN, refused
            self.get_logger().warning(summary, throttle_duration_sec=LOG_THROTTLE_S)
        elif used:
            level, summary = DiagnosticStatus.OK, "tracking"
        elif self._waiting:
            level, summary = (
                DiagnosticStatus.WARN,
                "scans wait for odom, but none arrives; without odometry set use_odom to false",
            )
        else:
            level, summary = DiagnosticStatus.WARN, "no scan in the last second"
        persons = sum(track.confirmed for track in self._tracks)
        values = {"rate_hz": used, "persons": persons, **self._refusals.diagnostic_values()}
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostics(stamp, self.get_name(), level, summary, values))


def _person_message(track: Track) -> Any:
    (x, y), (vx, vy) = track.position.tolist(), track.velocity.tolist()
    return Person(id=track.id, x=x, y=y, vx=vx, vy=vy, deviation=track.deviation)


def _fill_odometry(message: Any, track: Track) -> None:
    """Fill position, direction of walking, and velocity in the person's own frame with x ahead."""
    speed, heading = float(np.hypot(*track.velocity)), float(np.arctan2(track.velocity[1], track.velocity[0]))
    message.pose.pose.position.x, message.pose.pose.position.y = track.position.tolist()
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = (
        np.sin(heading / 2),
        np.cos(heading / 2),
    )
    message.twist.twist.linear.x = speed
    place, motion = np.diag([UNKNOWN_VARIANCE] * 6), np.diag([UNKNOWN_VARIANCE] * 6)
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s], [-s, c]])
    place[:2, :2], motion[:2, :2] = track.covariance[:2, :2], turn @ track.covariance[2:, 2:] @ turn.T
    message.pose.covariance, message.twist.covariance = place.ravel(), motion.ravel()


def main(args: list[str] | None = None) -> None:
    """Run the node `person_tracker`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(PersonTrackerNode, args)

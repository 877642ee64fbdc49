"""Connects tracker, selection and planner in one process, as their nodes do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadvel_description.arrays import Array
from quadvel_follow.follow_planner import FollowConfig, FollowPlanner, Plan
from quadvel_follow.leg_detector import LegDetector
from quadvel_follow.person_tracker import PersonTracker, Track
from quadvel_follow.selection import Selection
from quadvel_sim.laser import Scan


class Follower:
    """Person follower: takes scans and odometry, and returns plans. Times are in s.

    Args:
        config: Parameters of the planner.
        detector: Leg detector; None for the shipped one.
    """

    def __init__(self, config: FollowConfig, detector: LegDetector | None = None) -> None:
        self._planner, self._selection = FollowPlanner(config), Selection()
        self._tracker = PersonTracker(detector=detector)

    def on_odometry(self, now: float, pose: Sequence[float], velocity: Array) -> None:
        """Take an odometry message.

        Args:
            now: Time, s.
            pose: x, y (m) and yaw (rad).
            velocity: vx, vy (m/s) and wz (rad/s), body frame, (3,).
        """
        self._planner.on_odometry(now, now, pose, velocity)

    def on_scan(self, now: float, scan: Scan, sensor: Array) -> Track | None:
        """Take a scan: update tracks and obstacles.

        Args:
            now: Time, s.
            scan: The scan.
            sensor: x, y (m) and yaw (rad) of the scanner (3,).

        Returns:
            Track of the selected person; None if no person is selected.
        """
        angles = scan.angle_min, scan.angle_increment
        self._planner.on_scan(now, now, scan.ranges, *angles)
        tracks = self._tracker.update(now, scan.ranges, *angles, sensor.tolist())
        others = [np.append(track.position, track.velocity) for track in tracks if track.confirmed]
        self._planner.on_others(now, now, np.reshape(others, (-1, 4)))
        return self._selection.update(now, tracks, sensor.tolist())

    def on_person(self, now: float, target: Track | None) -> None:
        """Pass the selected person to the planner.

        Args:
            now: Time, s.
            target: Track of the person; None if no person is selected.
        """
        if target is not None:
            self._planner.on_person(now, now, np.append(target.position, target.velocity), target.deviation)

    def step(self, now: float) -> Plan:
        """Plan the next command.

        Args:
            now: Time, s.

        Returns:
            The plan.
        """
        return self._planner.step(now)

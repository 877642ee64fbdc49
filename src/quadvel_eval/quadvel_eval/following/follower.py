"""Tracker, selection and planner in one process, as their nodes connect them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quadvel_follow.follow_planner import FollowConfig, FollowPlanner, Plan
from quadvel_follow.leg_detector import LegDetector
from quadvel_follow.person_tracker import PersonTracker, Track
from quadvel_follow.selection import Selection
from quadvel_sim.laser import Scan

Array = NDArray[np.float64]


class Follower:
    """Scans and odometry in, plans out; all at the instant `now`, s."""

    def __init__(self, config: FollowConfig, detector: LegDetector | None = None) -> None:
        self._planner, self._selection = FollowPlanner(config), Selection()
        self._tracker = PersonTracker(detector=detector)

    def on_odometry(self, now: float, pose: Sequence[float], velocity: Array) -> None:
        """pose: x, y (m), yaw (rad); velocity (3,): vx, vy (m/s), wz (rad/s)."""
        self._planner.on_odometry(now, now, pose, velocity)

    def on_scan(self, now: float, scan: Scan, sensor: Array) -> Track | None:
        """The person who is meant, in a scan from the pose `sensor` (3,) of the scanner."""
        angles = scan.angle_min, scan.angle_increment
        self._planner.on_scan(now, now, scan.ranges, *angles)
        tracks = self._tracker.update(now, scan.ranges, *angles, sensor.tolist())
        others = [np.append(track.position, track.velocity) for track in tracks if track.confirmed]
        self._planner.on_others(now, now, np.reshape(others, (-1, 4)))
        return self._selection.update(now, tracks, sensor.tolist())

    def on_person(self, now: float, meant: Track | None) -> None:
        """Tell the planner of the person who is meant, if there is one."""
        if meant is not None:
            self._planner.on_person(now, now, np.append(meant.position, meant.velocity), meant.deviation)

    def step(self, now: float) -> Plan:
        """The plan now."""
        return self._planner.step(now)

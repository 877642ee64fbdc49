"""Evidence from scans about places: a place was seen empty, occupied, or not at all.

Static objects are where they were. People move to places that were empty and leave empty places.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from quadvel_description.arrays import Array, Bools

from .clusters import LEG_WIDTH_M, Scan

SIDE_OFFSETS_M = np.array([-0.15, -0.075, 0.0, 0.075, 0.15])
"""Lateral offsets that are checked at a place."""
PLACE_DEPTH_M = 0.25
"""Distance before and behind a place within which a reading belongs to it."""
MEMORY_S = 1.6
"""Time for which scans are kept, s."""
KEEP_PERIOD_S = 0.15
"""Smallest time between two kept scans."""
MIN_AGE_S = 0.45
"""Smallest age of a scan that can show motion."""
FIXED_RANGE_M = 0.04
"""Variation of the range to a part of the robot."""
CARRIED_SHARE = 0.7
"""Share of the scans in which a part of the robot is seen at its place."""


def to_frame(points: Array, pose: Array) -> Array:
    """Transform points from a sensor frame to the frame of its pose.

    Args:
        points: Points in the sensor frame, (n, 2), m.
        pose: Pose of the sensor, (3,): x, y in m, yaw in rad.

    Returns:
        Points, (n, 2), m.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def to_sensor(points: Array, pose: Array) -> Array:
    """Transform points to a sensor frame, the inverse of `to_frame`.

    Args:
        points: Points, (n, 2), m.
        pose: Pose of the sensor, (3,): x, y in m, yaw in rad.

    Returns:
        Points in the sensor frame, (n, 2), m.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])


def check_places(scan: Scan, points: Array, sideways: Array = SIDE_OFFSETS_M) -> tuple[Bools, Bools]:
    """Check whether a scan shows that places are empty or occupied.

    Neither holds if the place is hidden or outside the field of view. A place is not called empty if
    the rays are so far apart that a leg fits between them.

    Args:
        scan: The scan.
        points: Places in the sensor frame, (n, 2), m.
        sideways: Lateral offsets that are checked at each place, m.

    Returns:
        Whether each place is empty, (n,), and whether it is occupied, (n,).
    """
    distance = np.hypot(*points.T)
    aside = np.arctan2(sideways, np.maximum(distance, 0.1)[:, None])
    reading = scan.range_at(np.arctan2(points[:, 1], points[:, 0])[:, None] + aside)
    behind = reading - distance[:, None]
    close = scan.angle_increment * distance < LEG_WIDTH_M
    return (behind > PLACE_DEPTH_M).all(1) & close, (np.abs(behind) <= PLACE_DEPTH_M).any(1)


class ScanHistory:
    """Recent scans with their poses."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, Scan, Array]] = deque()

    def add(self, time: float, scan: Scan, pose: Array) -> None:
        """Keep a scan unless another one was kept less than `KEEP_PERIOD_S` ago.

        Args:
            time: Time of the scan, s.
            scan: The scan.
            pose: Pose of the sensor at that time, (3,): x, y in m, yaw in rad.
        """
        while self._kept and time - self._kept[0][0] > MEMORY_S:
            self._kept.popleft()
        if not self._kept or time - self._kept[-1][0] >= KEEP_PERIOD_S:
            self._kept.append((time, scan, pose))

    def count_evidence(self, time: float, points: Array, pose: Array) -> tuple[Array, Array]:
        """Count the older scans in which places were empty or occupied.

        A point that is fixed relative to the scanner counts as occupied: it rests, or belongs to
        the robot.

        Args:
            time: Present time, s.
            points: Places, (n, 2), m, in the frame of the poses.
            pose: Present pose of the sensor, (3,): x, y in m, yaw in rad.

        Returns:
            Number of scans with an empty place, (n,), and with an occupied place, (n,).
        """
        older_scans = [(scan, then) for made, scan, then in self._kept if time - made >= MIN_AGE_S]
        if not older_scans:
            return np.zeros(len(points)), np.zeros(len(points))
        empty, occupied = np.array(
            [check_places(scan, to_sensor(points, then)) for scan, then in older_scans]
        ).sum(0, dtype=float)
        local = to_sensor(points, pose)
        distance, bearing = np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])
        same = np.mean(
            [np.abs(scan.range_at(bearing) - distance) < FIXED_RANGE_M for scan, _ in older_scans], axis=0
        )
        carried = same > CARRIED_SHARE
        return np.where(carried, 0.0, empty), np.where(carried, float(len(older_scans)), occupied)

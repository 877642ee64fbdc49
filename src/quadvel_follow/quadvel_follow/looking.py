"""What a scan says of a place: that it is empty, that something is there, or nothing.

What stands about is where it was; who walks comes to places that were seen empty, and leaves places empty.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from .clusters import LEG, Scan

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SIDEWAYS = np.array(
    [-0.15, -0.075, 0.0, 0.075, 0.15]
)  # m, what is looked at to the left and the right of a place
DEPTH = 0.25  # m, before and behind a place, to what is taken to be in it
MEMORY = 1.6  # s, that scans are kept for
EVERY = 0.15  # s, from one that is kept to the next, at least
AGE = 0.45  # s, from which a scan tells that something has moved
FIXED = 0.04  # m, by which the range to a part of the robot that carries the scanner varies
CARRIED = 0.7  # share of the scans in which such a part is seen in its place


def to_frame(points: Array, pose: Array) -> Array:
    """Points (n, 2) of a sensor's frame in the frame of its pose x, y, yaw."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def to_sensor(points: Array, pose: Array) -> Array:
    """The way back of `to_frame`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])


def look(scan: Scan, points: Array, sideways: Array = SIDEWAYS) -> tuple[Flags, Flags]:
    """Whether the scan shows that places (n, 2) of the sensor's frame are empty, and whether that they are taken.

    Neither, where something stands before them, where rays are too far apart, and beyond the scan's ends.
    """
    distance = np.hypot(*points.T)
    aside = np.arctan2(sideways, np.maximum(distance, 0.1)[:, None])
    reading = scan.at(np.arctan2(points[:, 1], points[:, 0])[:, None] + aside)
    behind = reading - distance[:, None]
    close = scan.angle_increment * distance < LEG
    return (behind > DEPTH).all(1) & close, (np.abs(behind) <= DEPTH).any(1)


class Past:
    """The scans of the last moments, each with the pose from which it was made."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, Scan, Array]] = deque()

    def add(self, time: float, scan: Scan, pose: Array) -> None:
        """Keep a scan, unless one was kept a moment ago."""
        while self._kept and time - self._kept[0][0] > MEMORY:
            self._kept.popleft()
        if not self._kept or time - self._kept[-1][0] >= EVERY:
            self._kept.append((time, scan, pose))

    def counts(self, time: float, points: Array, pose: Array) -> tuple[Array, Array]:
        """In how many of the scans these places (n, 2) were seen empty, and in how many taken.

        What keeps its place against the scanner counts as taken: it rests, or belongs to what carries the scanner.
        """
        looks = [(scan, then) for made, scan, then in self._kept if time - made >= AGE]
        if not looks:
            return np.zeros(len(points)), np.zeros(len(points))
        empty, taken = np.array([look(scan, to_sensor(points, then)) for scan, then in looks]).sum(
            0, dtype=float
        )
        local = to_sensor(points, pose)
        distance, bearing = np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])
        same = np.mean([np.abs(scan.at(bearing) - distance) < FIXED for scan, _ in looks], axis=0)
        carried = same > CARRIED
        return np.where(carried, 0.0, empty), np.where(carried, float(len(looks)), taken)

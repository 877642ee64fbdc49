"""Where something stands, remembered in the frame of the odometry: scans show what is in view, and a robot turns away.

Persons are not kept here: they move, and whoever plans knows them as tracks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .clusters import Scan
from .looking import to_frame, to_sensor

Array = NDArray[np.float64]

CELL = 0.05  # m
REACH = 5.0  # m, up to which readings are kept
NEAR = 2.5  # m, up to which one reading is believed at once; those farther off may be the ground before a trunk that pitches
BELIEVED = 3  # readings of a place farther off, less those that found it empty, from which something is there
SURE = 4  # most that are counted, so that what has left is soon forgotten
BEHIND = 0.2  # m, from a place to a reading beyond it that finds it empty
AGE = 30.0  # s, after which what was not seen again is forgotten
PERSON = 0.45  # m, from the middle of a person to readings of it: a leg that leads is half a step ahead
LONGEST = 8.0  # m, up to which a ray without a reading says that nothing is there
_ROW = 1 << 20  # cells, far more than any way leads


class ObstacleMemory:
    """One scan after the other; cells of `CELL`, each with the newest reading in it."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)  # sorted
        self._points = np.zeros((0, 2))  # m
        self._counts = np.zeros(0)
        self._times = np.zeros(0)  # s

    @property
    def points(self) -> Array:
        """Where something stands, (n, 2) m in the frame of the poses."""
        return self._points[self._counts >= BELIEVED]

    def add(self, time: float, scan: Scan, pose: Array, persons: ArrayLike = ()) -> None:
        """A scan at `time` (s) from the sensor's pose (3,): x, y (m), yaw (rad); persons (n, 2): m, whose readings are left out."""
        self._forget(time, scan, pose)
        near = np.isfinite(scan.ranges) & (scan.ranges < REACH)
        reading = scan.ranges[near]
        angles = scan.angle_min + scan.angle_increment * np.flatnonzero(near)
        points = to_frame(reading[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), pose)
        counts = np.where(reading < NEAR, BELIEVED, 1)
        for person in np.reshape(persons, (-1, 2)):
            apart = np.hypot(*(points - person).T) > PERSON
            points, counts = points[apart], counts[apart]
        self._take(time, points, counts)

    def _take(self, time: float, points: Array, counts: Array) -> None:
        """One reading a cell and scan; a cell that is near counts as believed."""
        rows: NDArray[np.int64] = np.floor(points / CELL).astype(np.int64)
        cells: NDArray[np.int64] = rows[:, 0] * _ROW + rows[:, 1]
        keys, first = np.unique(cells, return_index=True)
        place = np.searchsorted(self._keys, keys)
        known = np.isin(keys, self._keys, assume_unique=True)
        again, found = np.atleast_1d(place)[known], first[known]
        self._points[again], self._times[again] = points[found], time
        self._counts[again] = np.minimum(np.maximum(self._counts[again] + 1, counts[found]), SURE)
        new = first[~known]
        order = np.argsort(np.concatenate([self._keys, keys[~known]]), kind="stable")
        self._keys = np.concatenate([self._keys, keys[~known]])[order]
        self._points = np.concatenate([self._points, points[new]])[order]
        self._counts = np.concatenate([self._counts, counts[new].astype(float)])[order]
        self._times = np.concatenate([self._times, np.full(len(new), time)])[order]

    def _forget(self, time: float, scan: Scan, pose: Array) -> None:
        """What the scan sees to be empty, bit by bit; what is old or far off."""
        seen = to_sensor(self._points, pose)
        distance = np.hypot(*seen.T)
        bearing = np.arctan2(seen[:, 1], seen[:, 0])
        beside = scan.angle_increment * np.array([-1.0, 0.0, 1.0])
        reading = np.minimum(scan.at(bearing[:, None] + beside), LONGEST).min(1)  # NaN out of view
        empty = reading > distance + BEHIND
        self._counts -= empty
        kept = (self._counts > 0) & (time - self._times < AGE) & (distance < 2.0 * REACH)
        self._keys, self._points = self._keys[kept], self._points[kept]
        self._counts, self._times = self._counts[kept], self._times[kept]

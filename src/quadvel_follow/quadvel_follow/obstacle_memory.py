"""Obstacle map in the odometry frame for objects out of view; people are excluded.

`free_space` judges what a scan shows about a place; `clearance` computes distances to the points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array

from .clusters import Scan
from .free_space import to_frame, to_sensor

CELL_SIZE_M = 0.05
MAX_RANGE_M = 5.0
"""Largest range of a reading that is kept."""
NEAR_RANGE_M = 2.5
"""Range up to which one reading suffices; farther ones may be ground before a pitching trunk."""
MIN_COUNT = 3
"""Occupied minus empty readings from which a cell is an obstacle."""
MAX_COUNT = 4
"""Bound of that count, so that an object that left disappears soon."""
EMPTY_MARGIN_M = 0.2
"""Distance from a cell to a reading beyond it that shows it is empty."""
MAX_AGE_S = 30.0
"""Time after which a cell without new readings is removed."""
PERSON_RADIUS_M = 0.45
"""Distance from a person to its readings: a leading leg is half a step ahead."""
NO_ECHO_RANGE_M = 8.0
"""Range up to which a ray without an echo shows free space."""
_ROW_STRIDE = 1 << 20  # number of cells in a row: more than any path is long


class ObstacleMemory:
    """Sparse grid of cells of `CELL_SIZE_M`, each with its newest reading."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)  # sorted
        self._points = np.zeros((0, 2))  # m
        self._counts = np.zeros(0)
        self._times = np.zeros(0)  # s

    @property
    def points(self) -> Array:
        """Obstacle points in the frame of the poses, (n, 2), m."""
        return self._points[self._counts >= MIN_COUNT]

    def add(self, time: float, scan: Scan, pose: Array, persons: ArrayLike = ()) -> None:
        """Add a scan.

        Args:
            time: Time of the scan, s.
            scan: The scan.
            pose: Pose of the sensor, (3,): x, y in m, yaw in rad.
            persons: Positions of people whose readings are ignored, (n, 2), m.
        """
        self._remove_stale(time, scan, pose)
        near = np.isfinite(scan.ranges) & (scan.ranges < MAX_RANGE_M)
        reading = scan.ranges[near]
        angles = scan.angle_min + scan.angle_increment * np.flatnonzero(near)
        points = to_frame(reading[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), pose)
        counts = np.where(reading < NEAR_RANGE_M, MIN_COUNT, 1)
        for person in np.reshape(persons, (-1, 2)):
            apart = np.hypot(*(points - person).T) > PERSON_RADIUS_M
            points, counts = points[apart], counts[apart]
        self._insert(time, points, counts)

    def _insert(self, time: float, points: Array, counts: Array) -> None:
        """Insert one reading per cell; a near cell counts as confirmed."""
        rows: NDArray[np.int64] = np.floor(points / CELL_SIZE_M).astype(np.int64)
        cells: NDArray[np.int64] = rows[:, 0] * _ROW_STRIDE + rows[:, 1]
        keys, first = np.unique(cells, return_index=True)
        place = np.searchsorted(self._keys, keys)
        known = np.isin(keys, self._keys, assume_unique=True)
        again, found = np.atleast_1d(place)[known], first[known]
        self._points[again], self._times[again] = points[found], time
        self._counts[again] = np.minimum(np.maximum(self._counts[again] + 1, counts[found]), MAX_COUNT)
        new = first[~known]
        order = np.argsort(np.concatenate([self._keys, keys[~known]]), kind="stable")
        self._keys = np.concatenate([self._keys, keys[~known]])[order]
        self._points = np.concatenate([self._points, points[new]])[order]
        self._counts = np.concatenate([self._counts, counts[new].astype(float)])[order]
        self._times = np.concatenate([self._times, np.full(len(new), time)])[order]

    def _remove_stale(self, time: float, scan: Scan, pose: Array) -> None:
        """Lower the counts of cells that the scan sees empty; remove old and distant cells."""
        seen = to_sensor(self._points, pose)
        distance = np.hypot(*seen.T)
        bearing = np.arctan2(seen[:, 1], seen[:, 0])
        neighbour_offsets = scan.angle_increment * np.array([-1.0, 0.0, 1.0])
        # Nearest of three rays; NaN outside the field of view compares as not empty.
        reading = np.minimum(scan.range_at(bearing[:, None] + neighbour_offsets), NO_ECHO_RANGE_M).min(1)
        empty = reading > distance + EMPTY_MARGIN_M
        self._counts -= empty
        kept = (self._counts > 0) & (time - self._times < MAX_AGE_S) & (distance < 2.0 * MAX_RANGE_M)
        self._keys, self._points = self._keys[kept], self._points[kept]
        self._counts, self._times = self._counts[kept], self._times[kept]

"""How far a robot's outline stays from points in the plane, for many poses at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

Array = NDArray[np.float64]

CELL = 0.05  # m
HALF = 4.0  # m, from the middle of the field to its edge
SIDE = round(2.0 * HALF / CELL)
SAMPLES = (-0.75, 0.0, 0.75)  # of half the outline's length, from where the nearest points are looked for


class Clearance:
    """A field of nearest points around a place; what lies beyond it is not looked at."""

    def __init__(self, points: Array, middle: ArrayLike, length: float, width: float) -> None:
        """points (n, 2), middle (2,): m; length, width: m, of the outline, a rectangle round the robot's middle."""
        self._half = 0.5 * length, 0.5 * width
        self._origin = np.asarray(middle, float) - HALF
        cells = self._cells(points)
        inside = ((cells >= 0) & (cells < SIDE)).all(1)
        self._empty = not inside.any()
        if self._empty:
            return
        cells, points = cells[inside], points[inside]
        free = np.ones((SIDE, SIDE), bool)
        free[cells[:, 0], cells[:, 1]] = False
        kept = np.zeros((SIDE, SIDE, 2))
        kept[cells[:, 0], cells[:, 1]] = points
        nearest = distance_transform_edt(free, return_distances=False, return_indices=True)
        self._nearest = kept[nearest[0], nearest[1]]

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.floor((points - self._origin) / CELL).astype(np.int64)

    def of(self, poses: Array) -> Array:
        """From the outline at poses (..., 3): x, y (m), yaw (rad), to the nearest point, (...) in m; below 0 inside."""
        if self._empty:
            return np.full(poses.shape[:-1], np.inf)
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        found = np.full(poses.shape[:-1], np.inf)
        for share in SAMPLES:
            ahead = share * self._half[0]
            place = np.stack([poses[..., 0] + ahead * c, poses[..., 1] + ahead * s], axis=-1)
            cells = np.clip(self._cells(place), 0, SIDE - 1)
            nearest = self._nearest[cells[..., 0], cells[..., 1]]
            found = np.minimum(found, outline_distance(nearest, poses, self._half))
        return found

    def of_disc(self, places: Array) -> Array:
        """From places (..., 2), m, to the nearest point, (...) in m."""
        if self._empty:
            return np.full(places.shape[:-1], np.inf)
        cells = np.clip(self._cells(places), 0, SIDE - 1)
        off = self._nearest[cells[..., 0], cells[..., 1]] - places
        return np.hypot(off[..., 0], off[..., 1])


def outline_distance(points: Array, poses: Array, half: tuple[float, float]) -> Array:
    """From points (..., 2) to rectangles at poses (..., 3) of these half lengths and widths, (...) in m; below 0 inside."""
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    off = points - poses[..., :2]
    x = np.abs(c * off[..., 0] + s * off[..., 1]) - half[0]
    y = np.abs(c * off[..., 1] - s * off[..., 0]) - half[1]
    distance: Array = np.hypot(np.maximum(x, 0.0), np.maximum(y, 0.0)) + np.minimum(np.maximum(x, y), 0.0)
    return distance

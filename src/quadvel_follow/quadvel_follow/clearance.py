"""Distance between the robot's outline and obstacle points in the plane, for batches of poses.

`obstacle_memory` supplies the points; `follow_costs` turns distances into costs. Points and poses
are in the odometry frame, m and rad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from quadvel_description.arrays import Array

CELL_SIZE_M = 0.05
HALF_SIZE_M = 4.0  # from the centre of the grid to its edge
CELLS_PER_SIDE = round(2.0 * HALF_SIZE_M / CELL_SIZE_M)
SAMPLE_POSITIONS = (-0.75, 0.0, 0.75)
"""Points on the robot's centre line, by its half length, at which the nearest obstacle is read."""


class Clearance:
    """Grid of nearest obstacle points around a place; obstacles outside are ignored."""

    def __init__(self, points: Array, middle: ArrayLike, length: float, width: float) -> None:
        """Compute the grid with a Euclidean distance transform.

        Args:
            points: Obstacle points, (n, 2), m.
            middle: Centre of the grid, (2,), m.
            length: Length of the robot's rectangular outline, m.
            width: Width of the outline, m.
        """
        self._half = 0.5 * length, 0.5 * width
        self._origin = np.asarray(middle, float) - HALF_SIZE_M
        cells = self._cell_indices(points)
        inside = ((cells >= 0) & (cells < CELLS_PER_SIDE)).all(1)
        self._empty = not inside.any()
        if self._empty:
            return
        cells, points = cells[inside], points[inside]
        free = np.ones((CELLS_PER_SIDE, CELLS_PER_SIDE), bool)
        free[cells[:, 0], cells[:, 1]] = False
        kept = np.zeros((CELLS_PER_SIDE, CELLS_PER_SIDE, 2))
        kept[cells[:, 0], cells[:, 1]] = points
        nearest = distance_transform_edt(free, return_distances=False, return_indices=True)
        self._nearest = kept[nearest[0], nearest[1]]

    def _cell_indices(self, points: Array) -> NDArray[np.int64]:
        """Return the grid indices of points."""
        return np.floor((points - self._origin) / CELL_SIZE_M).astype(np.int64)

    def at_poses(self, poses: Array) -> Array:
        """Compute the distance between the outline and the nearest obstacle point.

        Args:
            poses: Poses of the robot, (..., 3): x, y in m, yaw in rad.

        Returns:
            Distances, (...), m; negative inside the outline.
        """
        if self._empty:
            return np.full(poses.shape[:-1], np.inf)
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        found = np.full(poses.shape[:-1], np.inf)
        for share in SAMPLE_POSITIONS:
            ahead = share * self._half[0]
            place = np.stack([poses[..., 0] + ahead * c, poses[..., 1] + ahead * s], axis=-1)
            cells = np.clip(self._cell_indices(place), 0, CELLS_PER_SIDE - 1)
            nearest = self._nearest[cells[..., 0], cells[..., 1]]
            found = np.minimum(found, outline_distance(nearest, poses, self._half))
        return found

    def at_points(self, places: Array) -> Array:
        """Compute the distance between points and the nearest obstacle point.

        Args:
            places: Points, (..., 2), m.

        Returns:
            Distances, (...), m.
        """
        if self._empty:
            return np.full(places.shape[:-1], np.inf)
        cells = np.clip(self._cell_indices(places), 0, CELLS_PER_SIDE - 1)
        off = self._nearest[cells[..., 0], cells[..., 1]] - places
        return np.hypot(off[..., 0], off[..., 1])


def outline_distance(points: Array, poses: Array, half: tuple[float, float]) -> Array:
    """Compute the signed distance between points and rectangles.

    Args:
        points: Points, (..., 2), m.
        poses: Poses of the rectangles, (..., 3): x, y in m, yaw in rad.
        half: Half length and half width, m.

    Returns:
        Distances, (...), m; negative inside.
    """
    # Signed distance of a rectangle, with d = |R^T (p - c)| - half:
    # ||max(d, 0)|| + min(max(d_x, d_y), 0).
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    off = points - poses[..., :2]
    x = np.abs(c * off[..., 0] + s * off[..., 1]) - half[0]
    y = np.abs(c * off[..., 1] - s * off[..., 0]) - half[1]
    distance: Array = np.hypot(np.maximum(x, 0.0), np.maximum(y, 0.0)) + np.minimum(np.maximum(x, y), 0.0)
    return distance

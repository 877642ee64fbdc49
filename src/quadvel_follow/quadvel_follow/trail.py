"""Trail of a walking person: a path for the robot while it does not see the person."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

POINT_SPACING_M = 0.15
"""Distance between two points."""
MAX_LENGTH_M = 10.0  # m


class Trail:
    """Points of the trail in the odometry frame, oldest first."""

    def __init__(self) -> None:
        self._points: deque[Array] = deque(maxlen=round(MAX_LENGTH_M / POINT_SPACING_M))

    def add(self, place: ArrayLike) -> None:
        """Add the present position of the person.

        Args:
            place: Position, (2,), m.
        """
        found = np.asarray(place, float)
        if not self._points or np.hypot(*(found - self._points[-1])) >= POINT_SPACING_M:
            self._points.append(found)

    @property
    def points(self) -> Array:
        """Points, (n, 2), m."""
        return np.array(self._points).reshape(-1, 2)

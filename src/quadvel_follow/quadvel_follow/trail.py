"""The way that a person walked, which a robot can take where it does not see the person."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

STEP = 0.15  # m, from one point to the next
LONGEST = 10.0  # m


class Trail:
    """Points from the oldest to the newest, m, in the frame of the odometry."""

    def __init__(self) -> None:
        self._points: deque[Array] = deque(maxlen=round(LONGEST / STEP))

    def add(self, place: ArrayLike) -> None:
        """Where the person is seen now, (2,) m."""
        found = np.asarray(place, float)
        if not self._points or np.hypot(*(found - self._points[-1])) >= STEP:
            self._points.append(found)

    @property
    def points(self) -> Array:
        """(n, 2)."""
        return np.array(self._points).reshape(-1, 2)

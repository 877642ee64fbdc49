"""A floor plan and a laser scanner in it: rays against circles and segments, with the faults of the simulator's.

For tests, training and as the measure of other simulated lasers; not for dynamics.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_sim.laser import Scanner

Array = NDArray[np.float64]


def _circles(values: ArrayLike) -> Array:
    return np.reshape(np.asarray(values, float), (-1, 3))


def _segments(values: ArrayLike) -> Array:
    return np.reshape(np.asarray(values, float), (-1, 4))


@attrs.frozen
class FloorPlan:
    """What a ray may hit: circles (N, 3), each x, y, radius; segments (M, 4), each x, y of both ends; all m."""

    circles: Array = attrs.field(default=(), converter=_circles)
    segments: Array = attrs.field(default=(), converter=_segments)

    def with_circles(self, circles: ArrayLike) -> FloorPlan:
        """This plan with more circles in it."""
        return FloorPlan(np.vstack([self.circles, _circles(circles)]), self.segments)

    def cast(self, origin: ArrayLike, angles: Array) -> Array:
        """How far rays from `origin` (2,) at `angles` (rays,) go, (rays,) in m; inf where they hit nothing."""
        ahead = np.column_stack([np.cos(angles), np.sin(angles)])
        start = np.asarray(origin, float)
        return np.minimum(self._to_circles(start, ahead), self._to_segments(start, ahead))

    def _to_circles(self, start: Array, ahead: Array) -> Array:
        """|start + t ahead - centre| = radius, the lesser t."""
        if not len(self.circles):
            return np.full(len(ahead), np.inf)
        to_centre = self.circles[:, :2] - start
        along = ahead @ to_centre.T
        root = self.circles[:, 2] ** 2 - (to_centre**2).sum(1) + along**2
        hit = along - np.sqrt(np.maximum(root, 0.0))
        return np.where((root >= 0.0) & (hit > 0.0), hit, np.inf).min(1)

    def _to_segments(self, start: Array, ahead: Array) -> Array:
        """start + t ahead = a + s (b - a), with s from 0 to 1."""
        if not len(self.segments):
            return np.full(len(ahead), np.inf)
        to_end, side = self.segments[:, :2] - start, self.segments[:, 2:] - self.segments[:, :2]
        cross = ahead[:, :1] * side[:, 1] - ahead[:, 1:] * side[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (to_end[:, 0] * side[:, 1] - to_end[:, 1] * side[:, 0]) / cross
            s = (to_end[:, 0] * ahead[:, 1:] - to_end[:, 1] * ahead[:, :1]) / cross
        return np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf).min(1)


class Laser(Scanner):
    """A scanner in a floor plan."""

    def scan(self, plan: FloorPlan, pose: Array, rng: np.random.Generator) -> Array:
        """Ranges (rays,) in m, from a pose x, y, yaw."""
        return self.measure(plan.cast(pose[:2], self.angles + pose[2]), rng)

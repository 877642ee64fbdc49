"""Simulates a laser scanner in a floor plan: rays against circles and segments, with sensor noise.

Tests, training and the check of other simulated lasers use it; the physics simulation does not.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_sim.laser import Scanner


def _as_circles(values: ArrayLike) -> Array:
    """Convert to an array (N, 3)."""
    return np.reshape(np.asarray(values, float), (-1, 3))


def _as_segments(values: ArrayLike) -> Array:
    """Convert to an array (M, 4)."""
    return np.reshape(np.asarray(values, float), (-1, 4))


@attrs.frozen
class FloorPlan:
    """Obstacles of a laser in the plane.

    Attributes:
        circles: x, y and radius of each circle (N, 3), m.
        segments: x, y of both ends of each segment (M, 4), m.
    """

    circles: Array = attrs.field(default=(), converter=_as_circles)
    segments: Array = attrs.field(default=(), converter=_as_segments)

    def with_circles(self, circles: ArrayLike) -> FloorPlan:
        """Return a plan with additional circles.

        Args:
            circles: x, y and radius of each (N, 3), m.

        Returns:
            The new plan.
        """
        return FloorPlan(np.vstack([self.circles, _as_circles(circles)]), self.segments)

    def cast(self, origin: ArrayLike, angles: Array) -> Array:
        """Return the length of rays up to the nearest obstacle.

        Args:
            origin: Common origin of the rays (2,), m.
            angles: Directions of the rays (rays,), rad.

        Returns:
            Lengths (rays,), m; inf without an obstacle.
        """
        ahead = np.column_stack([np.cos(angles), np.sin(angles)])
        start = np.asarray(origin, float)
        return np.minimum(self._to_circles(start, ahead), self._to_segments(start, ahead))

    def _to_circles(self, start: Array, ahead: Array) -> Array:
        """Lengths of rays up to the nearest circle, m."""
        if not len(self.circles):
            return np.full(len(ahead), np.inf)
        # |o + t d - c| = r, with |d| = 1 and b = d . (c - o):
        # t = b - sqrt(r^2 - |c - o|^2 + b^2), the nearer of both intersections.
        to_centre = self.circles[:, :2] - start
        along = ahead @ to_centre.T
        root = self.circles[:, 2] ** 2 - (to_centre**2).sum(1) + along**2
        hit = along - np.sqrt(np.maximum(root, 0.0))
        return np.where((root >= 0.0) & (hit > 0.0), hit, np.inf).min(1)

    def _to_segments(self, start: Array, ahead: Array) -> Array:
        """Lengths of rays up to the nearest segment, m."""
        if not len(self.segments):
            return np.full(len(ahead), np.inf)
        # o + t d = a + s e, with e = b - a and the cross product in the plane:
        # t = ((a - o) x e) / (d x e), s = ((a - o) x d) / (d x e), valid for t > 0 and 0 <= s <= 1.
        to_end, side = self.segments[:, :2] - start, self.segments[:, 2:] - self.segments[:, :2]
        cross = ahead[:, :1] * side[:, 1] - ahead[:, 1:] * side[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (to_end[:, 0] * side[:, 1] - to_end[:, 1] * side[:, 0]) / cross
            s = (to_end[:, 0] * ahead[:, 1:] - to_end[:, 1] * ahead[:, :1]) / cross
        return np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf).min(1)


class Laser(Scanner):
    """Laser scanner in a floor plan."""

    def scan(self, plan: FloorPlan, pose: Array, rng: np.random.Generator) -> Array:
        """Simulate one scan.

        Args:
            plan: The obstacles.
            pose: x, y (m) and yaw (rad) of the scanner.
            rng: Random number generator of the noise.

        Returns:
            Ranges (rays,), m.
        """
        return self.measure(plan.cast(pose[:2], self.angles + pose[2]), rng)

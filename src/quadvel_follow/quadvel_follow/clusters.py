"""Segmentation of a laser scan into clusters, and their features for the leg classifier.

`leg_detector` classifies the clusters. Points and ranges are in the frame of the sensor, m; angles
in rad from its x axis.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array, Bools, Indices

MIN_RANGE_M = 0.02
"""A smaller range means that there was no echo."""
MIN_GAP_M = 0.13
"""Neighbouring readings farther apart than this belong to different clusters."""
MIN_GAP_SPACINGS = 1.6
"""The same as a multiple of the distance of neighbouring rays; the larger limit applies."""
MAX_LOST_RAYS = 3
"""Largest number of rays without an echo inside a cluster."""
WINDOW_OFFSETS_M = np.linspace(-0.6, 0.6, 49)
"""Lateral positions of the classifier's window."""
WINDOW_DEPTH_M = 0.5
"""Depth of the classifier's window before and behind the centre."""
LEG_WIDTH_M = 0.12
"""Typical width of a leg; scales widths and spacings."""
MAX_CLUSTER_WIDTH_M = 0.5
"""Widest cluster that `leg_detector` classifies: two legs side by side."""
FEATURE_COUNT = WINDOW_OFFSETS_M.size + 4


@attrs.frozen
class Clusters:
    """The K clusters of a scan in the order of its rays.

    Attributes:
        centre: Mean of the readings in the sensor frame, (K, 2), m.
        count: Number of readings, (K,).
        spacing: Distance between neighbouring rays at the cluster, (K,), m.
        width: Distance from the first to the last reading, (K,), m.
    """

    centre: Array
    count: Indices
    spacing: Array
    width: Array


@attrs.frozen
class Scan:
    """Laser scan in the order of increasing angle.

    Attributes:
        ranges: Ranges, (N,), m; inf for a ray without an echo.
        angle_min: Angle of the first ray, rad.
        angle_increment: Angle between two rays, rad.
    """

    ranges: Array
    angle_min: float
    angle_increment: float

    @classmethod
    def validated(cls, ranges: ArrayLike, angle_min: float, angle_increment: float) -> Scan:
        """Create a scan from the raw values of a scanner.

        Args:
            ranges: Ranges, (rays,), m; NaN, infinite and very small ones are rays without an echo.
            angle_min: Angle of the first ray, rad.
            angle_increment: Angle between two rays, rad; a negative one reverses the order.

        Returns:
            The scan.

        Raises:
            ValueError: A value is malformed; the message names field, value and expectation.
        """
        try:
            found = np.array(ranges, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"ranges is {ranges!r:.60}, expected (rays,) numbers, m") from None
        if found.ndim != 1 or found.size == 0:
            raise ValueError(f"ranges has the shape {found.shape}, expected (rays,), at least one ray")
        if not np.isfinite(angle_min):
            raise ValueError(f"angle_min is {angle_min}, expected a finite angle, rad")
        turn = abs(angle_increment) * (found.size - 1)
        if not 0.0 < abs(angle_increment) < np.inf or turn > 2.0 * np.pi + 1e-3:
            raise ValueError(
                f"angle_increment is {angle_increment}, expected a step other than 0 rad "
                f"with which {found.size} rays make one turn at most"
            )
        if angle_increment < 0.0:
            angle_min, angle_increment = angle_min + angle_increment * (found.size - 1), -angle_increment
            found = found[::-1]
        found[~(np.isfinite(found) & (found > MIN_RANGE_M))] = np.inf
        return cls(found, float(angle_min), float(angle_increment))

    @property
    def is_full_circle(self) -> bool:
        """Whether the last ray is a neighbour of the first."""
        return bool((self.ranges.size + 0.5) * self.angle_increment > 2.0 * np.pi)

    def range_at(self, angles: Array) -> Array:
        """Return the ranges of the rays nearest to given angles.

        Args:
            angles: Angles, any shape, rad.

        Returns:
            Ranges, m; inf without an echo, NaN outside the field of view.
        """
        rays = np.rint((angles - self.angle_min) / self.angle_increment).astype(np.intp)
        rays %= round(2.0 * np.pi / self.angle_increment)
        inside = rays < self.ranges.size
        return np.where(inside, self.ranges[np.where(inside, rays, 0)], np.nan)

    def points(self, rays: Indices) -> Array:
        """Return the end points of rays.

        Args:
            rays: Indices of rays, (n,).

        Returns:
            Points in the sensor frame, (n, 2), m.
        """
        angles = self.angle_min + self.angle_increment * rays
        return self.ranges[rays % self.ranges.size, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def find_clusters(scan: Scan) -> Clusters:
    """Split a scan wherever two neighbouring readings are too far apart.

    Args:
        scan: The scan.

    Returns:
        Its clusters.
    """
    rays = np.flatnonzero(np.isfinite(scan.ranges))
    if rays.size == 0:
        return Clusters(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0), np.zeros(0))
    parted = _starts_cluster(scan, rays)
    if scan.is_full_circle and parted.any():  # start at a gap, so that no cluster spans the ends
        begin = int(np.argmax(parted))
        rays, parted = np.r_[rays[begin:], rays[:begin] + scan.ranges.size], np.roll(parted, -begin)
    parted[0] = True
    first = np.flatnonzero(parted)
    count = np.diff(np.r_[first, rays.size])
    points, reading = scan.points(rays), scan.ranges[rays % scan.ranges.size]
    centre = np.add.reduceat(points, first) / count[:, None]
    width = np.hypot(*(points[first + count - 1] - points[first]).T)
    spacing = scan.angle_increment * np.hypot(*centre.T)
    # Some scanners report their largest range if there is no echo: many rays then share one range.
    greatest = reading == reading.max()
    real = (np.add.reduceat(greatest, first) < count) | (np.count_nonzero(greatest) == 1)
    return Clusters(centre[real], count[real], spacing[real], width[real])


def _starts_cluster(scan: Scan, rays: Indices) -> Bools:
    """Return whether each reading starts a cluster; the last reading precedes the first."""
    reading, points = scan.ranges[rays], scan.points(rays)
    skipped = (rays - np.roll(rays, 1)) % scan.ranges.size
    nearer = np.minimum(reading, np.roll(reading, 1))
    allowed = np.maximum(MIN_GAP_M, MIN_GAP_SPACINGS * scan.angle_increment * nearer)
    distance = np.hypot(*(points - np.roll(points, 1, axis=0)).T)
    return (distance > allowed) | (skipped > 1 + MAX_LOST_RAYS)


def cluster_features(scan: Scan, clusters: Clusters) -> NDArray[np.float32]:
    """Compute the features of each cluster for the leg classifier.

    A window of constant width in metres slides over the scan (Beyer, Hermans, Leibe: DROW, 2017).
    It shows how far behind the cluster's centre each reading lies, from -1 to 1; 1 without an echo.
    Distance, ray spacing, number of readings and width follow.

    Args:
        scan: The scan.
        clusters: Its K clusters.

    Returns:
        Features, (K, FEATURE_COUNT).
    """
    distance = np.hypot(*clusters.centre.T)
    bearing = np.arctan2(clusters.centre[:, 1], clusters.centre[:, 0])
    angle = bearing[:, None] + np.arctan2(WINDOW_OFFSETS_M, distance[:, None])
    reading = np.nan_to_num(scan.range_at(angle), nan=np.inf, posinf=np.inf)
    depth = np.clip((reading - distance[:, None]) / WINDOW_DEPTH_M, -1.0, 1.0)
    scalars = [
        np.log1p(distance),
        clusters.spacing / LEG_WIDTH_M,
        np.log(clusters.count),
        clusters.width / LEG_WIDTH_M,
    ]
    return np.column_stack([depth, *scalars]).astype(np.float32)

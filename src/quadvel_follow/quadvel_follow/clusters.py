"""From a scan to the things that it shows, and what a classifier is given of each.

It knows nothing of networks, tracks or ROS. All things of a scan are worked on at once.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

NEAREST = 0.02  # m, below it a reading is a scanner's way to say that there was none
JUMP = 0.13  # m, from one thing to the next, at least
JUMP_SPACINGS = 1.6  # the same in distances between neighbouring rays, where these are further apart
LOST_RAYS = 3  # rays without a reading that do not part a thing
WINDOW = np.linspace(-0.6, 0.6, 49)  # m to the side of a thing, where the classifier looks
DEPTH = 0.5  # m before and behind a thing, as far as the classifier looks
LEG = 0.12  # m, across a leg, the measure of widths
WIDEST = 0.5  # m, of two legs beside each other
NUMBERS = WINDOW.size + 4


@attrs.frozen
class Clusters:
    """The K things that a scan shows, in the order of its rays.

    centre (K, 2): m, mean of the readings, sensor frame; count (K,): how many readings it has;
    spacing (K,): m between neighbouring rays at its distance; width (K,): m, from its first reading to its last.
    """

    centre: Array
    count: Indices
    spacing: Array
    width: Array


@attrs.frozen
class Scan:
    """Readings in the order of growing angle: range (N,) in m, inf where there is none; the first angle and the step, rad."""

    ranges: Array
    angle_min: float
    angle_increment: float

    @classmethod
    def checked(cls, ranges: ArrayLike, angle_min: float, angle_increment: float) -> Scan:
        """A scan as a scanner gives it. Raises ValueError, with the field, what it is and what was expected."""
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
        found[~(np.isfinite(found) & (found > NEAREST))] = np.inf
        return cls(found, float(angle_min), float(angle_increment))

    @property
    def closed(self) -> bool:
        """Whether the last ray is the first one's neighbour."""
        return bool((self.ranges.size + 0.5) * self.angle_increment > 2.0 * np.pi)

    def at(self, angles: Array) -> Array:
        """The readings nearest to these angles, m; inf where there is none, NaN beyond the scan's ends."""
        rays = np.rint((angles - self.angle_min) / self.angle_increment).astype(np.intp)
        rays %= round(2.0 * np.pi / self.angle_increment)
        inside = rays < self.ranges.size
        return np.where(inside, self.ranges[np.where(inside, rays, 0)], np.nan)

    def points(self, rays: Indices) -> Array:
        """Where these rays end, (n, 2)."""
        angles = self.angle_min + self.angle_increment * rays
        return self.ranges[rays % self.ranges.size, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def find_clusters(scan: Scan) -> Clusters:
    """Cut a scan wherever two readings beside each other lie too far apart."""
    rays = np.flatnonzero(np.isfinite(scan.ranges))
    if rays.size == 0:
        return Clusters(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0), np.zeros(0))
    parted = _parted(scan, rays)
    if scan.closed and parted.any():  # begin at a cut, that the ends of the scan are none
        begin = int(np.argmax(parted))
        rays, parted = np.r_[rays[begin:], rays[:begin] + scan.ranges.size], np.roll(parted, -begin)
    parted[0] = True
    first = np.flatnonzero(parted)
    count = np.diff(np.r_[first, rays.size])
    points, reading = scan.points(rays), scan.ranges[rays % scan.ranges.size]
    centre = np.add.reduceat(points, first) / count[:, None]
    width = np.hypot(*(points[first + count - 1] - points[first]).T)
    spacing = scan.angle_increment * np.hypot(*centre.T)
    # Some scanners say that there was nothing by their greatest range, which many rays then have to the last digit.
    greatest = reading == reading.max()
    real = (np.add.reduceat(greatest, first) < count) | (np.count_nonzero(greatest) == 1)
    return Clusters(centre[real], count[real], spacing[real], width[real])


def _parted(scan: Scan, rays: Indices) -> NDArray[np.bool_]:
    """Whether each reading belongs to another thing than the reading before it; before the first comes the last."""
    reading, points = scan.ranges[rays], scan.points(rays)
    skipped = (rays - np.roll(rays, 1)) % scan.ranges.size
    nearer = np.minimum(reading, np.roll(reading, 1))
    allowed = np.maximum(JUMP, JUMP_SPACINGS * scan.angle_increment * nearer)
    distance = np.hypot(*(points - np.roll(points, 1, axis=0)).T)
    return (distance > allowed) | (skipped > 1 + LOST_RAYS)


def describe(scan: Scan, clusters: Clusters) -> NDArray[np.float32]:
    """What the classifier is given of each thing, (K, NUMBERS): the scan around it, at a scale of metres.

    A window slides over the scan, as wide at every distance (Beyer, Hermans, Leibe: "DROW", 2017), and shows how far
    behind the thing's centre each reading lies, from -1 to 1, 1 where there is none. Then distance, spacing of rays,
    number of readings and width.
    """
    distance = np.hypot(*clusters.centre.T)
    bearing = np.arctan2(clusters.centre[:, 1], clusters.centre[:, 0])
    angle = bearing[:, None] + np.arctan2(WINDOW, distance[:, None])
    reading = np.nan_to_num(scan.at(angle), nan=np.inf, posinf=np.inf)
    depth = np.clip((reading - distance[:, None]) / DEPTH, -1.0, 1.0)
    scalars = [np.log1p(distance), clusters.spacing / LEG, np.log(clusters.count), clusters.width / LEG]
    return np.column_stack([depth, *scalars]).astype(np.float32)

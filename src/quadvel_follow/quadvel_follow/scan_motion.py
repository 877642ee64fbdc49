"""Where a scanner is, by the scans alone, for where nobody knows its pose.

Point-to-line matching (Censi: "An ICP variant using a point-to-line metric", 2008), begun at the rotation in which the
ranges agree best. Not a localisation: what it adds up to drifts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .clusters import Scan
from .looking import to_frame

Array = NDArray[np.float64]

RESTING = 0.7  # share of rays that read the same, from which a scanner has not moved
SAME, SAME_SHARE = 0.06, 0.01  # m, and the share of the range, by which these differ at most
ELSEWHERE = 0.05  # m and rad, from which a scanner is at another place
FEWEST = 30  # readings without which nothing is told
WIDEST_TURN = 0.6  # rad between two scans
POINTS = 240  # readings that are matched, at most
ROUNDS = 12
CORRESPONDING = (1.0, 0.15)  # m, from a point to its partner, in the first round and in the last


class ScanOdometry:
    """Adds up how a scanner moved, each time from the last scan at which it was at another place."""

    def __init__(self) -> None:
        self._pose = np.zeros(3)  # of the scan to which others are matched
        self._scan: Scan | None = None

    def follow(self, scan: Scan) -> Array:
        """Pose x, y (m), yaw (rad) of the scanner in the frame of the first scan."""
        moved = np.zeros(3) if self._scan is None else motion(self._scan, scan)
        pose = np.array([*to_frame(moved[None, :2], self._pose)[0], self._pose[2] + moved[2]])
        if self._scan is None or np.hypot(*moved[:2]) > ELSEWHERE or abs(moved[2]) > ELSEWHERE:
            self._scan, self._pose = scan, pose
        return pose


def motion(before: Scan, now: Scan) -> Array:
    """Pose x, y (m), yaw (rad) of the scanner now in the frame of the scanner before; zeros where it cannot be told."""
    if before.ranges.size != now.ranges.size:
        return np.zeros(3)
    seen = np.isfinite(before.ranges) & np.isfinite(now.ranges)
    change = np.abs(now.ranges[seen] - before.ranges[seen])
    if seen.sum() < FEWEST or np.mean(change < SAME + SAME_SHARE * now.ranges[seen]) > RESTING:
        return np.zeros(3)
    return _matched(before, now, np.array([0.0, 0.0, _turn(before, now)]))


def _turn(before: Scan, now: Scan) -> float:
    """The rotation, rad, in whole rays, that makes the ranges most alike."""
    most = min(int(WIDEST_TURN / now.angle_increment), now.ranges.size // 3)
    step = max(1, most // 50)
    old, new = (np.minimum(scan.ranges, 20.0) for scan in (before, now))
    shifts = np.arange(-most, most + 1, step)
    inner = np.arange(most, new.size - most, max(1, new.size // 300))
    difference = np.minimum(np.abs(new[inner] - old[inner + shifts[:, None]]), 0.5).mean(1)
    return float(shifts[int(difference.argmin())] * now.angle_increment)


def _matched(before: Scan, now: Scan, pose: Array) -> Array:
    target, normal = _surfaces(before)
    points = now.points(np.flatnonzero(np.isfinite(now.ranges)))
    points = points[:: max(1, len(points) // POINTS)]
    if len(target) < FEWEST or len(points) < FEWEST:
        return np.zeros(3)
    tree = cKDTree(target)
    for reach in np.geomspace(*CORRESPONDING, ROUNDS):
        placed = to_frame(points, pose)
        distance, partner = tree.query(placed, distance_upper_bound=reach)
        used = np.isfinite(distance)
        if used.sum() < FEWEST // 2:
            return np.zeros(3)
        q, n, p = target[partner[used]], normal[partner[used]], placed[used]
        lever = n[:, 1] * (p[:, 0] - pose[0]) - n[:, 0] * (p[:, 1] - pose[1])
        jacobian = np.column_stack([n, lever])
        error = ((q - p) * n).sum(1)
        weight = 1.0 / (1.0 + (error / 0.05) ** 2)
        normal_matrix = jacobian.T @ (weight[:, None] * jacobian) + 1e-3 * np.eye(3)
        change = np.linalg.solve(normal_matrix, jacobian.T @ (weight * error))
        pose = pose + change
    return pose


def _surfaces(scan: Scan) -> tuple[Array, Array]:
    """Points (n, 2) on surfaces and the normals there, of neighbouring readings that belong to one thing."""
    rays = np.flatnonzero(np.isfinite(scan.ranges))
    points = scan.points(rays)
    along = points[2:] - points[:-2]
    length = np.hypot(*along.T)
    smooth = (length > 1e-6) & (length < 0.08 + 4.0 * scan.angle_increment * scan.ranges[rays[1:-1]])
    normal = np.column_stack([-along[:, 1], along[:, 0]])[smooth] / length[smooth, None]
    return points[1:-1][smooth], normal

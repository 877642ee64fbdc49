"""Scan-matching odometry: motion of a scanner from its scans alone; it drifts.

Point-to-line matching (A. Censi, An ICP variant using a point-to-line metric, 2008) that starts at
the rotation in which the ranges agree best.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from quadvel_description.arrays import Array

from .clusters import Scan
from .free_space import to_frame

RESTING_SHARE = 0.7
"""Share of rays with unchanged ranges from which the scanner rests."""
SAME_RANGE_M, SAME_RANGE_SHARE = 0.06, 0.01
"""Largest change of an unchanged range: constant and proportional part."""
KEYFRAME_DISTANCE = 0.05
"""Motion (m, rad) from which a scan becomes the next keyframe."""
MIN_READINGS = 30
"""Smallest number of readings for an estimate."""
MAX_TURN_RAD = 0.6
"""Largest rotation between two scans."""
MAX_POINTS = 240
"""Largest number of matched readings."""
ITERATIONS = 12
"""Number of matching and alignment steps for one scan."""
MATCH_DISTANCES_M = (1.0, 0.15)
"""Largest distance of matched points in the first and in the last iteration."""


class ScanOdometry:
    """Accumulates the motion of a scanner between keyframes."""

    def __init__(self) -> None:
        self._pose = np.zeros(3)  # of the scan to which others are matched
        self._scan: Scan | None = None

    def update(self, scan: Scan) -> Array:
        """Estimate the pose of a scan.

        Args:
            scan: The scan.

        Returns:
            Pose in the frame of the first scan, (3,): x, y in m, yaw in rad.
        """
        moved = np.zeros(3) if self._scan is None else estimate_motion(self._scan, scan)
        pose = np.array([*to_frame(moved[None, :2], self._pose)[0], self._pose[2] + moved[2]])
        if (
            self._scan is None
            or np.hypot(*moved[:2]) > KEYFRAME_DISTANCE
            or abs(moved[2]) > KEYFRAME_DISTANCE
        ):
            self._scan, self._pose = scan, pose
        return pose


def estimate_motion(before: Scan, now: Scan) -> Array:
    """Estimate the motion between two scans.

    Args:
        before: Earlier scan.
        now: Later scan.

    Returns:
        Pose of the scanner at `now` in its frame at `before`, (3,): x, y in m, yaw in rad; zeros if
        unknown.
    """
    if before.ranges.size != now.ranges.size:
        return np.zeros(3)
    seen = np.isfinite(before.ranges) & np.isfinite(now.ranges)
    change = np.abs(now.ranges[seen] - before.ranges[seen])
    if (
        seen.sum() < MIN_READINGS
        or np.mean(change < SAME_RANGE_M + SAME_RANGE_SHARE * now.ranges[seen]) > RESTING_SHARE
    ):
        return np.zeros(3)
    return _match_scans(before, now, np.array([0.0, 0.0, _estimate_rotation(before, now)]))


def _estimate_rotation(before: Scan, now: Scan) -> float:
    """Return the rotation in rad, in whole rays, for which the ranges agree best."""
    most = min(int(MAX_TURN_RAD / now.angle_increment), now.ranges.size // 3)
    step = max(1, most // 50)
    old, new = (np.minimum(scan.ranges, 20.0) for scan in (before, now))
    shifts = np.arange(-most, most + 1, step)
    inner = np.arange(most, new.size - most, max(1, new.size // 300))
    difference = np.minimum(np.abs(new[inner] - old[inner + shifts[:, None]]), 0.5).mean(1)
    return float(shifts[int(difference.argmin())] * now.angle_increment)


def _match_scans(before: Scan, now: Scan, pose: Array) -> Array:
    """Return the motion from point-to-line ICP."""
    target, normal = _surface_points(before)
    points = now.points(np.flatnonzero(np.isfinite(now.ranges)))
    points = points[:: max(1, len(points) // MAX_POINTS)]
    if len(target) < MIN_READINGS or len(points) < MIN_READINGS:
        return np.zeros(3)
    tree = cKDTree(target)
    for reach in np.geomspace(*MATCH_DISTANCES_M, ITERATIONS):
        placed = to_frame(points, pose)
        distance, partner = tree.query(placed, distance_upper_bound=reach)
        used = np.isfinite(distance)
        if used.sum() < MIN_READINGS // 2:
            return np.zeros(3)
        # Gauss-Newton step for sum of w (n.(q - p))^2 with Cauchy weights w; the derivative of a
        # point with respect to (x, y, yaw) along its normal is (n_x, n_y, n x lever).
        q, n, p = target[partner[used]], normal[partner[used]], placed[used]
        lever = n[:, 1] * (p[:, 0] - pose[0]) - n[:, 0] * (p[:, 1] - pose[1])
        jacobian = np.column_stack([n, lever])
        error = ((q - p) * n).sum(1)
        weight = 1.0 / (1.0 + (error / 0.05) ** 2)
        normal_matrix = jacobian.T @ (weight[:, None] * jacobian) + 1e-3 * np.eye(3)
        change = np.linalg.solve(normal_matrix, jacobian.T @ (weight * error))
        pose = pose + change
    return pose


def _surface_points(scan: Scan) -> tuple[Array, Array]:
    """Return points on surfaces, (n, 2), and their normals, (n, 2)."""
    rays = np.flatnonzero(np.isfinite(scan.ranges))
    points = scan.points(rays)
    along = points[2:] - points[:-2]
    length = np.hypot(*along.T)
    smooth = (length > 1e-6) & (length < 0.08 + 4.0 * scan.angle_increment * scan.ranges[rays[1:-1]])
    normal = np.column_stack([-along[:, 1], along[:, 0]])[smooth] / length[smooth, None]
    return points[1:-1][smooth], normal

"""Selection of the followed person among the tracks, and its re-identification after a loss.

`person_tracker` makes the tracks; the planner follows the selected one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .person_tracker import Track

AHEAD_ANGLE_RAD = np.deg2rad(60.0)
"""Largest bearing to either side of a person ahead."""
REIDENTIFY_DISTANCE_M = 1.5
"""Largest distance from the place of a loss at which a person counts as the same."""
REIDENTIFY_TIME_S = 10.0
"""Time after a loss in which the person can be identified again."""


class Selection:
    """Selected person. Until `select` is called it may be the nearest person ahead."""

    def __init__(self, nearest_at_first: bool = True) -> None:
        """Create a selection.

        Args:
            nearest_at_first: Whether the nearest person ahead is selected at first.
        """
        self._selects_nearest = nearest_at_first
        self._id: int | None = None
        self._last_seen: tuple[float, np.ndarray] | None = None  # time and place of its last track

    def nearest(self, tracks: Sequence[Track], pose: Sequence[float]) -> Track | None:
        """Find the nearest person ahead of the robot.

        Args:
            tracks: Tracks.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad.

        Returns:
            Nearest confirmed person, else the nearest candidate; None if no person is ahead.
        """
        off = [track.position - np.asarray(pose[:2]) for track in tracks]
        bearing = [abs((np.arctan2(o[1], o[0]) - pose[2] + np.pi) % (2.0 * np.pi) - np.pi) for o in off]
        ahead = [
            (not t.confirmed, float(np.hypot(*o)), t)
            for t, o, b in zip(tracks, off, bearing, strict=True)
            if b < AHEAD_ANGLE_RAD
        ]
        return min(ahead, key=lambda entry: entry[:2])[2] if ahead else None

    def select(self, identity: int, tracks: Sequence[Track], pose: Sequence[float]) -> Track:
        """Select a person.

        Args:
            identity: Id of a track; 0: the nearest person ahead.
            tracks: Tracks.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad.

        Returns:
            Track of the person.

        Raises:
            ValueError: There is no such track.
        """
        if identity == 0:
            found = self.nearest(tracks, pose)
            if found is None:
                raise ValueError("no person is ahead; expected a person within 60 degrees of its heading")
        else:
            found = next((track for track in tracks if track.id == identity), None)
            if found is None:
                known = ", ".join(str(track.id) for track in tracks) or "none"
                raise ValueError(f"id is {identity}, expected one that is tracked: {known}")
        self._selects_nearest, self._id, self._last_seen = False, found.id, None
        return found

    def update(self, time: float, tracks: Sequence[Track], pose: Sequence[float]) -> Track | None:
        """Find the selected person in the tracks of a scan.

        Args:
            time: Time of the scan, s.
            tracks: Tracks.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad.

        Returns:
            Track of the selected person, or None.
        """
        if self._selects_nearest and (found := self.nearest([t for t in tracks if t.confirmed], pose)):
            self._selects_nearest, self._id = False, found.id
        track = next((t for t in tracks if t.id == self._id), None)
        if track is None and self._last_seen is not None and time - self._last_seen[0] < REIDENTIFY_TIME_S:
            place = self._last_seen[1]
            near = [
                t for t in tracks if t.confirmed and np.hypot(*(t.position - place)) < REIDENTIFY_DISTANCE_M
            ]
            track = min(near, key=lambda t: float(np.hypot(*(t.position - place))), default=None)
        if track is not None:
            self._id, self._last_seen = track.id, (time, track.position)
        return track

"""Which of the tracked persons is meant: the one that was asked for, for as long as it is tracked, and when it is found again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .person_tracker import Track

AHEAD = np.deg2rad(60.0)  # to the left and to the right, what is ahead
AGAIN = 1.5  # m, from where a person was lost to where it is taken to be the same
WAIT = 10.0  # s, for which that is looked for


class Selection:
    """The person who is meant. Until somebody is asked for, it may be the nearest ahead."""

    def __init__(self, nearest_at_first: bool = True) -> None:
        self._open = nearest_at_first
        self._id: int | None = None
        self._lost: tuple[float, np.ndarray] | None = None  # when and where it was, if it is tracked no more

    def nearest(self, tracks: Sequence[Track], pose: Sequence[float]) -> Track | None:
        """Ahead of the robot's pose x, y, yaw: a confirmed person, or else what may become one."""
        off = [track.position - np.asarray(pose[:2]) for track in tracks]
        bearing = [abs((np.arctan2(o[1], o[0]) - pose[2] + np.pi) % (2.0 * np.pi) - np.pi) for o in off]
        ahead = [
            (not t.confirmed, float(np.hypot(*o)), t)
            for t, o, b in zip(tracks, off, bearing, strict=True)
            if b < AHEAD
        ]
        return min(ahead, key=lambda entry: entry[:2])[2] if ahead else None

    def select(self, identity: int, tracks: Sequence[Track], pose: Sequence[float]) -> Track:
        """The track with this id, or for 0 the nearest ahead. Raises ValueError where there is none."""
        if identity == 0:
            found = self.nearest(tracks, pose)
            if found is None:
                raise ValueError(
                    "nobody is ahead; expected a person within 60 degrees of where the robot looks"
                )
        else:
            found = next((track for track in tracks if track.id == identity), None)
            if found is None:
                known = ", ".join(str(track.id) for track in tracks) or "nobody"
                raise ValueError(f"id is {identity}, expected one that is tracked: {known}")
        self._open, self._id, self._lost = False, found.id, None
        return found

    def update(self, time: float, tracks: Sequence[Track], pose: Sequence[float]) -> Track | None:
        """The person's track in these of a scan, or None."""
        if self._open and (found := self.nearest([t for t in tracks if t.confirmed], pose)):
            self._open, self._id = False, found.id
        track = next((t for t in tracks if t.id == self._id), None)
        if track is None and self._lost is not None and time - self._lost[0] < WAIT:
            place = self._lost[1]
            near = [t for t in tracks if t.confirmed and np.hypot(*(t.position - place)) < AGAIN]
            track = min(near, key=lambda t: float(np.hypot(*(t.position - place))), default=None)
        if track is not None:
            self._id, self._lost = track.id, (time, track.position)
        return track

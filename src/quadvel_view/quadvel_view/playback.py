"""A recording as a film: play, pause, pace, and any moment of it as a picture. No ROS, no page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_recordings.reading import RecordingError, unread_messages

from .picture import LOW_STATE, TOPICS, RobotPicture

PACES = (0.25, 4.0)  # slowest and fastest
ALL = "/diagnostics"
"""Of this topic each message counts, as each node has its own; of all others the newest"""
AGO = 20.0  # s before a moment from which the way behind the robot is shown
BEHIND = 200  # messages of that way that are looked at


@attrs.frozen
class _Track:
    """The messages of one topic: when they came, s since the first of all, and what reads each."""

    times: NDArray[np.float64]
    messages: list[Callable[[], Any]]

    def between(self, after: float, until: float) -> list[Callable[[], Any]]:
        first, last = np.searchsorted(self.times, (after, until), side="right")
        return self.messages[first:last]


class Playback:
    """Begins at the first message, and plays. picture: that moment.

    Raises RecordingError for what is no recording of a robot, and OSError where there is no such file.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._tracks = _load(path)
        self.length = max(float(track.times[-1]) for track in self._tracks.values())
        self.picture = RobotPicture()
        self.playing, self.pace, self.time = True, 1.0, 0.0
        self.seek(0.0)

    def advance(self, elapsed: float) -> None:
        """So many seconds have passed for who watches."""
        if not self.playing:
            return
        before, self.time = self.time, min(self.time + self.pace * elapsed, self.length)
        self._take_between(before, self.time)
        self.playing = self.time < self.length

    def toggle(self) -> None:
        """Play, from the beginning where it was at its end, or pause."""
        if not self.playing and self.time >= self.length:
            self.seek(0.0)
        self.playing = not self.playing

    def seek(self, time: float) -> None:
        """Go to a moment, s since the beginning; beyond either end to that end."""
        self.time = min(max(time, 0.0), self.length)
        self.picture.forget_the_past()
        if "/odom" in self._tracks:
            behind = self._tracks["/odom"].between(self.time - AGO, self.time)
            for message in behind[:: max(1, len(behind) // BEHIND)]:
                self.picture.read("/odom", message, self.time)
        self._take_between(-np.inf, self.time)

    def set_pace(self, pace: float) -> None:
        """How fast time passes, held to PACES."""
        self.pace = min(max(pace, PACES[0]), PACES[1])

    def words(self) -> dict[str, Any]:
        """What the page is told of it."""
        return {
            "name": self.name,
            "time": round(self.time, 3),
            "length": round(self.length, 3),
            "playing": self.playing,
            "pace": self.pace,
        }

    def _take_between(self, after: float, until: float) -> None:
        for topic, track in self._tracks.items():
            came = track.between(max(after, until - 3.0) if topic == ALL else after, until)
            for message in came if topic == ALL else came[-1:]:
                self.picture.read(topic, message, until)


def _load(path: Path) -> dict[str, _Track]:
    known = {**TOPICS, LOW_STATE: "quadvel_msgs/msg/LowState"}
    found: dict[str, list[tuple[int, Callable[[], Any]]]] = {}
    for topic, time, message in unread_messages(path, lambda topic, kind: known.get(topic) == kind):
        found.setdefault(topic, []).append((time, message))
    if not found.keys() & {"/joint_states", LOW_STATE}:
        raise RecordingError(f"{path}: no robot in it: neither joint_states nor low_state were recorded")
    begin = min(came[0][0] for came in found.values())
    return {
        topic: _Track(np.array([1e-9 * (time - begin) for time, _ in came]), [message for _, message in came])
        for topic, came in found.items()
    }

"""Playback of a recording: play, pause, speed, and the picture at any time. No ROS, no page.

`replay` connects it to the page, and `picture` keeps the state of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.robot import robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_recordings.reading import RecordingError, lazy_messages, recorded_description

from .picture import LOW_STATE, TOPICS, RobotPicture

PACE_RANGE = (0.25, 4.0)
"""Smallest and largest playback speed."""
PER_NODE_TOPIC = "/diagnostics"
"""Topic whose messages are all applied, one per node; of other topics only the newest is."""
TRAIL_DURATION_S = 20.0
"""Duration of the trail before the present time."""
MAX_TRAIL_MESSAGES = 200
"""Largest number of messages from which the trail is built."""


@attrs.frozen
class _Track:
    """The messages of one topic.

    Attributes:
        times: (n,), s since the first message of the recording.
        messages: Functions that deserialise them.
    """

    times: Array
    messages: list[Callable[[], Any]]

    def between(self, after: float, until: float) -> list[Callable[[], Any]]:
        """Return the messages in the interval (after, until], s."""
        first, last = np.searchsorted(self.times, (after, until), side="right")
        return self.messages[first:last]


class Playback:
    """A recording that plays from its start.

    Args:
        path: The recording.
        robot: Name or file of the robot; None for the one that the recording names.

    Attributes:
        name: Name of the file.
        length: Duration, s.
        picture: The state of the robot at `time`.
        playing: Whether it plays.
        pace: Playback speed, multiple of real time.
        time: Present time, s since the start.

    Raises:
        RecordingError: The file is not a recording of a robot. OSError for a missing file, and
            ValueError for one of another robot, pass through.
    """

    def __init__(self, path: Path, robot: str | None = None) -> None:
        self.name = path.name
        self._tracks = _load(path)
        self.length = max(float(track.times[-1]) for track in self._tracks.values())
        named = described_robot(recorded_description(path))
        self.picture = RobotPicture(robot_of_file(path, named, robot))
        self.playing, self.pace, self.time = True, 1.0, 0.0
        self.seek(0.0)

    def advance(self, elapsed: float) -> None:
        """Advance by a step of real time.

        Args:
            elapsed: s.
        """
        if not self.playing:
            return
        before, self.time = self.time, min(self.time + self.pace * elapsed, self.length)
        self._apply_between(before, self.time)
        self.playing = self.time < self.length

    def toggle(self) -> None:
        """Toggle play and pause; at the end it plays again from the start."""
        if not self.playing and self.time >= self.length:
            self.seek(0.0)
        self.playing = not self.playing

    def seek(self, time: float) -> None:
        """Jump to a time, limited to the recording.

        Args:
            time: s since the start.
        """
        self.time = min(max(time, 0.0), self.length)
        self.picture.clear_history()
        if "/odom" in self._tracks:
            behind = self._tracks["/odom"].between(self.time - TRAIL_DURATION_S, self.time)
            for message in behind[:: max(1, math.ceil(len(behind) / MAX_TRAIL_MESSAGES))]:
                self.picture.update_lazily("/odom", message, self.time)
        self._apply_between(-np.inf, self.time)

    def set_pace(self, pace: float) -> None:
        """Set the playback speed, limited to PACE_RANGE.

        Args:
            pace: Multiple of real time.
        """
        self.pace = min(max(pace, PACE_RANGE[0]), PACE_RANGE[1])

    def status(self) -> dict[str, Any]:
        """Return the state of the playback for the page.

        Returns:
            Name, times and speed for JSON.
        """
        return {
            "name": self.name,
            "time": round(self.time, 3),
            "length": round(self.length, 3),
            "playing": self.playing,
            "pace": self.pace,
        }

    def _apply_between(self, after: float, until: float) -> None:
        """Apply the messages of an interval to the picture."""
        for topic, track in self._tracks.items():
            came = track.between(max(after, until - 3.0) if topic == PER_NODE_TOPIC else after, until)
            for message in came if topic == PER_NODE_TOPIC else came[-1:]:
                self.picture.update_lazily(topic, message, until)


def _load(path: Path) -> dict[str, _Track]:
    """Index the messages of a recording by topic."""
    known = {**TOPICS, LOW_STATE: "quadvel_msgs/msg/LowState"}
    found: dict[str, list[tuple[int, Callable[[], Any]]]] = {}
    for topic, time, message in lazy_messages(path, lambda topic, kind: known.get(topic) == kind):
        found.setdefault(topic, []).append((time, message))
    if not found.keys() & {"/joint_states", LOW_STATE}:
        raise RecordingError(f"{path}: not a recording of a robot: it has no joint_states and no low_state")
    begin = min(came[0][0] for came in found.values())
    return {
        topic: _Track(np.array([1e-9 * (time - begin) for time, _ in came]), [message for _, message in came])
        for topic, came in found.items()
    }

"""Reads a recorded run of the nodes into arrays, for `summary.json`, figures and video.

The input is an MCAP file of `quadvel record` or of the demo. Times are s on the system clock.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import read_messages

SIMULATOR_NODES = ("sim_node", "board")  # nodes that report the realtime factor
TOPICS = (
    "/cmd_vel",
    "/command",
    "/controller/state",
    "/diagnostics",
    "/ground_truth/odom",
    "/joint_states",
    "/low_cmd",
    "/low_state",
    "/velocity_estimate",
)


@attrs.frozen(eq=False)
class Series:
    """Values (n, k) at times (n,), s."""

    time: Array
    value: Array

    def latest_at(self, time: Array) -> Array:
        """Return the newest value at each time (zero-order hold).

        Args:
            time: Times (m,), s.

        Returns:
            Values (m, k); the first value before its time.
        """
        return self.value[np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)]


@attrs.frozen(eq=False)
class ControllerTrace:
    """Reports of the controller.

    Attributes:
        time: Times (n,), s.
        mode: Names of the modes.
        figures: Fields LOOP_FIGURES of each quadvel_msgs/ControllerState.
    """

    time: Array
    mode: list[str]
    figures: list[dict[str, float]]


@attrs.frozen(eq=False)
class Recording:
    """One run of the nodes.

    Attributes:
        planned: vx, vy (m/s), wz (rad/s) of the planner, by time of receipt.
        commanded: vx, vy (m/s), wz (rad/s) after the mux.
        position: Position of the trunk (n, 3), m, world frame.
        quaternion: Orientation of the trunk (n, 4), w, x, y, z.
        velocity: True vx, vy, vz (m/s), wx, wy, wz (rad/s), body frame, (n, 6).
        estimate: Estimated vx, vy, vz (n, 3), m/s, body frame.
        joints: Joint angles (n, 12), rad.
        loop: Reports of the controller.
        answer_time: Time from a state to the command that answers it (n, 1), s.
        realtime_factor: Realtime factor of the simulator (n, 1), once a second.
    """

    planned: Series
    commanded: Series
    position: Series
    quaternion: Series
    velocity: Series
    estimate: Series
    joints: Series
    loop: ControllerTrace
    answer_time: Series
    realtime_factor: Series


LOOP_FIGURES = (
    "rate_hz",
    "period_p99_ms",
    "inference_p50_us",
    "compute_p50_us",
    "compute_p99_us",
    "overruns",
)


def read_recording(path: Path) -> Recording:
    """Read a recording.

    Args:
        path: MCAP file.

    Returns:
        The arrays.

    Raises:
        ValueError: A required topic is missing.
    """
    messages: dict[str, list[tuple[float, Any]]] = defaultdict(list)
    for topic, arrival, message in read_messages(path, lambda topic, _: topic in TOPICS):
        messages[topic].append((1e-9 * arrival, message))
    for topic in TOPICS:
        if topic not in messages:
            raise ValueError(f"{path}: nothing was recorded on {topic}")
    truth = messages["/ground_truth/odom"]
    return Recording(
        planned=_by_arrival(messages["/cmd_vel"], planar),
        commanded=_by_stamp(messages["/command"], lambda m: planar(m.twist), lambda m: m.stamp),
        position=_by_stamp(truth, lambda m: _xyz(m.pose.pose.position)),
        quaternion=_by_stamp(truth, lambda m: [m.pose.pose.orientation.w, *_xyz(m.pose.pose.orientation)]),
        velocity=_by_stamp(truth, lambda m: [*_xyz(m.twist.twist.linear), *_xyz(m.twist.twist.angular)]),
        estimate=_by_stamp(messages["/velocity_estimate"], lambda m: _xyz(m.twist.twist.linear)),
        joints=_by_stamp(messages["/joint_states"], lambda m: m.position),
        loop=_loop([message for _, message in messages["/controller/state"]]),
        answer_time=_answer_time(messages["/low_state"], messages["/low_cmd"]),
        realtime_factor=_by_arrival(
            [entry for entry in messages["/diagnostics"] if entry[1].status[0].name in SIMULATOR_NODES],
            lambda m: [float(next(v.value for v in m.status[0].values if v.key == "realtime_factor"))],
        ),
    )


def _by_stamp(
    entries: Iterable[tuple[float, Any]],
    value: Callable[[Any], Any],
    stamp: Callable[[Any], Any] = lambda message: message.header.stamp,
) -> Series:
    """Series of values at the stamps of the messages."""
    return _series([(seconds(stamp(message)), value(message)) for _, message in entries])


def _by_arrival(entries: Iterable[tuple[float, Any]], value: Callable[[Any], Any]) -> Series:
    """Series of values at the times of receipt."""
    return _series([(time, value(message)) for time, message in entries])


def _series(pairs: list[tuple[float, Any]]) -> Series:
    """Series of pairs of time and value, sorted by time."""
    pairs.sort(key=lambda pair: pair[0])
    return Series(np.array([time for time, _ in pairs]), np.array([value for _, value in pairs], float))


def _loop(messages: list[Any]) -> ControllerTrace:
    """Trace of the controller's reports."""
    return ControllerTrace(
        np.array([seconds(m.stamp) for m in messages]),
        [m.mode_name for m in messages],
        [{name: float(getattr(m, name)) for name in LOOP_FIGURES} for m in messages],
    )


def _answer_time(states: list[tuple[float, Any]], commands: list[tuple[float, Any]]) -> Series:
    """Time from each state to its command, matched by tick."""
    state_times = {message.tick: seconds(message.stamp) for _, message in states}
    sent = [(state_times[m.tick], seconds(m.stamp)) for _, m in commands if m.tick in state_times]
    return _series([(state, [command - state]) for state, command in sent])


def _xyz(vector: Any) -> list[float]:
    """Components of a vector message."""
    return [vector.x, vector.y, vector.z]


def planar(twist: Any) -> list[float]:
    """Return the planar velocity of a twist.

    Args:
        twist: A geometry_msgs/Twist.

    Returns:
        vx, vy (m/s), wz (rad/s).
    """
    return [twist.linear.x, twist.linear.y, twist.angular.z]

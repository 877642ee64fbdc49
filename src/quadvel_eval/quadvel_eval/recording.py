"""A recorded walk of the nodes, as arrays: what `summary.json`, plots and video are made from.

Reads the MCAP file that `quadvel record` and the demo write. Times are s on the system clock.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import read_messages

Array = NDArray[np.float64]

SIMULATIONS = ("sim_node", "board")  # who says how well real time was kept
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
    """Values (n, k) at the times (n,), s."""

    time: Array
    value: Array

    def at(self, time: Array) -> Array:
        """The newest value at each of the times (m,), or the first one: (m, k)."""
        return self.value[np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)]


@attrs.frozen(eq=False)
class Loop:
    """What the controller said about itself, at the times (n,)."""

    time: Array
    mode: list[str]
    figures: list[dict[str, float]]  # as in quadvel_msgs/ControllerState


@attrs.frozen(eq=False)
class Recording:
    """One run of the nodes."""

    planned: Series  # vx, vy, wz that the planner sent, when it came
    commanded: Series  # vx, vy, wz that the mux passed on
    position: Series  # m, trunk, world
    quaternion: Series  # w, x, y, z
    velocity: Series  # vx, vy, vz, wx, wy, wz, true, body frame
    estimate: Series  # vx, vy, vz
    joints: Series  # q (12,) rad
    loop: Loop
    answer_time: Series  # from the instant of a state to the command that answers it, s
    realtime_factor: Series  # of the simulator, once a second


LOOP_FIGURES = (
    "rate_hz",
    "period_p99_ms",
    "inference_p50_us",
    "compute_p50_us",
    "compute_p99_us",
    "overruns",
)


def read_recording(path: Path) -> Recording:
    """Raises ValueError, one sentence, where a topic that is needed was not recorded."""
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
            [entry for entry in messages["/diagnostics"] if entry[1].status[0].name in SIMULATIONS],
            lambda m: [float(next(v.value for v in m.status[0].values if v.key == "realtime_factor"))],
        ),
    )


def _by_stamp(
    entries: Iterable[tuple[float, Any]],
    value: Callable[[Any], Any],
    stamp: Callable[[Any], Any] = lambda message: message.header.stamp,
) -> Series:
    return _series([(seconds(stamp(message)), value(message)) for _, message in entries])


def _by_arrival(entries: Iterable[tuple[float, Any]], value: Callable[[Any], Any]) -> Series:
    return _series([(time, value(message)) for time, message in entries])


def _series(pairs: list[tuple[float, Any]]) -> Series:
    pairs.sort(key=lambda pair: pair[0])
    return Series(np.array([time for time, _ in pairs]), np.array([value for _, value in pairs], float))


def _loop(messages: list[Any]) -> Loop:
    return Loop(
        np.array([seconds(m.stamp) for m in messages]),
        [m.mode_name for m in messages],
        [{name: float(getattr(m, name)) for name in LOOP_FIGURES} for m in messages],
    )


def _answer_time(states: list[tuple[float, Any]], commands: list[tuple[float, Any]]) -> Series:
    held = {message.tick: seconds(message.stamp) for _, message in states}
    sent = [(held[m.tick], seconds(m.stamp)) for _, m in commands if m.tick in held]
    return _series([(state, [command - state]) for state, command in sent])


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def planar(twist: Any) -> list[float]:
    """vx, vy (m/s), wz (rad/s) of a geometry_msgs/Twist."""
    return [twist.linear.x, twist.linear.y, twist.angular.z]

"""Reads a recorded walk behind a person as the samples of `following.tour`."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.arrays import Array
from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, State
from quadvel_follow.planar import planar_pose, planar_twist
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import RecordingError, read_messages
from quadvel_sim.world import World

from .obstacles import Clearances
from .tour import AVERAGING_TIME_S, Outcome, TourSample

REQUIRED_TOPICS = (
    "/command",
    "/controller/state",
    "/ground_truth/odom",
    "/ground_truth/persons",
    "/follow_planner/state",
)
"""Required topics; /diagnostics, with the contacts, is optional."""
DIAGNOSTICS_TOPIC = "/diagnostics"
FALLEN_MODES = ("fault", "passive")


def read_following(path: Path, world: World) -> tuple[Outcome, list[TourSample]]:
    """Read a recording from the start of following on.

    Args:
        path: The recording.
        world: World of the run.

    Returns:
        Outcome and samples, one per planner period.

    Raises:
        RecordingError: A topic is missing, or the robot never followed.
    """
    messages: dict[str, list[tuple[float, Any]]] = defaultdict(list)
    for topic, arrival, message in read_messages(
        path, lambda topic, _: topic in (*REQUIRED_TOPICS, DIAGNOSTICS_TOPIC)
    ):
        messages[topic].append((1e-9 * arrival, message))
    for topic in REQUIRED_TOPICS:
        if topic not in messages:
            raise RecordingError(f"{path}: nothing was recorded on {topic}")
    begins = next(
        (at for at, m in messages["/follow_planner/state"] if _state(m)[0] is State.FOLLOWING), None
    )
    if begins is None:
        raise RecordingError(f"{path}: the robot never began to follow")
    samples = _samples(messages, begins, world)
    steps = np.diff([one.pose[:2] for one in samples], axis=0)
    outcome = Outcome(
        world=world.name,
        seed=world.seed,
        distance=FollowConfig().distance,
        walked=float(np.hypot(*steps.T).sum()),
        fell=any(m.mode_name in FALLEN_MODES for at, m in messages["/controller/state"] if at >= begins),
        touched=_last_touched([m for _, m in messages[DIAGNOSTICS_TOPIC]]),
    )
    return outcome, samples


def _samples(messages: dict[str, list[tuple[float, Any]]], begins: float, world: World) -> list[TourSample]:
    """Samples of the run, one per planner period."""
    truth, clearances = messages["/ground_truth/odom"], Clearances(world, FollowConfig())
    time = np.array([seconds(m.header.stamp) for _, m in truth])
    poses = np.array([planar_pose(m.pose.pose) for _, m in truth])
    twists = np.array([planar_twist(m.twist.twist) for _, m in truth])
    velocity = _low_passed(time, twists)
    command_times = np.array([seconds(m.stamp) for _, m in messages["/command"]])
    commanded = np.array([planar_twist(m.twist) for _, m in messages["/command"]])
    commanded = _low_passed(time, commanded[_newest(command_times, time)])
    people_messages = messages["/ground_truth/persons"]
    people_times = np.array([seconds(m.header.stamp) for _, m in people_messages])
    state_times = np.array([at for at, _ in messages["/follow_planner/state"]])
    found = []
    for now in np.arange(max(begins, time[0]), time[-1], PERIOD_S):
        i = int(_newest(time, now))
        people = np.array(
            [planar_pose(pose) for pose in people_messages[int(_newest(people_times, now))][1].poses]
        )
        state, words = _state(messages["/follow_planner/state"][int(_newest(state_times, now))][1])
        here, near = poses[i], clearances.to_obstacles(poses[i])
        gap = clearances.to_people(here, people)
        found.append(
            TourSample(float(now), here, people[0], commanded[i], velocity[i], state, words, near, gap)
        )
    return found


def _newest(times: Array, now: Any) -> Any:
    """Index of the newest of `times` at `now`; 0 before the first."""
    return np.maximum(np.searchsorted(times, now, side="right") - 1, 0)


def _low_passed(time: Array, values: Array) -> Array:
    """First-order low-pass of values (n, k) at times (n,) s, with time constant AVERAGING_TIME_S."""
    found = np.array(values, float)
    # y_i = y_{i-1} + min(1, dt / T) (x_i - y_{i-1}).
    for i in range(1, len(found)):
        share = min(1.0, (time[i] - time[i - 1]) / AVERAGING_TIME_S)
        found[i] = found[i - 1] + share * (values[i] - found[i - 1])
    return found


def _state(message: Any) -> tuple[State, str]:
    """State and explanation in a message of the planner."""
    state, words = message.data.split(": ", maxsplit=1)
    return State(state), words


def _last_touched(diagnostics: list[Any]) -> dict[str, int]:
    """Contacts in the simulator's last diagnostics, "name count, name count" or "nothing"."""
    reports = [v.value for m in diagnostics for s in m.status for v in s.values if v.key == "touched"]
    if not reports or reports[-1] == "nothing":
        return {}
    pairs = (one.rsplit(" ", 1) for one in reports[-1].split(", "))
    return {name: int(count) for name, count in pairs}

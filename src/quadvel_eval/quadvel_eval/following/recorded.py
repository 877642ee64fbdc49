"""A recorded walk after a person, of nodes in real time, as the moments that `tour` judges."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_follow.follow_planner import PERIOD_S, FollowConfig, State
from quadvel_follow.planar import planar_pose, planar_twist
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import RecordingError, read_messages
from quadvel_sim.world import World

from .obstacles import Clearances
from .tour import STRIDE, Moment, Outcome

Array = NDArray[np.float64]

TOPICS = (
    "/command",
    "/controller/state",
    "/ground_truth/odom",
    "/ground_truth/persons",
    "/follow_planner/state",
)
"""Without which nothing can be judged; /diagnostics tells what was touched."""
DIAGNOSTICS = "/diagnostics"
LYING = ("fault", "passive")


def read_walk(path: Path, world: World) -> tuple[Outcome, list[Moment]]:
    """What it came to, and the moments from when the robot began to follow. Raises RecordingError where a topic is missing."""
    heard: dict[str, list[tuple[float, Any]]] = defaultdict(list)
    for topic, arrival, message in read_messages(path, lambda topic, _: topic in (*TOPICS, DIAGNOSTICS)):
        heard[topic].append((1e-9 * arrival, message))
    for topic in TOPICS:
        if topic not in heard:
            raise RecordingError(f"{path}: nothing was recorded on {topic}")
    begins = next((at for at, m in heard["/follow_planner/state"] if _state(m)[0] is State.FOLLOWING), None)
    if begins is None:
        raise RecordingError(f"{path}: the robot never began to follow")
    moments = _moments(heard, begins, world)
    steps = np.diff([one.pose[:2] for one in moments], axis=0)
    outcome = Outcome(
        world=world.name,
        seed=world.seed,
        distance=FollowConfig().distance,
        walked=float(np.hypot(*steps.T).sum()),
        fell=any(m.mode_name in LYING for at, m in heard["/controller/state"] if at >= begins),
        touched=_touched([m for _, m in heard[DIAGNOSTICS]]),
    )
    return outcome, moments


def _moments(heard: dict[str, list[tuple[float, Any]]], begins: float, world: World) -> list[Moment]:
    truth, clearances = heard["/ground_truth/odom"], Clearances(world, FollowConfig())
    time = np.array([seconds(m.header.stamp) for _, m in truth])
    poses = np.array([planar_pose(m.pose.pose) for _, m in truth])
    twists = np.array([planar_twist(m.twist.twist) for _, m in truth])
    velocity = _over_stride(time, twists)
    asked_at = np.array([seconds(m.stamp) for _, m in heard["/command"]])
    asked = np.array([planar_twist(m.twist) for _, m in heard["/command"]])
    asked = _over_stride(time, asked[_newest(asked_at, time)])
    people = heard["/ground_truth/persons"]
    people_at = np.array([seconds(m.header.stamp) for _, m in people])
    said_at = np.array([at for at, _ in heard["/follow_planner/state"]])
    found = []
    for now in np.arange(max(begins, time[0]), time[-1], PERIOD_S):
        i = int(_newest(time, now))
        persons = np.array([planar_pose(pose) for pose in people[int(_newest(people_at, now))][1].poses])
        state, words = _state(heard["/follow_planner/state"][int(_newest(said_at, now))][1])
        here, near = poses[i], clearances.of(poses[i])
        gap = clearances.of_persons(here, persons)
        found.append(Moment(float(now), here, persons[0], asked[i], velocity[i], state, words, near, gap))
    return found


def _newest(times: Array, now: Any) -> Any:
    """Index of the newest of `times` at `now`, or of the first."""
    return np.maximum(np.searchsorted(times, now, side="right") - 1, 0)


def _over_stride(time: Array, values: Array) -> Array:
    """Means (n, k), low-passed over STRIDE, of values at the times (n,), s."""
    found = np.array(values, float)
    for i in range(1, len(found)):
        share = min(1.0, (time[i] - time[i - 1]) / STRIDE)
        found[i] = found[i - 1] + share * (values[i] - found[i - 1])
    return found


def _state(message: Any) -> tuple[State, str]:
    state, words = message.data.split(": ", maxsplit=1)
    return State(state), words


def _touched(diagnostics: list[Any]) -> dict[str, int]:
    """What the simulator told last: "name count, name count" or "nothing"."""
    told = [v.value for m in diagnostics for s in m.status for v in s.values if v.key == "touched"]
    if not told or told[-1] == "nothing":
        return {}
    pairs = (one.rsplit(" ", 1) for one in told[-1].split(", "))
    return {name: int(count) for name, count in pairs}

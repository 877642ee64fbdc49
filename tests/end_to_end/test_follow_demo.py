"""`quadvel demo follow --lockstep`: each node a process, judged by what they recorded."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.arrays import Array
from quadvel_follow.planar import planar_pose
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import read_messages

QUADVEL = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("follow")
    options = ["--lockstep", "--world", "campus", "--seconds", "5", "--out", str(out)]
    ended = subprocess.run(
        [*QUADVEL, "demo", "follow", *options], capture_output=True, text=True, timeout=300
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return out


def test_the_robot_follows_and_touches_nothing(out: Path) -> None:
    tour = json.loads((out / "tour.json").read_text())
    assert (tour["fell"], tour["touched"]) == (False, {})
    assert tour["walked"] > 2.0  # m


def test_the_person_is_told_where_it_is(out: Path) -> None:
    """As the robot sees it: what the tracker says, against the odometry, and the truth at the same instants."""
    person = places(out, "/person/odometry", lambda m: m.pose.pose)
    robot = places(out, "/odom", lambda m: m.pose.pose)
    true_person = places(out, "/ground_truth/persons", lambda m: m.poses[0])
    true_robot = places(out, "/ground_truth/odom", lambda m: m.pose.pose)
    time = person[:, 0]
    tracked = person[:, 1:3] - at(time, robot)[:, :2]
    true = at(time, true_person)[:, :2] - at(time, true_robot)[:, :2]
    off = np.hypot(*tracked.T) - np.hypot(*true.T)
    assert np.median(np.abs(off)) < 0.1


def places(out: Path, topic: str, pose: Callable[[Any], Any]) -> Array:
    """Of a topic: time (s), x, y (m), yaw (rad), (n, 4)."""
    messages = [m for _, _, m in read_messages(out / "follow.mcap", lambda name, _: name == topic)]
    return np.array([[seconds(m.header.stamp), *planar_pose(pose(m))] for m in messages])


def at(time: Array, known: Array) -> Array:
    """x, y, yaw at each time, (n, 3)."""
    return np.column_stack([np.interp(time, known[:, 0], column) for column in known[:, 1:].T])

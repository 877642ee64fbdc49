"""Scores person following in simulated scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadvel_follow.follow_planner import PERIOD_S, State
from quadvel_follow.leg_detector import LegDetector

from .scenes import SCENES, FollowScene
from .stage import CONFIG, DISTANCE_BAND_M, SETTLING_TIME_S, FollowSample, FollowSimulation

STANDING_SPEED_M_S = 0.1
"""Speed below which the robot counts as standing."""


def following_scores(samples: Sequence[FollowSample], distance: float) -> dict[str, float]:
    """Score one run of a scene.

    Args:
        samples: Samples of the run, one per planner period.
        distance: Set distance to the person, m.

    Returns:
        `success`: 1 if nothing was touched and the robot ends in the state FOLLOWING within
        DISTANCE_BAND_M of the set distance; `share`: share of time within that band, from
        SETTLING_TIME_S on; `late`: time from when the person last moves until the robot stands in
        the band, s, or until the end; `jerk`: RMS of the second difference of the velocity in the
        body frame, m/s^3; `clearance` and `gap`: smallest distance to obstacles and to people, m;
        `ms` and `slowest`: mean and largest computing time of a planner period, ms.
    """
    place = np.array([one.pose[:2] for one in samples])
    person = np.array([one.person for one in samples])
    time = np.array([one.time for one in samples])
    velocity = np.array([one.velocity for one in samples])[:, :2]
    inside = np.abs(np.hypot(*(person - place).T) - distance) < DISTANCE_BAND_M
    clearance, gap = min(one.clearance for one in samples), min(one.gap for one in samples)
    person_moves = np.flatnonzero((np.diff(person, axis=0) != 0.0).any(1))
    unsettled = np.flatnonzero(~inside | (np.hypot(*velocity.T) > STANDING_SPEED_M_S))
    jerk = np.diff(velocity, n=2, axis=0) / PERIOD_S**2
    took = [one.milliseconds for one in samples]
    return {
        "success": float(
            clearance > 0.0 and gap > 0.0 and inside[-1] and samples[-1].state is State.FOLLOWING
        ),
        "share": float(inside[time >= SETTLING_TIME_S].mean()),
        "late": max(0.0, PERIOD_S * float(unsettled[-1] - person_moves[-1])),
        "jerk": float(np.sqrt((jerk**2).sum(1).mean())),
        "clearance": clearance,
        "gap": gap,
        "ms": float(np.mean(took)),
        "slowest": max(took),
    }


def run_scene(scene: FollowScene, seed: int, detector: LegDetector) -> list[FollowSample]:
    """Simulate a scene.

    Args:
        scene: The scene.
        seed: Seed of the noise.
        detector: Leg detector.

    Returns:
        All samples.
    """
    return list(FollowSimulation(scene, seed, detector).run())


def measure_scenes(runs: int) -> Mapping[str, dict[str, float]]:
    """Score each kind of scene.

    Args:
        runs: Number of scenes of each kind.

    Returns:
        Scores by kind: means, but the smallest `clearance` and `gap` and the largest `slowest`.
    """
    detector = LegDetector()
    found = {}
    for name, scene in SCENES.items():
        rows = [
            following_scores(run_scene(scene(seed), seed, detector), CONFIG.distance) for seed in range(runs)
        ]
        reducers: dict[str, Any] = {"clearance": min, "gap": min, "slowest": max}
        found[name] = {key: float(reducers.get(key, np.mean)([row[key] for row in rows])) for key in rows[0]}
    return found

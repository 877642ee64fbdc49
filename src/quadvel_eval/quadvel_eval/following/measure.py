"""How well a person is followed: the figures of a scene, and those of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadvel_follow.follow_planner import PERIOD_S, State
from quadvel_follow.leg_detector import LegDetector

from .scenes import SCENES, FollowScene
from .stage import BAND, CONFIG, SETTLED, Instant, Stage


def figures(instants: Sequence[Instant], distance: float) -> dict[str, float]:
    """success: whether nothing was touched and the robot is in the end where it should be; share: of the time within BAND of
    the set distance; late: s, from the instant at which the person stands for good until the robot is there and stands;
    jerk: m/s^3, RMS of the robot's; clearance, gap: m, least, from what stands and from persons; ms: mean; slowest: ms.
    """
    place = np.array([one.pose[:2] for one in instants])
    person = np.array([one.person for one in instants])
    time = np.array([one.time for one in instants])
    velocity = np.array([one.velocity for one in instants])[:, :2]
    inside = np.abs(np.hypot(*(person - place).T) - distance) < BAND
    clearance, gap = min(one.clearance for one in instants), min(one.gap for one in instants)
    walks = np.flatnonzero((np.diff(person, axis=0) != 0.0).any(1))
    away = np.flatnonzero(~inside | (np.hypot(*velocity.T) > 0.1))
    jerk = np.diff(velocity, n=2, axis=0) / PERIOD_S**2
    took = [one.milliseconds for one in instants]
    return {
        "success": float(
            clearance > 0.0 and gap > 0.0 and inside[-1] and instants[-1].state is State.FOLLOWING
        ),
        "share": float(inside[time >= SETTLED].mean()),
        "late": max(0.0, PERIOD_S * float(away[-1] - walks[-1])),
        "jerk": float(np.sqrt((jerk**2).sum(1).mean())),
        "clearance": clearance,
        "gap": gap,
        "ms": float(np.mean(took)),
        "slowest": max(took),
    }


def run(scene: FollowScene, seed: int, detector: LegDetector) -> list[Instant]:
    """All instants of a scene."""
    return list(Stage(scene, seed, detector).run())


def measure(runs: int) -> Mapping[str, dict[str, float]]:
    """Of each kind of scene, `runs` of them: means; of clearances and gaps the least, of times the largest."""
    detector = LegDetector()
    found = {}
    for name, scene in SCENES.items():
        rows = [figures(run(scene(seed), seed, detector), CONFIG.distance) for seed in range(runs)]
        how: dict[str, Any] = {"clearance": min, "gap": min, "slowest": max}
        found[name] = {key: float(how.get(key, np.mean)([row[key] for row in rows])) for key in rows[0]}
    return found

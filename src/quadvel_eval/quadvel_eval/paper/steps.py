"""Random commands of the paper's training distribution, without ramps: survival of long episodes.

`study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_policy.observation import CONTROL_PERIOD_S

from ..walk import Setup, make_loop, record_until_fall
from .cells import Command
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, column, distinct, mean, select

SEMI_AXES = np.array([4.5, 2.0, 4.0])  # m/s, m/s, rad/s: ellipsoid of the paper's commands (Section 3.4)
STANCE_SHARE = 0.2  # of the commands, to stand
HOLD_S = (2.0, 10.0)  # from and to, until the next command


def draw_velocities(rng: np.random.Generator, n: int) -> Array:
    """Draw velocities, uniformly from the ellipsoid, some of them 0.

    Args:
        rng: Source of randomness.
        n: Number of velocities.

    Returns:
        vx, vy (m/s), wz (rad/s), (n, 3).
    """
    direction = rng.normal(size=(n, 3))
    # uniform in a unit ball: r = u^(1/3)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.cbrt(rng.random((n, 1)))
    return np.asarray(SEMI_AXES * unit * (rng.random((n, 1)) >= STANCE_SHARE))


def draw_commands(seed: int, seconds: float) -> list[tuple[Command, float]]:
    """Draw the commands of an episode.

    Args:
        seed: Seed of the draws.
        seconds: Duration of the episode, s.

    Returns:
        vx, vy (m/s), wz (rad/s), and duration (s) of each command.
    """
    rng = np.random.default_rng(seed)
    commands: list[tuple[Command, float]] = []
    while seconds > 0.0:
        vx, vy, wz = draw_velocities(rng, 1)[0].tolist()
        hold = min(rng.uniform(*HOLD_S), seconds)
        commands.append(((vx, vy, wz), hold))
        seconds -= hold
    return commands


def walk_episode(setup: Setup, seed: int, seconds: float) -> float | None:
    """Walk one episode.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of commands and robot.
        seconds: Duration, s.

    Returns:
        Time of the fall, s; None if the robot stayed on its feet.
    """
    walk, stood = record_until_fall(make_loop(setup, seed, ()), draw_commands(seed, seconds))
    if stood:
        return None
    return len(walk.position) * CONTROL_PERIOD_S if walk else 0.0  # no walk: it fell at the first tick


@attrs.frozen
class Steps(Section):
    """Episodes of random commands per policy, each with a seed of its own.

    Attributes:
        episodes: Number of episodes.
        seconds: Duration of each, s.
    """

    name: ClassVar[str] = "steps"
    title: ClassVar[str] = "Random commands in raw steps"
    method: ClassVar[str] = (
        "Episodes of 20 s with the commands of the paper's training: uniform in an ellipsoid of 4.5 m/s along x, 2 m/s along "
        "y and 4 rad/s, one in five to stand, a new one every 2 to 10 s. The policy clamps them to its limits. Commands reach "
        "it as steps, without the ramps of the command mux. Flat ground, nominal robot. The paper gives no figure."
    )
    episodes: int = 200
    seconds: float = 20.0

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            Job({"policy": policy, "seed": seed}, (walk_episode, study.setup(policy), seed, self.seconds))
            for policy in study.policies
            for seed in range(self.episodes)
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [{**labels, "fell": int(end is not None), "ended": end} for labels, end in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(6.0, 3.0), layout="constrained")
        panel = figure.subplots()
        for policy in distinct(records, "policy"):
            mine = select(records, policy=policy)
            ends = np.sort(column(select(mine, fell=1), "ended"))
            times = np.concatenate([[0.0], ends, [self.seconds]])
            fallen = np.append(np.arange(len(ends) + 1), len(ends))  # none at first; the last count stays
            panel.step(times, 100.0 * (1.0 - fallen / len(mine)), where="post", label=policy)
        panel.set_xlabel("time, s")
        panel.set_ylabel("on their feet, %")
        panel.set_ylim(0.0, 105.0)
        panel.legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        def falls(mine: Sequence[Record]) -> float:
            return 100.0 * mean(mine, "fell")

        return [
            Row("episodes that end in a fall", "%", None, by_policy(records, falls), 1, key=True),
            Row("episodes", "", None, by_policy(records, len), 0),
        ]

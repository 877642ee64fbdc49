"""Section 4.3: the largest velocities that the robot keeps up, forward, backward, sideways and spinning."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure

from ..robot_loop import PERIOD
from ..walk import Setup, make_loop, record
from .cells import Command, falls, limits, reach
from .section import Answers, Job, Record, Row, Section, Study, by_policy, distinct, largest, select

ACCELERATION = 0.7  # m/s^2, rad/s^2 times 1.4: how the command rises
KEPT = 5.0  # s at the full command, of which the last 4 count
COUNTED = 4.0  # s
DIRECTIONS: dict[str, tuple[Command, float]] = {  # and the paper's largest, m/s, rad/s
    "forward": ((1.0, 0.0, 0.0), 4.2),
    "backward": ((-1.0, 0.0, 0.0), 3.2),
    "left": ((0.0, 1.0, 0.0), 2.0),
    "right": ((0.0, -1.0, 0.0), 2.0),
    "spin left": ((0.0, 0.0, 1.0), 6.0),
    "spin right": ((0.0, 0.0, -1.0), 6.0),
}


def sustain(setup: Setup, seed: int, direction: Command, speed: float) -> float | None:
    """Mean velocity along `direction` (m/s, rad/s) at a command of `speed` that is kept up; None where it fell."""
    along = np.array(direction)
    rise = speed / (2 * ACCELERATION if along[2] else ACCELERATION)
    shares = np.minimum(np.arange(round((rise + KEPT) / PERIOD)) * PERIOD / rise, 1.0)
    walk = record(make_loop(setup, seed, ()), [(share * speed * along, PERIOD) for share in shares])
    return None if walk is None else float(walk.velocity[-round(COUNTED / PERIOD) :].mean(axis=0) @ along)


@attrs.frozen
class Sustained(Section):
    """Each direction at some shares of what the policy takes."""

    name: ClassVar[str] = "sustained"
    title: ClassVar[str] = "Section 4.3: largest sustained velocities"
    method: ClassVar[str] = (
        "The command rises at 0.7 m/s² (spins: 1.4 rad/s²) to 60, 80, 90 and 100 % of the policy's own limit in that "
        "direction, or of 1.1 times the paper's velocity where the limit is beyond it, and is held for 5 s. What counts is the "
        "mean true velocity of the last 4 s; the largest of the robots that did not fall is in the table."
    )
    shares: tuple[float, ...] = (0.6, 0.8, 0.9, 1.0)
    directions: tuple[str, ...] = tuple(DIRECTIONS)

    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            bounds = limits(study, policy)
            for name in self.directions:
                direction, paper = DIRECTIONS[name]
                top = min(reach(direction, bounds), 1.1 * paper)
                for speed in (round(share * top, 3) for share in self.shares):
                    labels = {"policy": policy, "direction": name, "command": speed, "limit": top}
                    jobs.append(Job(labels, (sustain, study.setup(policy), 0, direction, speed)))
        return jobs

    def judge(self, answers: Answers) -> list[Record]:
        return [{**labels, "reached": speed, "fell": int(speed is None)} for labels, speed in answers]

    def figure(self, records: Sequence[Record]) -> Figure:
        policies = distinct(records, "policy")
        names = distinct(records, "direction")
        figure = Figure(figsize=(9.0, 3.8), layout="constrained")
        walks, spins = figure.subplots(1, 2, width_ratios=(2, 1))
        for panel, spinning, unit in ((walks, False, "m/s"), (spins, True, "rad/s")):
            mine = [name for name in names if name.startswith("spin") == spinning]
            places, width = np.arange(len(mine)), 0.8 / len(policies)
            for k, policy in enumerate(policies):
                tops = [largest(select(records, policy=policy, direction=name), "reached") for name in mine]
                panel.bar(places + k * width, tops, width, label=policy, align="edge")
            paper = [DIRECTIONS[name][1] for name in mine]
            panel.hlines(paper, places, places + 0.8, color="black", linestyle="--", label="paper")
            panel.set_xticks(places + 0.4, mine)
            panel.set_ylabel(f"sustained velocity, {unit}")
        walks.legend()
        return figure

    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for name in distinct(records, "direction"):
            mine = select(records, direction=name)
            unit, paper = "rad/s" if name.startswith("spin") else "m/s", DIRECTIONS[name][1]
            reached, tried = (by_policy(mine, partial(largest, name=what)) for what in ("reached", "command"))
            rows += [
                Row(f"{name}: reached", unit, paper, reached, 2, key=True),
                Row(f"{name}: largest command that was tried", unit, None, tried, 2),
            ]
        return [*rows, Row("falls", "", 0.0, by_policy(records, falls), 0)]

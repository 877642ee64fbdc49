"""Robustness to slopes: survival and tracking after two kinds of start, on three plants.

`conditions` makes the jobs and draws the plots, `robustness` covers the other conditions, and
`study` runs the section.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_sim.terrain import Terrain

from ..grid import PLANTS
from .cells import Command, cell_record, largest_error
from .conditions import (
    COMMANDS,
    HARD_PLANTS,
    PLANT_NAMES,
    Condition,
    condition_job,
    draw_error_and_survival,
)
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, select

LEVEL_M = 1.0  # of level ground before a ramp


@attrs.frozen
class Ground:
    """A slope, and the commands that are walked on it.

    Attributes:
        degrees: Inclination, degrees.
        direction: Direction in which it rises, degrees, from ahead of the robot at the start to the left.
        level: Level ground before it begins, m; 0: the robot starts on it.
        commands: vx, vy (m/s), wz (rad/s) of each walk.
    """

    degrees: float
    direction: float = 0.0
    level: float = 0.0
    commands: tuple[Command, ...] = COMMANDS

    @property
    def terrain(self) -> Terrain:
        """The ground of the simulator."""
        slope, direction = np.radians([self.degrees, self.direction]).tolist()
        return Terrain(kind="slope", slope=slope, direction=direction, level=self.level)


AHEAD, SIDEWAYS = COMMANDS[:1], COMMANDS[1:2]
GROUNDS = {
    "15 degrees down": Ground(-15.0),
    "7.5 degrees down": Ground(-7.5),
    "7.5 degrees up": Ground(7.5),
    "15 degrees up": Ground(15.0),
    "15 degrees up to the left": Ground(15.0, 90.0),
    "15 degrees up to the right": Ground(15.0, -90.0),
    "ahead onto 20 degrees down": Ground(-20.0, level=LEVEL_M, commands=AHEAD),
    "ahead onto 20 degrees up": Ground(20.0, level=LEVEL_M, commands=AHEAD),
    "sideways onto 20 degrees down": Ground(-20.0, 90.0, LEVEL_M, SIDEWAYS),
    "sideways onto 20 degrees up": Ground(20.0, 90.0, LEVEL_M, SIDEWAYS),
}
"""Names of the slopes; the last four are walked onto from level ground."""
STANDING_TIME_S = 2.0  # on the slope before the command to walk
STARTS = {"": STANDING_TIME_S, "started at once": 0.0}
"""Names of the starts, and standing time before the walk, s."""
MAX_FOLLOWING_ERROR = 0.15  # m/s, over the evaluated 4 s; a robot with a larger error is stuck


def survival_and_following(records: Sequence[Record]) -> float:
    """Return the share of robots that neither fell nor exceeded MAX_FOLLOWING_ERROR.

    Args:
        records: Records of `cell_record`.

    Returns:
        Share, %; nan without records.
    """
    good = [not r["fell"] and r["error_xy"] <= MAX_FOLLOWING_ERROR for r in records]
    return 100.0 * float(np.mean(good)) if good else float("nan")


def group_name(plant: str, start: str) -> str:
    """Return the name of the walks on a plant with a start.

    Args:
        plant: Key of HARD_PLANTS.
        start: Key of STARTS.

    Returns:
        The name.
    """
    return f"{plant}, {start}" if start else plant


TITLES = {
    group_name(plant, start): "".join(f"{name}, " for name in (PLANT_NAMES.get(plant), start) if name)
    for plant, start in itertools.product(HARD_PLANTS, STARTS)
}
"""Start of the row names of each group."""


def conditions(plant: str, start: str) -> list[Condition]:
    """List the slopes of GROUNDS on a plant with a start.

    Args:
        plant: Key of HARD_PLANTS.
        start: Key of STARTS.

    Returns:
        The conditions.
    """
    return [
        Condition(
            group_name(plant, start),
            name,
            {**HARD_PLANTS[plant], "terrain": ground.terrain},
            standing_time=STARTS[start],
        )
        for name, ground in GROUNDS.items()
    ]


@attrs.frozen
class Slopes(Section):
    """Walks of every command on every slope, plant and start.

    Attributes:
        plants: Keys of HARD_PLANTS.
        starts: Keys of STARTS.
    """

    name: ClassVar[str] = "slopes"
    title: ClassVar[str] = "Robustness: slopes"
    method: ClassVar[str] = (
        "Slopes that rise (up) or fall (down) ahead of the robot at the start, or to its side. It stands there for 2 s, or starts "
        "at once, 0.5 s after it was put there, and walks for 6 s ahead (1 m/s), sideways (0.5 m/s) or along an arc (0.6 m/s, "
        "0.6 rad/s), which turns it on the slope. Slopes of 20 degrees begin after 1 m of level ground. A robot survives and "
        "follows if it does not fall and is off its command by at most 0.15 m/s on the mean of the last 4 s. The second plant is "
        "that of Figure 10; its loose joints have neither friction nor damping. The paper gives no figures."
    )
    plants: tuple[str, ...] = tuple(HARD_PLANTS)
    starts: tuple[str, ...] = tuple(STARTS)

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy, plant, start in itertools.product(study.policies, self.plants, self.starts)
            for seed in range(study.seeds)
            for one in conditions(plant, start)
            for command in GROUNDS[one.level].commands
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        groups = distinct(records, "group")
        figure = Figure(figsize=(3.2 * len(groups), 6.0), layout="constrained")
        panels = figure.subplots(2, len(groups), sharey="row", squeeze=False)
        for (error, stood), name in zip(panels.T, groups, strict=True):
            draw_error_and_survival(error, stood, select(records, group=name))
            error.set_title(name)
            error.tick_params(axis="x", labelbottom=False)
            stood.tick_params(axis="x", rotation=90)
        panels[0, 0].set_ylabel("mean error, m/s")
        panels[1, 0].set_ylabel("survival, %")
        panels[0, 0].legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for name, ground in itertools.product(distinct(records, "group"), GROUNDS):
            mine = select(records, group=name, level=ground)
            what = TITLES[name] + ground
            following = by_policy(mine, survival_and_following)
            rows += [
                Row(f"{what}: survive and follow", "%", None, following, 1, key=name in PLANTS),
                Row(f"{what}: largest error", "m/s", None, by_policy(mine, largest_error)),
            ]
        return rows

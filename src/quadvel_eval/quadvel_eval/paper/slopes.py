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

from .cells import Command, cell_record, largest_error, mean_error
from .conditions import (
    COMMANDS,
    HARD_PLANTS,
    PLANT_NAMES,
    Condition,
    condition_job,
    draw_error_and_survival,
    survival_rate,
)
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, select

SLOPES = {-15.0: "15 degrees down", -7.5: "7.5 degrees down", 7.5: "7.5 degrees up", 15.0: "15 degrees up"}
"""Slopes (degrees, rising ahead of the robot at the start) and their names."""
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
    """List all slopes on a plant with a start.

    Args:
        plant: Key of HARD_PLANTS.
        start: Key of STARTS.

    Returns:
        The conditions.
    """
    return [
        Condition(
            group_name(plant, start),
            f"{degrees:g}",
            {**HARD_PLANTS[plant], "terrain": Terrain(kind="slope", slope=float(np.radians(degrees)))},
            standing_time=STARTS[start],
        )
        for degrees in SLOPES
    ]


@attrs.frozen
class Slopes(Section):
    """Walks of every command on every slope, plant and start.

    Attributes:
        plants: Keys of HARD_PLANTS.
        starts: Keys of STARTS.
        commands: vx, vy (m/s), wz (rad/s) of each walk.
    """

    name: ClassVar[str] = "slopes"
    title: ClassVar[str] = "Robustness: slopes"
    method: ClassVar[str] = (
        "Slopes that rise (up) or fall (down) ahead of the robot at the start. It stands there for 2 s, or starts at once, 0.5 s "
        "after it was put there, and walks for 6 s ahead (1 m/s), sideways (0.5 m/s) or along an arc (0.6 m/s, 0.6 rad/s), which "
        "turns it across the slope. Survival: share of the robots that did not fall. A robot that does not fall, but is off its "
        "command by more than 0.15 m/s on the mean of the last 4 s, is stuck: it does not follow. The second plant is that of "
        "Figure 10; its loose joints have neither friction nor damping. The paper gives no figures."
    )
    plants: tuple[str, ...] = tuple(HARD_PLANTS)
    starts: tuple[str, ...] = tuple(STARTS)
    commands: tuple[Command, ...] = COMMANDS

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy, plant, start in itertools.product(study.policies, self.plants, self.starts)
            for seed in range(study.seeds)
            for one in conditions(plant, start)
            for command in self.commands
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        groups = distinct(records, "group")
        figure = Figure(figsize=(3.2 * len(groups), 4.6), layout="constrained")
        panels = figure.subplots(2, len(groups), sharey="row", squeeze=False)
        for (error, stood), name in zip(panels.T, groups, strict=True):
            draw_error_and_survival(error, stood, select(records, group=name))
            error.set_title(name)
            stood.set_xlabel("slope, degrees")
        panels[0, 0].set_ylabel("mean error, m/s")
        panels[1, 0].set_ylabel("survival, %")
        panels[0, 0].legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for name, degrees in itertools.product(distinct(records, "group"), SLOPES):
            mine = [r for r in select(records, group=name) if float(r["level"]) == degrees]
            what = TITLES[name] + SLOPES[degrees]
            following = by_policy(mine, survival_and_following)
            rows += [
                Row(f"{what}: survive and follow", "%", None, following, 1, key=True),
                Row(f"{what}: survival", "%", None, by_policy(mine, survival_rate), 1),
                Row(f"{what}: mean error", "m/s", None, by_policy(mine, mean_error)),
                Row(f"{what}: largest error", "m/s", None, by_policy(mine, largest_error)),
            ]
        return rows

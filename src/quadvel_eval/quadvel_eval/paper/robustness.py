"""Robustness: friction, payload, slopes, rough ground and pushes; who survives and how well it tracks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure

from quadvel_sim.terrain import Terrain

from ..grid import PLANTS
from .cells import Command, cell_record, largest_error, mean_error
from .conditions import COMMANDS, Condition, condition_job, draw, survival, survival_and_following
from .section import Answers, Job, Record, Row, Section, Study, by_policy, distinct, select

FORCE = 60.0  # N
SLOPES = {-15.0: "15 degrees down", -7.5: "7.5 degrees down", 7.5: "7.5 degrees up", 15.0: "15 degrees up"}
"""Slopes (degrees, rising ahead of the robot at the start) and their names."""
STOOD = 2.0  # s that a robot stands on a slope before it is commanded to walk
XLABELS = {
    "friction": "friction coefficient",
    "payload": "payload, kg",
    "slope": "slope, degrees",
    "slope, second plant": "slope, degrees",
    "rough ground": "height of the humps, cm",
    "push": f"push of {FORCE:g} N for 0.2 s",
}


def conditions(seed: int) -> list[Condition]:
    """All of them; the seed is that of rough ground."""
    found = [Condition("friction", f"{f:g}", {"friction": np.full(4, f)}) for f in (0.3, 0.5, 0.8, 1.0)]
    found += [Condition("payload", f"{m:g}", {"payload": m}) for m in (-2.0, 0.0, 2.5, 5.0)]
    for (plant, fields), degrees in itertools.product(PLANTS.items(), SLOPES):
        group = "slope" if plant == "usual" else f"slope, {plant} plant"
        terrain = Terrain(kind="slope", slope=float(np.radians(degrees)))
        found.append(Condition(group, f"{degrees:g}", {**fields, "terrain": terrain}, stood=STOOD))
    for roughness in (0.03, 0.06):
        terrain = Terrain(kind="rough", roughness=roughness, seed=seed)
        found.append(Condition("rough ground", f"{100 * roughness:g}", {"terrain": terrain}))
    for name, push in (
        ("ahead", (1, 0, 0)),
        ("back", (-1, 0, 0)),
        ("left", (0, 1, 0)),
        ("right", (0, -1, 0)),
    ):
        found.append(Condition("push", name, push=(FORCE * push[0], FORCE * push[1], 0.0)))
    return found


@attrs.frozen
class Robustness(Section):
    """Every condition with every command and seed."""

    name: ClassVar[str] = "robustness"
    title: ClassVar[str] = "Robustness"
    method: ClassVar[str] = (
        "Walks of 6 s ahead (1 m/s), sideways (0.5 m/s) and along an arc (0.6 m/s, 0.6 rad/s), each with one thing changed: "
        "friction of all feet, a mass on the trunk or taken off it, a slope, rough ground (Perlin noise), a push of 60 N for "
        "0.2 s on the trunk after 1 s. Survival: share of the robots that did not fall. Slopes rise (up) or fall (down) ahead of "
        "the robot at the start; it stands there for 2 s before its command. A robot that does not fall but is off its command "
        "by more than 0.15 m/s on the mean of the last 4 s is stuck: it does not follow. The second plant is that of Figure "
        "10. The paper shows such walks and gives no figures."
    )
    groups: tuple[str, ...] = tuple(XLABELS)
    commands: tuple[Command, ...] = COMMANDS

    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy in study.policies
            for seed in range(study.seeds)
            for one in conditions(seed)
            if one.group in self.groups
            for command in self.commands
        ]

    def judge(self, answers: Answers) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    def figure(self, records: Sequence[Record]) -> Figure:
        groups = distinct(records, "group")
        figure = Figure(figsize=(3.2 * len(groups), 4.6), layout="constrained")
        panels = figure.subplots(2, len(groups), sharey="row", squeeze=False)
        for (error, stood), group in zip(panels.T, groups, strict=True):
            draw(error, stood, select(records, group=group))
            stood.set_xlabel(XLABELS[group])
        panels[0, 0].set_ylabel("mean error, m/s")
        panels[1, 0].set_ylabel("survival, %")
        panels[0, 0].legend()
        return figure

    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for group in distinct(records, "group"):
            mine = select(records, group=group)
            rows += _slope_rows(group, mine) if group.startswith("slope") else _rows(group, mine)
        return rows


def _rows(what: str, records: Sequence[Record]) -> list[Row]:
    return [
        Row(f"{what}: survival", "%", None, by_policy(records, survival), 1, key=True),
        Row(f"{what}: mean error", "m/s", None, by_policy(records, mean_error)),
        Row(f"{what}: largest error", "m/s", None, by_policy(records, largest_error)),
    ]


def _slope_rows(group: str, records: Sequence[Record]) -> list[Row]:
    """Each slope by itself: who survives, and who also follows."""
    rows = []
    for level in distinct(records, "level"):
        mine, what = select(records, level=level), f"{group}, {SLOPES[level]}"
        following = by_policy(mine, survival_and_following)
        rows += [Row(f"{what}: survive and follow", "%", None, following, 1, key=True), *_rows(what, mine)]
    return rows

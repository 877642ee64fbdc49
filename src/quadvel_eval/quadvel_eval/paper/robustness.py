"""Robustness to friction, payload, rough ground and pushes; module `slopes` covers slopes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_sim.terrain import Terrain

from .cells import Command, cell_record, largest_error, mean_error
from .conditions import COMMANDS, Condition, condition_job, draw_error_and_survival, survival_rate
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, select

PUSH_FORCE_N = 60.0  # N
GROUP_LABELS = {
    "friction": "friction coefficient",
    "payload": "payload, kg",
    "rough ground": "height of the humps, cm",
    "push": f"push of {PUSH_FORCE_N:g} N for 0.2 s",
}


def conditions(seed: int) -> list[Condition]:
    """List all conditions.

    Args:
        seed: Seed of the rough ground.

    Returns:
        The conditions.
    """
    found = [Condition("friction", f"{f:g}", {"friction": np.full(4, f)}) for f in (0.3, 0.5, 0.8, 1.0)]
    found += [Condition("payload", f"{m:g}", {"payload": m}) for m in (-2.0, 0.0, 2.5, 5.0)]
    for roughness in (0.03, 0.06):
        terrain = Terrain(kind="rough", roughness=roughness, seed=seed)
        found.append(Condition("rough ground", f"{100 * roughness:g}", {"terrain": terrain}))
    for name, push in (
        ("ahead", (1, 0, 0)),
        ("back", (-1, 0, 0)),
        ("left", (0, 1, 0)),
        ("right", (0, -1, 0)),
    ):
        found.append(Condition("push", name, push=(PUSH_FORCE_N * push[0], PUSH_FORCE_N * push[1], 0.0)))
    return found


@attrs.frozen
class Robustness(Section):
    """Walks of every command under every condition.

    Attributes:
        groups: Groups of conditions.
        commands: vx, vy (m/s), wz (rad/s) of each walk.
    """

    name: ClassVar[str] = "robustness"
    title: ClassVar[str] = "Robustness"
    method: ClassVar[str] = (
        "Walks of 6 s ahead (1 m/s), sideways (0.5 m/s) and along an arc (0.6 m/s, 0.6 rad/s), each with one thing changed: "
        "friction of all feet, a mass on the trunk or taken off it, rough ground (Perlin noise), a push of 60 N for 0.2 s on the "
        "trunk after 1 s. Survival: share of the robots that did not fall. The paper shows such walks and gives no figures."
    )
    groups: tuple[str, ...] = tuple(GROUP_LABELS)
    commands: tuple[Command, ...] = COMMANDS

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy in study.policies
            for seed in range(study.seeds)
            for one in conditions(seed)
            if one.group in self.groups
            for command in self.commands
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    def _shown(self, records: Sequence[Record]) -> list[str]:
        """Groups of this section that the records hold."""
        return [group for group in distinct(records, "group") if group in self.groups]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        groups = self._shown(records)
        figure = Figure(figsize=(3.2 * len(groups), 4.6), layout="constrained")
        panels = figure.subplots(2, len(groups), sharey="row", squeeze=False)
        for (error, stood), group in zip(panels.T, groups, strict=True):
            draw_error_and_survival(error, stood, select(records, group=group))
            stood.set_xlabel(GROUP_LABELS[group])
        panels[0, 0].set_ylabel("mean error, m/s")
        panels[1, 0].set_ylabel("survival, %")
        panels[0, 0].legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for group in self._shown(records):
            mine = select(records, group=group)
            rows += [
                Row(f"{group}: survival", "%", None, by_policy(mine, survival_rate), 1, key=True),
                Row(f"{group}: mean error", "m/s", None, by_policy(mine, mean_error)),
                Row(f"{group}: largest error", "m/s", None, by_policy(mine, largest_error)),
            ]
        return rows

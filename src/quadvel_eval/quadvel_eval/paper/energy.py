"""Figure 12: cost of transport and of turning (Eq. 10) over speed.

`cells` makes the jobs; `study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from .cells import Command, cell_job, cell_record, command_limits, is_within_limits
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, mean, select


@attrs.frozen
class Energy(Section):
    """Cost of straight walks and of turns on the spot.

    Attributes:
        speeds: Commanded forward velocities, m/s.
        rates: Commanded yaw rates, rad/s.
    """

    name: ClassVar[str] = "energy"
    title: ClassVar[str] = "Figure 12: cost of transport and of turning"
    method: ClassVar[str] = (
        "Eq. 10 with the mean power of the 12 drives, heat (k_r = 0.2) included and nothing given back, over the last 4 of 6 s: "
        "straight walks, and turns on the spot with the characteristic length of 0.555 m. The paper shows curves without "
        "figures. Commands beyond a policy's limits are left out."
    )
    speeds: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
    rates: tuple[float, ...] = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)

    @override
    def jobs(self, study: Study) -> list[Job]:
        commands: list[Command] = [(speed, 0.0, 0.0) for speed in self.speeds]
        commands += [(0.0, 0.0, rate) for rate in self.rates]
        return [
            cell_job(study.setup(policy), command, seed, policy=policy)
            for policy in study.policies
            for command in commands
            if is_within_limits(command, command_limits(study, policy))
            for seed in range(study.seeds)
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(9.0, 3.5), layout="constrained")
        straight, turning = figure.subplots(1, 2)
        for panel, axis, other in ((straight, "vx", "wz"), (turning, "wz", "vx")):
            for policy in distinct(records, "policy"):
                mine = select(records, policy=policy, **{other: 0.0})
                values = distinct(mine, axis)
                costs = [mean(select(mine, **{axis: value}), "cot") for value in values]
                panel.plot(values, costs, "o-", label=policy)
            panel.set_ylim(0.0, None)
        straight.set_xlabel("commanded $v_x$, m/s")
        straight.set_ylabel("cost of transport")
        turning.set_xlabel("commanded yaw rate, rad/s")
        turning.set_ylabel("cost of turning")
        straight.legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        def least(axis: str) -> dict[str, float | None]:
            moving = [r for r in records if r[axis]]
            return by_policy(
                moving, lambda r: np.nanmin([mean(select(r, **{axis: v}), "cot") for v in distinct(r, axis)])
            )

        def at(**command: float) -> dict[str, float | None]:
            return by_policy(select(records, **command), lambda r: mean(r, "cot"))

        return [
            Row("cost of transport at 1 m/s", "", None, at(vx=1.0), key=True),
            Row("cost of transport, the least", "", None, least("vx")),
            Row("cost of turning at 1 rad/s", "", None, at(wz=1.0), key=True),
            Row("cost of turning, the least", "", None, least("wz")),
        ]

"""Figure 9: action jitter, the mean absolute second difference of three consecutive actions.

`study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from .cells import cell_job, cell_record, command_limits
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, mean, select


@attrs.frozen
class Jitter(Section):
    """Jitter of straight walks.

    Attributes:
        speeds: Commanded forward velocities, m/s.
    """

    name: ClassVar[str] = "jitter"
    title: ClassVar[str] = "Figure 9: action jitter"
    method: ClassVar[str] = (
        "Mean over joints and ticks (5 ms) of the absolute second difference of the joint targets, in straight walks at "
        "several speeds, the last 4 of 6 s. The paper shows bars without figures."
    )
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5)

    @override
    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            top = command_limits(study, policy).high[0]
            for speed in (s for s in self.speeds if s <= top):
                jobs += [
                    cell_job(study.setup(policy), (speed, 0.0, 0.0), seed, policy=policy)
                    for seed in range(study.seeds)
                ]
        return jobs

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        policies, speeds = distinct(records, "policy"), distinct(records, "vx")
        figure = Figure(figsize=(6.0, 3.5), layout="constrained")
        panel = figure.subplots()
        places, width = np.arange(len(speeds)), 0.8 / len(policies)
        for k, policy in enumerate(policies):
            bars = [1e3 * mean(select(records, policy=policy, vx=speed), "jitter") for speed in speeds]
            panel.bar(places + k * width, bars, width, label=policy, align="edge")
        panel.set_xticks(places + 0.4, [f"{speed:g}" for speed in speeds])
        panel.set_xlabel("commanded $v_x$, m/s")
        panel.set_ylabel("action jitter, mrad")
        panel.legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        speeds = distinct(records, "vx")
        rows = [
            Row(f"jitter at {s:g} m/s", "mrad", None, by_policy(select(records, vx=s), _jitter), 2)
            for s in speeds
        ]
        return [*rows, Row("mean", "mrad", None, by_policy(records, _jitter), 2, key=True)]


def _jitter(records: Sequence[Record]) -> float:
    """Mean jitter, mrad."""
    return 1e3 * mean(records, "jitter")

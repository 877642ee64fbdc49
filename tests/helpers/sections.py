"""A section of the paper's evaluation that needs no robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
from matplotlib.figure import Figure

from quadvel_eval.paper.section import Job, JobResults, Record, Row, Section, Study, by_policy, largest


@attrs.frozen
class Powers(Section):
    """Powers of two by jobs."""

    name: ClassVar[str] = "powers"
    title: ClassVar[str] = "Powers"
    method: ClassVar[str] = "Counted."
    count: int = 3

    def jobs(self, study: Study) -> list[Job]:
        return [
            Job({"policy": name, "k": k}, (pow, 2, k)) for name in study.policies for k in range(self.count)
        ]

    def to_records(self, answers: JobResults) -> list[Record]:
        return [{**labels, "value": float(answer), "none": None} for labels, answer in answers]

    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(1.0, 1.0))
        figure.subplots().plot([record["value"] for record in records])
        return figure

    def rows(self, records: Sequence[Record]) -> list[Row]:
        return [Row("largest", "m", 5.0, by_policy(records, lambda r: largest(r, "value")), 1)]

"""What a section of the paper's evaluation is: walks to make, a judgement of them, a picture and rows of a table.

Here stands the interface alone; each section has a module of its own, `study` runs them and writes their files.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import attrs
import numpy as np
from matplotlib.figure import Figure

from quadvel_estimator.learned import SHIPPED_MODEL
from quadvel_policy.policy_file import SHIPPED_POLICY

from ..pool import Call
from ..walk import Setup

Record: TypeAlias = dict[str, Any]
"""one line of a section's CSV: names and numbers, None where there is none"""


@attrs.frozen(kw_only=True)
class Study:
    """What is evaluated: policies by the names they have in tables, the estimator in the loop, seeds 0, 1, ..."""

    policies: Mapping[str, Path] = attrs.field(factory=lambda: {SHIPPED_POLICY.stem: SHIPPED_POLICY})
    estimator: str = "learned"
    estimator_file: Path = SHIPPED_MODEL
    seeds: int = 3

    def setup(self, policy: str, **plant: Any) -> Setup:
        """How the policy of this name walks; `plant`: fields of SimulatorConfig that differ."""
        return Setup(
            policy=self.policies[policy],
            estimator=self.estimator,
            estimator_file=self.estimator_file,
            plant=plant,
        )


@attrs.frozen
class Job:
    """A call that another process can make, and what its answer stands for."""

    labels: Record
    call: Call


def walks(study: Study, walk: Callable[..., Any], *arguments: Any) -> list[Job]:
    """`walk(setup, seed, *arguments)` for each policy and seed."""
    return [
        Job({"policy": policy, "seed": seed}, (walk, study.setup(policy), seed, *arguments))
        for policy in study.policies
        for seed in range(study.seeds)
    ]


Answers: TypeAlias = Sequence[tuple[Record, Any]]
"""labels of each job and what it returned, in the order of the jobs"""


@attrs.frozen
class Row:
    """One line of the page: the paper's value (its CRL-EAM) beside those of our policies, None where unknown."""

    what: str
    unit: str
    paper: float | None
    ours: Mapping[str, float | None]
    digits: int = 3
    key: bool = False
    """whether the page begins with it"""


@attrs.frozen
class Section(ABC):
    """A part of the evaluation. Its fields (attrs) are what a short run may make smaller."""

    name: ClassVar[str]
    """of its files and on the command line"""
    title: ClassVar[str]
    method: ClassVar[str]
    """what was done, for the page"""

    @abstractmethod
    def jobs(self, study: Study) -> list[Job]:
        """All that has to be run; no job waits for another."""

    @abstractmethod
    def judge(self, answers: Answers) -> list[Record]:
        """What the CSV holds; picture and table are made of it alone."""

    @abstractmethod
    def figure(self, records: Sequence[Record]) -> Figure:
        """The picture."""

    @abstractmethod
    def rows(self, records: Sequence[Record]) -> list[Row]:
        """The table."""


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """The records that have these values."""
    return [r for r in records if all(r[name] == value for name, value in wanted.items())]


def distinct(records: Iterable[Record], name: str) -> list[Any]:
    """The values of a column, each once, in the order in which they come first."""
    return list(dict.fromkeys(r[name] for r in records))


def column(records: Iterable[Record], name: str) -> np.ndarray:
    """The numbers of a column, nan where there is none."""
    return np.array([np.nan if r[name] is None else r[name] for r in records], float)


def by_policy(
    records: Sequence[Record], measure: Callable[[Sequence[Record]], float | None]
) -> dict[str, float | None]:
    """`measure(records of a policy)` for each policy; what is not finite becomes None."""
    found: dict[str, float | None] = {}
    for policy in distinct(records, "policy"):
        value = measure(select(records, policy=policy))
        found[policy] = float(value) if value is not None and np.isfinite(value) else None
    return found


def largest(records: Sequence[Record], name: str) -> float:
    """Of a column's numbers; nan where there are none."""
    values = column(records, name)
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def mean(records: Sequence[Record], name: str) -> float:
    """Of a column's numbers; nan where there are none."""
    values = column(records, name)
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

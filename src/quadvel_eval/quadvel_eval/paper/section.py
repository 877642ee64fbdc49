"""Interface of a section of the paper's evaluation: jobs, records, a figure and table rows.

Each section has its own module. Module `study` runs the sections; `files.write_section` writes CSV,
figure and JSON.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import attrs
import numpy as np
from matplotlib.figure import Figure

from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.learned import shipped_estimator
from quadvel_policy.policy_file import shipped_policy

from ..pool import Call
from ..walk import Setup

Record: TypeAlias = dict[str, Any]
"""One line of a section's CSV: column names and values, None if undefined."""


@attrs.frozen(kw_only=True)
class Study:
    """Policies, estimator and seeds of an evaluation.

    Attributes:
        robot: Name of a shipped robot, or path of a robot.yaml.
        policies: ONNX files by their names in tables; the default is the shipped one of the robot.
        estimator: Velocity estimator in the loop.
        estimator_file: ONNX file of the learned estimator.
        seeds: Number of seeds; they are 0, 1, ...
    """

    robot: str = DEFAULT_ROBOT
    policies: Mapping[str, Path] = attrs.field()
    estimator: str = "learned"
    estimator_file: Path = attrs.field()
    seeds: int = 3

    @policies.default
    def _shipped_policy(self) -> Mapping[str, Path]:
        file = shipped_policy(load_robot(self.robot))
        return {file.stem: file}

    @estimator_file.default
    def _shipped_estimator(self) -> Path:
        return shipped_estimator(load_robot(self.robot))

    def setup(self, policy: str, **plant: Any) -> Setup:
        """Return the walk setup of a policy.

        Args:
            policy: Name of the policy.
            **plant: Fields of `SimulatorConfig` that differ from the nominal robot.

        Returns:
            The setup.
        """
        return Setup(
            robot=self.robot,
            policy=self.policies[policy],
            estimator=self.estimator,
            estimator_file=self.estimator_file,
            plant=plant,
        )


@attrs.frozen
class Job:
    """A call for another process, with labels for its result.

    Attributes:
        labels: Columns that every record of the result gets.
        call: Function and arguments.
    """

    labels: Record
    call: Call


def walk_jobs(study: Study, walk: Callable[..., Any], *arguments: Any) -> list[Job]:
    """Create a job `walk(setup, seed, *arguments)` for each policy and seed.

    Args:
        study: Policies and seeds.
        walk: Function that another process can import.
        *arguments: Further arguments.

    Returns:
        The jobs.
    """
    return [
        Job({"policy": policy, "seed": seed}, (walk, study.setup(policy), seed, *arguments))
        for policy in study.policies
        for seed in range(study.seeds)
    ]


JobResults: TypeAlias = Sequence[tuple[Record, Any]]
"""Labels and result of each job, in the order of the jobs."""


@attrs.frozen
class Row:
    """One line of README.md (see `files`): the paper's value for its policy CRL-EAM next to those of our policies.

    Attributes:
        what: Name of the quantity.
        unit: Its unit.
        paper: Value of the paper; None if unknown.
        ours: Values by policy; None if undefined.
        digits: Decimals in the table.
        key: Whether README.md repeats the row in its first table.
    """

    what: str
    unit: str
    paper: float | None
    ours: Mapping[str, float | None]
    digits: int = 3
    key: bool = False


@attrs.frozen
class Section(ABC):
    """A section of the evaluation; subclasses are attrs classes.

    The fields of a subclass are settings that a short run may reduce.

    Attributes:
        name: Name of its files and on the command line.
        title: Heading on the page.
        method: What was done, for the page.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    method: ClassVar[str]

    @abstractmethod
    def jobs(self, study: Study) -> list[Job]:
        """List all independent jobs of the section.

        Args:
            study: Policies, estimator and seeds.

        Returns:
            The jobs.
        """

    @abstractmethod
    def to_records(self, answers: JobResults) -> list[Record]:
        """Convert the answers to the records of the CSV, from which figure and table are made.

        Args:
            answers: Labels and answer of each job, in the order of the jobs.

        Returns:
            The records.
        """

    @abstractmethod
    def figure(self, records: Sequence[Record]) -> Figure:
        """Draw the figure.

        Args:
            records: The records.

        Returns:
            The figure.
        """

    @abstractmethod
    def rows(self, records: Sequence[Record]) -> list[Row]:
        """Compute the rows of the table.

        Args:
            records: The records.

        Returns:
            The rows.
        """


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """Select the records with given values.

    Args:
        records: The records.
        **wanted: Value of each column.

    Returns:
        The matching records.
    """
    return [r for r in records if all(r[name] == value for name, value in wanted.items())]


def distinct(records: Iterable[Record], name: str) -> list[Any]:
    """Return the distinct values of a column, in order of first appearance.

    Args:
        records: The records.
        name: The column.

    Returns:
        The values.
    """
    return list(dict.fromkeys(r[name] for r in records))


def column(records: Iterable[Record], name: str) -> np.ndarray:
    """Return a column as an array.

    Args:
        records: The records.
        name: The column.

    Returns:
        Numbers (n,), nan for None.
    """
    return np.array([np.nan if r[name] is None else r[name] for r in records], float)


def by_policy(
    records: Sequence[Record], measure: Callable[[Sequence[Record]], float | None]
) -> dict[str, float | None]:
    """Compute a number for each policy.

    Args:
        records: The records.
        measure: Function from the records of a policy to a number.

    Returns:
        Values by policy; None if not finite.
    """
    found: dict[str, float | None] = {}
    for policy in distinct(records, "policy"):
        value = measure(select(records, policy=policy))
        found[policy] = float(value) if value is not None and np.isfinite(value) else None
    return found


def largest(records: Sequence[Record], name: str) -> float:
    """Return the largest number of a column.

    Args:
        records: The records.
        name: The column.

    Returns:
        The number; nan without any.
    """
    values = column(records, name)
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def mean(records: Sequence[Record], name: str) -> float:
    """Return the mean of the numbers of a column.

    Args:
        records: The records.
        name: The column.

    Returns:
        The mean; nan without any.
    """
    values = column(records, name)
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

"""Figure 11: walks the letters ZJU in open loop and measures the deviation from them.

`quadvel_follow.trajectory` supplies the letters as trajectories; `study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_follow.trajectory import SHIPPED_FOLDER, Trajectory, read_table
from quadvel_policy.observation import CONTROL_PERIOD_S

from ..walk import Setup, Walk, make_loop, record_until_fall
from .cells import Command
from .section import (
    Job,
    JobResults,
    Record,
    Row,
    Section,
    Study,
    by_policy,
    column,
    distinct,
    largest,
    mean,
    select,
    walk_jobs,
)

CSV_INTERVAL_TICKS = 10  # between lines of the CSV
Stroke = tuple[Command, float]  # velocity in the body frame, and duration (s)


def _read_strokes() -> tuple[Stroke, ...]:
    """Read the letters: Z without turning, J from its hook, U sideways to its top."""
    _, rows = read_table(SHIPPED_FOLDER / "zju.csv")
    return tuple(((vx, vy, wz), seconds) for seconds, vx, vy, wz in rows.tolist())


LETTERS = _read_strokes()


def reference_path(strokes: Sequence[Stroke]) -> Array:
    """Integrate the commands to a path from the origin, facing +x.

    Args:
        strokes: Velocity and duration of each stroke.

    Returns:
        x, y (m) and heading (rad), (n, 3), one row per tick.
    """
    commands, seconds = zip(*strokes, strict=True)
    return Trajectory.from_commands(seconds, commands, CONTROL_PERIOD_S).pose


def walked_path(walk: Walk) -> Array:
    """Transform the path of a robot into its frame at the first command.

    Args:
        walk: The walk.

    Returns:
        x, y (m) and heading (rad), (n, 3), one row per tick.
    """
    cos, sin = np.cos(walk.heading[0]), np.sin(walk.heading[0])
    x, y = (walk.position[:, :2] - walk.position[0, :2]).T
    return np.column_stack([cos * x + sin * y, -sin * x + cos * y, walk.heading - walk.heading[0]])


def walk_letters(setup: Setup, seed: int, strokes: Sequence[Stroke]) -> tuple[Array | None, bool]:
    """Walk the strokes in open loop.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of the run.
        strokes: Velocity and duration of each stroke.

    Returns:
        The walked path (n, 3) or None, and whether the robot stayed on its feet.
    """
    walk, stood = record_until_fall(make_loop(setup, seed, ()), strokes)
    return (None if walk is None else walked_path(walk)), stood


@attrs.frozen
class Letters(Section):
    """One walk per policy and seed.

    Attributes:
        strokes: Velocity and duration of each stroke.
    """

    name: ClassVar[str] = "letters"
    title: ClassVar[str] = "Figure 11: open-loop letters"
    method: ClassVar[str] = (
        "The robot is commanded the velocities of the letters Z, J and U (1.5 m high, 0.5 m/s, with sideways walking, turns "
        "on the spot and arcs) without position feedback. The deviation is the distance between the robot and the place "
        "that the commands lead to at the same instant."
    )
    strokes: tuple[Stroke, ...] = LETTERS

    @override
    def jobs(self, study: Study) -> list[Job]:
        return walk_jobs(study, walk_letters, self.strokes)

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        commanded = reference_path(self.strokes)
        records: list[Record] = []
        for labels, (path, stood) in answers:
            for i in range(0, 0 if path is None else len(path), CSV_INTERVAL_TICKS):
                numbers = (
                    i * CONTROL_PERIOD_S,
                    *commanded[i],
                    *path[i],
                    float(np.hypot(*(path[i] - commanded[i])[:2])),
                )
                names = ("time", "asked_x", "asked_y", "asked_heading", "x", "y", "heading", "deviation")
                records.append({**labels, **dict(zip(names, numbers, strict=True)), "fell": int(not stood)})
        return records

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        policies = distinct(records, "policy")
        figure = Figure(figsize=(6.5 * len(policies), 4.2), layout="constrained")
        for panel, policy in zip(figure.subplots(1, len(policies), squeeze=False)[0], policies, strict=True):
            mine = select(records, policy=policy)
            first = select(mine, seed=mine[0]["seed"])
            panel.plot(column(first, "asked_x"), column(first, "asked_y"), "k--", label="commanded")
            for seed in distinct(mine, "seed"):
                one = select(mine, seed=seed)
                panel.plot(column(one, "x"), column(one, "y"), label=f"walked, seed {seed}")
            panel.set_title(f"{policy}: mean deviation {mean(mine, 'deviation'):.2f} m")
            panel.set_aspect("equal")
            panel.set_xlabel("x, m")
            panel.set_ylabel("y, m")
            panel.legend(fontsize="small", loc="upper left", bbox_to_anchor=(0.0, -0.18), ncols=4)
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        def end(mine: Sequence[Record], name: str) -> float:
            return mean([select(mine, seed=seed)[-1] for seed in distinct(mine, "seed")], name)

        def turned(mine: Sequence[Record]) -> float:
            return float(np.abs(column(mine, "heading") - column(mine, "asked_heading")).max())

        return [
            Row("mean deviation", "m", None, by_policy(records, lambda r: mean(r, "deviation")), key=True),
            Row("largest deviation", "m", None, by_policy(records, lambda r: largest(r, "deviation"))),
            Row("deviation at the end, mean", "m", None, by_policy(records, lambda r: end(r, "deviation"))),
            Row("largest error of the heading", "rad", None, by_policy(records, turned)),
            Row("falls", "", 0.0, by_policy(records, lambda r: end(r, "fell")), 0),
        ]

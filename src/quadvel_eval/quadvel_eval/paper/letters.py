"""Figure 11: the letters ZJU, walked in open loop, and how far the robot strays from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from quadvel_follow.trajectory import SHIPPED_FOLDER, Trajectory, read_table

from ..robot_loop import PERIOD
from ..walk import Setup, Walk, make_loop, record_to_the_fall
from .cells import Command
from .section import (
    Answers,
    Job,
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
    walks,
)

Array = NDArray[np.float64]

SHOWN = 10  # ticks from one line of the CSV to the next
Stroke = tuple[Command, float]  # velocity in the body frame and its seconds


def _strokes() -> tuple[Stroke, ...]:
    """Z without turning, J from its hook, U sideways over to its top."""
    _, rows = read_table(SHIPPED_FOLDER / "zju.csv")
    return tuple(((vx, vy, wz), seconds) for seconds, vx, vy, wz in rows.tolist())


LETTERS = _strokes()


def reference(strokes: Sequence[Stroke]) -> Array:
    """Where the commands lead (n, 3): x, y (m) and heading (rad), a row a tick, from the origin facing +x."""
    commands, seconds = zip(*strokes, strict=True)
    return Trajectory.from_commands(seconds, commands, PERIOD).pose


def walked(walk: Walk) -> Array:
    """Where the robot went (n, 3): x, y (m) and heading (rad), from where and as it stood at the first command."""
    cos, sin = np.cos(walk.heading[0]), np.sin(walk.heading[0])
    x, y = (walk.position[:, :2] - walk.position[0, :2]).T
    return np.column_stack([cos * x + sin * y, -sin * x + cos * y, walk.heading - walk.heading[0]])


def write_letters(setup: Setup, seed: int, strokes: Sequence[Stroke]) -> tuple[Array | None, bool]:
    """The way of a robot that is commanded the strokes, (n, 3), and whether it stood to the end."""
    walk, stood = record_to_the_fall(make_loop(setup, seed, ()), strokes)
    return (None if walk is None else walked(walk)), stood


@attrs.frozen
class Letters(Section):
    """One walk a policy and seed."""

    name: ClassVar[str] = "letters"
    title: ClassVar[str] = "Figure 11: open-loop letters"
    method: ClassVar[str] = (
        "The robot is commanded the velocities of the letters Z, J and U (1.5 m high, 0.5 m/s, with sideways walking, turns "
        "on the spot and arcs) and is not told where it is. The deviation is the distance between the robot and the place "
        "that the commands lead to at the same instant."
    )
    strokes: tuple[Stroke, ...] = LETTERS

    def jobs(self, study: Study) -> list[Job]:
        return walks(study, write_letters, self.strokes)

    def judge(self, answers: Answers) -> list[Record]:
        asked = reference(self.strokes)
        records: list[Record] = []
        for labels, (way, stood) in answers:
            for i in range(0, 0 if way is None else len(way), SHOWN):
                numbers = (i * PERIOD, *asked[i], *way[i], float(np.hypot(*(way[i] - asked[i])[:2])))
                names = ("time", "asked_x", "asked_y", "asked_heading", "x", "y", "heading", "deviation")
                records.append({**labels, **dict(zip(names, numbers, strict=True)), "fell": int(not stood)})
        return records

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

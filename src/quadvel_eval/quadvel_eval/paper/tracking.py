"""Figure 10: velocity tracking over the paper's grid, and over the quick grid, where the robot turns as it walks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure

from ..grid import cells
from ..report import heatmaps
from .cells import cell_job, cell_record, limits, within
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
)

MIRRORED = {"vx": 1.0, "vy": -1.0, "wz": -1.0}


def left_right(records: Sequence[Record]) -> float:
    """Largest difference (m/s) between the errors of a command and its mirror image; nan where there is no pair."""
    errors = {(r["vx"], r["vy"], r["wz"], r["seed"]): r["error_xy"] for r in records}
    pairs = [
        (error, errors.get((vx, -vy, -wz, seed)))
        for (vx, vy, wz, seed), error in errors.items()
        if error is not None and (vy or wz)
    ]
    return max((abs(a - b) for a, b in pairs if b is not None), default=float("nan"))


@attrs.frozen
class Tracking(Section):
    """Each command of the grids with each seed."""

    name: ClassVar[str] = "tracking"
    title: ClassVar[str] = "Figure 10: velocity tracking"
    method: ClassVar[str] = (
        "Each robot follows one command for 6 s from standing; the error is the length of commanded minus mean velocity "
        "over the last 4 s. The paper's grid is vx -2.5 to 2.5 by 0.5 and vy -1 to 1 by 0.2 m/s; the quick grid holds vx -1 "
        "to 1.5, vy -0.4 to 0.4 m/s and wz -1 to 1 rad/s. A command beyond the limits in a policy's file is cut to them "
        "before the policy sees it, and judged as it was asked for. A cross in the picture: a robot fell."
    )
    grids: tuple[str, ...] = ("paper", "quick")

    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            bounds = limits(study, policy)
            for grid in self.grids:
                for cell in cells(grid, study.seeds):
                    labels = {"policy": policy, "grid": grid, "within": int(within(cell.command, bounds))}
                    jobs.append(cell_job(study.setup(policy), cell.command, cell.seed, **labels))
        return jobs

    def judge(self, answers: Answers) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    def figure(self, records: Sequence[Record]) -> Figure:
        panels = {}
        for policy in distinct(records, "policy"):
            mine = select(records, policy=policy, grid=self.grids[0])
            title = f"{policy}: mean {mean(mine, 'error_xy'):.3f}, max {largest(mine, 'error_xy'):.3f} m/s"
            panels[title] = [{**r, "command": [r["vx"], r["vy"], r["wz"]]} for r in mine]
        return heatmaps(panels)

    def rows(self, records: Sequence[Record]) -> list[Row]:
        paper = {"paper": (None, 0.084), "quick": (None, None)}
        rows = []
        for grid in distinct(records, "grid"):
            mine = select(records, grid=grid)
            inside = select(mine, within=1)
            known_mean, known_max = paper[grid]
            rows += [
                Row(f"{grid} grid, runs", "", None, by_policy(mine, len), 0),
                Row(f"{grid} grid, falls", "", 0.0, by_policy(mine, lambda r: column(r, "fell").sum()), 0),
                Row(f"{grid} grid, mean error", "m/s", known_mean, by_policy(mine, _mean_error)),
                Row(f"{grid} grid, largest error", "m/s", known_max, by_policy(mine, _largest_error)),
                Row(f"{grid} grid, commands within the policy's limits", "", None, by_policy(inside, len), 0),
                Row(f"{grid} grid, mean error of these", "m/s", known_mean, by_policy(inside, _mean_error)),
                Row(
                    f"{grid} grid, largest error of these",
                    "m/s",
                    known_max,
                    by_policy(inside, _largest_error),
                ),
                Row(
                    f"{grid} grid, left-right difference of these", "m/s", None, by_policy(inside, left_right)
                ),
            ]
        return rows


def _mean_error(records: Sequence[Record]) -> float:
    return mean(records, "error_xy")


def _largest_error(records: Sequence[Record]) -> float:
    return float(np.float64(largest(records, "error_xy")))

"""Figure 10: velocity tracking over the paper's grid and over the quick grid, on two plants.

`cells` makes the record of one walk; `study` runs the section.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import ClassVar

import attrs
from matplotlib.figure import Figure
from typing_extensions import override

from ..grid import PLANTS, grid_cells
from ..report import error_heatmaps
from .cells import (
    cell_job,
    cell_record,
    command_limits,
    count_falls,
    is_within_limits,
    largest_error,
    largest_turn_error,
    mean_error,
    mean_turn_error,
)
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, select

PAPER_LARGEST_ERROR = 0.084  # m/s, the paper's largest error


def left_right_difference(records: Sequence[Record]) -> float:
    """Return the largest difference between the errors of a command and its mirror image.

    Args:
        records: Records of `cell_record`.

    Returns:
        Difference, m/s; nan without a pair.
    """
    errors = {(r["vx"], r["vy"], r["wz"], r["seed"]): r["error_xy"] for r in records}
    pairs = [
        (error, errors.get((vx, -vy, -wz, seed)))
        for (vx, vy, wz, seed), error in errors.items()
        if error is not None and (vy or wz)
    ]
    return max((abs(a - b) for a, b in pairs if b is not None), default=float("nan"))


@attrs.frozen
class Tracking(Section):
    """Walks of each command of the grids with each seed.

    Attributes:
        grids: Keys of `grid.GRIDS`.
    """

    name: ClassVar[str] = "tracking"
    title: ClassVar[str] = "Figure 10: velocity tracking"
    method: ClassVar[str] = (
        "Each robot follows one command for 6 s from standing; the error is the length of commanded minus mean velocity "
        "over the last 4 s. The paper's grid is vx -2.5 to 2.5 by 0.5 and vy -1 to 1 by 0.2 m/s; the quick grid holds vx -1 "
        "to 1.5, vy -0.4 to 0.4 m/s and wz -1 to 1 rad/s. A command beyond the limits in a policy's file is cut to them "
        "before the policy sees it, and evaluated against the original command. A cross in the picture: a robot fell. The second "
        "plant is MuJoCo at 0.5 ms with pyramidal friction cones, contacts twice as stiff, friction against turning feet, and "
        "links 3 % heavier with 15 % more inertia."
    )
    grids: tuple[str, ...] = ("paper", "quick")

    @override
    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            bounds = command_limits(study, policy)
            for (plant, fields), grid in itertools.product(PLANTS.items(), self.grids):
                setup = study.setup(policy, **fields)
                for cell in grid_cells(grid, study.seeds):
                    inside = int(is_within_limits(cell.command, bounds))
                    labels = {"policy": policy, "plant": plant, "grid": grid, "within": inside}
                    jobs.append(cell_job(setup, cell.command, cell.seed, **labels))
        return jobs

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        panels = {}
        for policy in distinct(records, "policy"):
            mine = select(records, policy=policy, plant="usual", grid=self.grids[0])
            title = f"{policy}: mean {mean_error(mine):.3f}, max {largest_error(mine):.3f} m/s"
            panels[title] = [{**r, "command": [r["vx"], r["vy"], r["wz"]]} for r in mine]
        return error_heatmaps(panels)

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows: list[Row] = []
        for grid in distinct(records, "grid"):
            rows += _rows(grid, select(records, grid=grid, plant="usual"))
            rows += _second_rows(grid, select(records, grid=grid, plant="second", within=1))
        return rows


def _second_rows(grid: str, records: Sequence[Record]) -> list[Row]:
    """Rows of one grid on the second plant, within the policies' limits."""
    where = f"{grid} grid, second plant"
    return [
        Row(f"{where}: runs", "", None, by_policy(records, len), digits=0),
        Row(f"{where}: falls", "", 0.0, by_policy(records, count_falls), digits=0, key=True),
        Row(f"{where}: mean error", "m/s", None, by_policy(records, mean_error), key=True),
        Row(f"{where}: largest error", "m/s", None, by_policy(records, largest_error), key=True),
        *_turn_rows(where, records),
    ]


def _turn_rows(where: str, records: Sequence[Record]) -> list[Row]:
    """Rows of the yaw rate errors."""
    return [
        Row(
            f"{where}: mean error of the yaw rate",
            "rad/s",
            None,
            by_policy(records, mean_turn_error),
            key=True,
        ),
        Row(
            f"{where}: largest error of the yaw rate",
            "rad/s",
            None,
            by_policy(records, largest_turn_error),
            key=True,
        ),
    ]


def _rows(grid: str, records: Sequence[Record]) -> list[Row]:
    """Rows of one grid on the usual plant; the paper gives a value for its own grid only."""
    paper = PAPER_LARGEST_ERROR if grid == "paper" else None
    every, inside = f"{grid} grid, all", f"{grid} grid, within the policy's limits"
    within_limits = select(records, within=1)
    return [
        Row(f"{every}: runs", "", None, by_policy(records, len), digits=0),
        Row(f"{every}: falls", "", 0.0, by_policy(records, count_falls), digits=0, key=True),
        Row(f"{every}: mean error", "m/s", None, by_policy(records, mean_error), key=True),
        Row(f"{every}: largest error", "m/s", paper, by_policy(records, largest_error), key=True),
        Row(f"{inside}: runs", "", None, by_policy(within_limits, len), digits=0),
        Row(f"{inside}: falls", "", 0.0, by_policy(within_limits, count_falls), digits=0),
        Row(f"{inside}: mean error", "m/s", None, by_policy(within_limits, mean_error), key=True),
        Row(f"{inside}: largest error", "m/s", paper, by_policy(within_limits, largest_error), key=True),
        *_turn_rows(inside, within_limits),
        Row(
            f"{inside}: largest left-right difference",
            "m/s",
            None,
            by_policy(within_limits, left_right_difference),
            key=True,
        ),
    ]

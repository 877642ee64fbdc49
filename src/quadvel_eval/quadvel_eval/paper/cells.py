"""Walks of one command, as the grid of `quadvel eval` makes them, as jobs and records of the paper's sections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from quadvel_policy.observation import COMMAND_AXES
from quadvel_policy.policy_file import PolicyFile

from ..grid import Cell, CellResult, run_cell
from ..walk import Setup
from .section import Job, Record, Study, column, largest, mean

Command = tuple[float, float, float]


def cell_job(setup: Setup, command: Command, seed: int, **labels: Any) -> Job:
    """Six seconds of a command (vx, vy, wz) from standing, of which the last four count."""
    return Job(labels, (run_cell, setup, Cell(command, seed), ()))


def cell_record(labels: Record, result: CellResult) -> Record:
    """The line of the CSV: command, seed, mean velocity and errors (m/s, rad/s), jitter (rad), cost of transport."""
    cell, segment = result.cell, result.segment
    mean = [None] * 3 if segment is None else segment.mean.tolist()
    return {
        **labels,
        **dict(zip(("vx", "vy", "wz"), (round(c, 6) for c in cell.command), strict=True)),
        "seed": cell.seed,
        **dict(zip(("mean_vx", "mean_vy", "mean_wz"), mean, strict=True)),
        "error_xy": None if segment is None else segment.error_xy,
        "error_wz": None if segment is None else segment.error_wz,
        "jitter": result.jitter,
        "cot": result.cot,
        "fell": int(segment is None),
    }


def falls(records: Sequence[Record]) -> float:
    """How many robots fell."""
    return float(column(records, "fell").sum())


def mean_error(records: Sequence[Record]) -> float:
    """Of the mean velocities of the robots that did not fall, m/s."""
    return mean(records, "error_xy")


def largest_error(records: Sequence[Record]) -> float:
    """Of the mean velocities of the robots that did not fall, m/s."""
    return largest(records, "error_xy")


def limits(study: Study, policy: str) -> dict[str, tuple[float, float]]:
    """The commands that a policy takes, (lowest, highest) by axis vx, vy, wz: m/s, rad/s."""
    bounds = PolicyFile(study.policies[policy]).metadata.command_limits
    return {axis: (float(bounds[axis][0]), float(bounds[axis][1])) for axis in COMMAND_AXES}


def within(command: Command, bounds: dict[str, tuple[float, float]]) -> bool:
    """Whether a policy with these limits takes the command as it is."""
    return all(
        low - 1e-9 <= value <= high + 1e-9
        for value, (low, high) in zip(command, bounds.values(), strict=True)
    )


def reach(direction: Command, bounds: dict[str, tuple[float, float]]) -> float:
    """How long the command along `direction` (one axis, of length 1) may become; m/s or rad/s."""
    ends = [
        (high if d > 0 else -low) / abs(d)
        for d, (low, high) in zip(direction, bounds.values(), strict=True)
        if d
    ]
    return min(ends, default=math.inf)

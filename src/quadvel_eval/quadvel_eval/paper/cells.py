"""Walks of one command, as the grid of `quadvel eval` makes them, as jobs and records of the paper's sections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadvel_policy.observation import CommandLimits
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


def mean_turn_error(records: Sequence[Record]) -> float:
    """Of the mean yaw rates of the robots that did not fall, rad/s."""
    return mean(records, "error_wz")


def largest_turn_error(records: Sequence[Record]) -> float:
    """Of the mean yaw rates of the robots that did not fall, rad/s."""
    return largest(records, "error_wz")


def limits(study: Study, policy: str) -> CommandLimits:
    """The commands that a policy takes."""
    return PolicyFile(study.policies[policy]).metadata.limits


def within(command: Command, taken: CommandLimits) -> bool:
    """Whether a policy with these limits takes the command as it is."""
    return bool(np.allclose(taken.clamp(command), command, rtol=0.0, atol=1e-9))


def reach(direction: Command, bounds: CommandLimits) -> float:
    """How long the command along `direction` (one axis, of length 1) may become; m/s or rad/s."""
    ends = [
        (high if d > 0 else -low) / abs(d)
        for d, low, high in zip(direction, bounds.low, bounds.high, strict=True)
        if d
    ]
    return min(ends, default=math.inf)

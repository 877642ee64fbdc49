"""Jobs and records of walks of one command, as on the grid of `quadvel eval`.

`conditions` varies the plants of such walks; the sections of this folder choose the commands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadvel_description.robot import load_robot
from quadvel_policy.observation import VelocityCommandLimits
from quadvel_policy.policy_file import PolicyFile

from ..grid import Cell, CellResult, run_cell
from ..walk import Setup
from .section import Job, Record, Study, column, largest, mean

Command = tuple[float, float, float]


def cell_job(setup: Setup, command: Command, seed: int, **labels: Any) -> Job:
    """Create a job that walks one command from standing for 6 s; the last 4 s count.

    Args:
        setup: Robot, policy and ground.
        command: vx, vy (m/s), wz (rad/s).
        seed: Seed of the run.
        **labels: Further columns.

    Returns:
        The job.
    """
    without_shadow_estimators = ()
    return Job(labels, (run_cell, setup, Cell(command, seed), without_shadow_estimators))


def cell_record(labels: Record, result: CellResult) -> Record:
    """Create the record of a run.

    Args:
        labels: Further columns.
        result: Figures of the run.

    Returns:
        Command, seed, mean velocity and errors (m/s, rad/s), jitter (rad), cost of transport.
    """
    cell, segment = result.cell, result.segment
    mean_velocity = [None] * 3 if segment is None else segment.mean.tolist()
    return {
        **labels,
        **dict(zip(("vx", "vy", "wz"), (round(c, 6) for c in cell.command), strict=True)),
        "seed": cell.seed,
        **dict(zip(("mean_vx", "mean_vy", "mean_wz"), mean_velocity, strict=True)),
        "error_xy": None if segment is None else segment.error_xy,
        "error_wz": None if segment is None else segment.error_wz,
        "jitter": result.jitter,
        "cot": result.cot,
        "fell": int(segment is None),
    }


def count_falls(records: Sequence[Record]) -> float:
    """Count the falls.

    Args:
        records: Records of `cell_record`.

    Returns:
        Number of robots that fell.
    """
    return float(column(records, "fell").sum())


def mean_error(records: Sequence[Record]) -> float:
    """Return the mean velocity error of the robots that did not fall.

    Args:
        records: Records of `cell_record`.

    Returns:
        Error, m/s.
    """
    return mean(records, "error_xy")


def largest_error(records: Sequence[Record]) -> float:
    """Return the largest velocity error of the robots that did not fall.

    Args:
        records: Records of `cell_record`.

    Returns:
        Error, m/s.
    """
    return largest(records, "error_xy")


def mean_turn_error(records: Sequence[Record]) -> float:
    """Return the mean yaw rate error of the robots that did not fall.

    Args:
        records: Records of `cell_record`.

    Returns:
        Error, rad/s.
    """
    return mean(records, "error_wz")


def largest_turn_error(records: Sequence[Record]) -> float:
    """Return the largest yaw rate error of the robots that did not fall.

    Args:
        records: Records of `cell_record`.

    Returns:
        Error, rad/s.
    """
    return largest(records, "error_wz")


def command_limits(study: Study, policy: str) -> VelocityCommandLimits:
    """Read the command limits of a policy from its file.

    Args:
        study: Policies by name.
        policy: Name of the policy.

    Returns:
        The limits.
    """
    return PolicyFile(load_robot(study.robot), study.policies[policy]).metadata.limits


def is_within_limits(command: Command, bounds: VelocityCommandLimits) -> bool:
    """Return whether command limits leave a command unchanged.

    Args:
        command: vx, vy (m/s), wz (rad/s).
        bounds: Limits of a policy.

    Returns:
        True if the policy receives the command as it is.
    """
    return bool(np.allclose(bounds.clamp(command), command, rtol=0.0, atol=1e-9))


def max_command_along(direction: Command, bounds: VelocityCommandLimits) -> float:
    """Return the largest command along one axis.

    Args:
        direction: Unit vector along one axis.
        bounds: Limits of a policy.

    Returns:
        Largest length of the command, m/s or rad/s.
    """
    ends = [
        (high if d > 0 else -low) / abs(d)
        for d, low, high in zip(direction, bounds.low, bounds.high, strict=True)
        if d
    ]
    return min(ends, default=math.inf)

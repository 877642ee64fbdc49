"""Walks of the same commands on many plants: conditions, survival rate and error plots.

`cells` makes the record of one walk; `slopes`, `robustness` and `gap` choose the conditions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from matplotlib.axes import Axes

from quadvel_sim.physics import HELD_OUT_PHYSICS

from ..grid import COMMAND_DURATION_S, PLANTS, Cell, CellResult, evaluate_walk, robot_mass
from ..walk import Setup, make_loop, record_walk
from .cells import Command
from .section import Job, Record, Study, distinct, mean, select

COMMANDS: tuple[Command, ...] = ((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.6, 0.0, 0.6))
"""Forward, lateral and curved walk: vx, vy (m/s), wz (rad/s)."""
LOOSE_JOINTS: Mapping[str, Any] = {
    "physics": HELD_OUT_PHYSICS,
    "joint_friction": np.zeros(12),
    "joint_damping": np.zeros(12),
}
"""Fields of `SimulatorConfig`: second plant, with joints without friction and damping."""
HARD_PLANTS: Mapping[str, Mapping[str, Any]] = {**PLANTS, "loose joints": LOOSE_JOINTS}
PLANT_NAMES = {"second": "second plant", "loose joints": "second plant, loose joints"}
"""Names in table rows of the plants of HARD_PLANTS other than the usual one."""
PUSH_START_S, PUSH_DURATION_S = 1.0, 0.2  # after the start of the walk


@attrs.frozen
class Condition:
    """Deviation from the nominal robot on flat ground.

    Attributes:
        group: Group of the condition.
        level: Name within the group.
        plant: Fields of `SimulatorConfig`.
        push: Force on the trunk for PUSH_DURATION_S, N, world frame; None: no push.
        standing_time: Time that the robot stands before its command, s.
    """

    group: str
    level: str
    plant: Mapping[str, Any] = attrs.field(factory=dict)
    push: tuple[float, float, float] | None = None
    standing_time: float = 0.0

    @property
    def labels(self) -> Record:
        """Group and level, as columns of a record."""
        return {"group": self.group, "level": self.level}


def walk_under(
    setup: Setup, cell: Cell, push: tuple[float, float, float] | None, standing_time: float = 0.0
) -> CellResult:
    """Walk one command like `grid.run_cell`, after standing, and with an optional push.

    Args:
        setup: Robot, policy and estimator.
        cell: Command and seed.
        push: Force on the trunk, N, world frame, for PUSH_DURATION_S from PUSH_START_S on.
        standing_time: Time that the robot stands first, s.

    Returns:
        The figures of the walk.
    """
    loop = make_loop(setup, cell.seed, ())
    if standing_time and record_walk(loop, [((0.0, 0.0, 0.0), standing_time)]) is None:
        return CellResult(cell)
    if push is not None:
        if record_walk(loop, [(cell.command, PUSH_START_S)]) is None:
            return CellResult(cell)
        loop.simulator.push("trunk", push, duration=PUSH_DURATION_S)
    walk = record_walk(loop, [(cell.command, COMMAND_DURATION_S)])
    return evaluate_walk(walk, cell, robot_mass(loop)) if walk else CellResult(cell)


def condition_job(study: Study, policy: str, one: Condition, command: Command, seed: int) -> Job:
    """Create the job of a policy's walk under a condition.

    Args:
        study: Policies and estimator.
        policy: Name of the policy.
        one: The condition.
        command: vx, vy (m/s), wz (rad/s).
        seed: Seed of the run.

    Returns:
        The job.
    """
    setup = study.setup(policy, **one.plant)
    return Job(
        {"policy": policy, **one.labels},
        (walk_under, setup, Cell(command, seed), one.push, one.standing_time),
    )


def survival_rate(records: Sequence[Record]) -> float:
    """Return the share of robots that did not fall.

    Args:
        records: Records of `cell_record`.

    Returns:
        Share, %; nan without records.
    """
    return 100.0 * (1.0 - mean(records, "fell"))


def draw_error_and_survival(error: Axes, stood: Axes, records: Sequence[Record]) -> None:
    """Draw mean error and survival rate of each policy over the levels of one group.

    Args:
        error: Panel of the error.
        stood: Panel of the survival rate.
        records: Records of the group.
    """
    levels = distinct(records, "level")
    policies = distinct(records, "policy")
    places, width = np.arange(len(levels)), 0.8 / len(policies)
    for k, policy in enumerate(policies):
        groups = [select(records, policy=policy, level=level) for level in levels]
        left = places + k * width
        error.bar(left, [mean(group, "error_xy") for group in groups], width, label=policy, align="edge")
        stood.bar(left, [survival_rate(group) for group in groups], width, align="edge")
    for panel in (error, stood):
        panel.set_xticks(places + 0.4, [str(level) for level in levels])
        panel.set_xlim(-0.2, len(levels))
    stood.set_ylim(0.0, 105.0)

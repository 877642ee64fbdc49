"""Sections that walk the same commands on many plants: what a condition is, and how survival and error are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from matplotlib.axes import Axes

from quadvel_sim.physics import HELD_OUT_PHYSICS

from ..grid import DURATION, PLANTS, Cell, CellResult, judge, mass
from ..walk import Setup, make_loop, record
from .cells import Command
from .section import Job, Record, Study, distinct, mean, select

COMMANDS: tuple[Command, ...] = ((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.6, 0.0, 0.6))
"""ahead, sideways, along an arc; m/s, rad/s"""
LOOSE: Mapping[str, Any] = {
    "physics": HELD_OUT_PHYSICS,
    "joint_friction": np.zeros(12),
    "joint_damping": np.zeros(12),
}
"""Fields of `SimulatorConfig`: the second plant with joints that have neither friction nor damping."""
HARD_PLANTS: Mapping[str, Mapping[str, Any]] = {**PLANTS, "loose joints": LOOSE}
PLANT_NAMES = {"second": "second plant", "loose joints": "second plant, loose joints"}
"""As rows name those of HARD_PLANTS that are not the usual one."""
PUSH_TIME, PUSH_SECONDS = 1.0, 0.2  # s after the start of a walk, and for how long


@attrs.frozen
class Condition:
    """What differs from the nominal robot on flat ground."""

    group: str
    level: str
    plant: Mapping[str, Any] = attrs.field(factory=dict)
    """fields of SimulatorConfig"""
    push: tuple[float, float, float] | None = None
    """N on the trunk, world frame, for PUSH_SECONDS"""
    stood: float = 0.0
    """s that the robot stands there before its command"""

    @property
    def labels(self) -> Record:
        """As records hold it."""
        return {"group": self.group, "level": self.level}


def walk_under(
    setup: Setup, cell: Cell, push: tuple[float, float, float] | None, stood: float = 0.0
) -> CellResult:
    """As `grid.run_cell`, without other estimators, after standing, and with a push if there is one.

    Args:
        setup: robot, policy and estimator.
        cell: the command and the seed.
        push: force on the trunk, N, world frame, for PUSH_SECONDS from PUSH_TIME on.
        stood: how long the robot is commanded to stand first, s.
    """
    loop = make_loop(setup, cell.seed, ())
    if stood and record(loop, [((0.0, 0.0, 0.0), stood)]) is None:
        return CellResult(cell)
    if push is not None:
        if record(loop, [(cell.command, PUSH_TIME)]) is None:
            return CellResult(cell)
        loop.simulator.push("trunk", push, duration=PUSH_SECONDS)
    walk = record(loop, [(cell.command, DURATION)])
    return judge(walk, cell, mass(loop)) if walk else CellResult(cell)


def condition_job(study: Study, policy: str, one: Condition, command: Command, seed: int) -> Job:
    """A policy's walk under a condition."""
    setup = study.setup(policy, **one.plant)
    return Job(
        {"policy": policy, **one.labels}, (walk_under, setup, Cell(command, seed), one.push, one.stood)
    )


def survival(records: Sequence[Record]) -> float:
    """Share of the robots that did not fall, %; nan without any."""
    return 100.0 * (1.0 - mean(records, "fell"))


def draw(error: Axes, stood: Axes, records: Sequence[Record]) -> None:
    """Mean error and survival of each policy over the levels of one group."""
    levels = distinct(records, "level")
    policies = distinct(records, "policy")
    places, width = np.arange(len(levels)), 0.8 / len(policies)
    for k, policy in enumerate(policies):
        groups = [select(records, policy=policy, level=level) for level in levels]
        left = places + k * width
        error.bar(left, [mean(group, "error_xy") for group in groups], width, label=policy, align="edge")
        stood.bar(left, [survival(group) for group in groups], width, align="edge")
    for panel in (error, stood):
        panel.set_xticks(places + 0.4, [str(level) for level in levels])
        panel.set_xlim(-0.2, len(levels))
    stood.set_ylim(0.0, 105.0)

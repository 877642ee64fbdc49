"""Evaluates velocity tracking over a grid of commands in parallel processes (`quadvel eval`).

This module computes the figures. Module `report` writes files and pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_sim.physics import HELD_OUT_PHYSICS

from .pool import Call, run_in_parallel
from .robot_loop import RobotLoop
from .segments import SETTLING_TIME_S, Segment, measure_segment, response_delay, rounded, tracking_errors
from .walk import Setup, Walk, cost_of_transport, jitter, make_loop, record_walk

SCHEMA = 1
COMMAND_DURATION_S = 6.0  # of each command; the last 4 s are evaluated
GRIDS: dict[str, tuple[Array, Array, Array]] = {  # all combinations of vx, vy (m/s) and wz (rad/s)
    "quick": (np.arange(-2, 4) / 2, np.array([-0.4, 0.0, 0.4]), np.array([-1.0, 0.0, 1.0])),
    "paper": (np.arange(-5, 6) / 2, np.arange(-5, 6) / 5, np.array([0.0])),
    "tiny": (np.array([0.5, 1.0]), np.array([0.0]), np.array([0.0, 0.5])),
}
WALK_BEFORE_STANCE = [
    ((0.5, 0.0, 0.0), 2.0),
    ((0.0, 0.0, 0.0), 2.0),
]  # velocities and durations (s) before standing
STANCE_DURATION_S = 10.0
MIN_SPEED_FOR_DELAY, MIN_YAW_RATE_FOR_DELAY = (
    0.2,
    0.3,
)  # m/s, rad/s: for slower commands the delay is undefined
PLANTS: dict[str, Mapping[str, Any]] = {"usual": {}, "second": {"physics": HELD_OUT_PHYSICS}}
"""Plants of the evaluation, as fields of `SimulatorConfig`; the second one solves contacts differently."""


@attrs.frozen
class Cell:
    """One run of the grid.

    Attributes:
        command: Commanded vx, vy (m/s) and wz (rad/s), body frame.
        seed: Seed of sensor noise, terrain and randomised plants.
    """

    command: tuple[float, float, float]
    seed: int


@attrs.frozen
class CellResult:
    """Figures of one run; only `cell` is set if the robot fell.

    Attributes:
        cell: The run.
        segment: Command and mean velocity after the settling time; None if the robot fell.
        jitter: Mean absolute second difference of the joint targets of three ticks (5 ms each), rad.
        cot: Cost of transport or of turning (Eq. 10 of the paper), without unit; None if the robot does not
            follow.
        estimator_mse: Mean square error of each estimator over the whole walk, (3,), (m/s)^2.
        estimator_drift: Final dead reckoning error of each estimator, m.
        path_length: Horizontal path length of the trunk, m.
        delay_xy: Delay of the velocity along the command, s; None for slow commands.
        delay_wz: Delay of the yaw rate, s; None for slow commands.
    """

    cell: Cell
    segment: Segment | None = None
    jitter: float | None = None
    cot: float | None = None
    estimator_mse: dict[str, Array] = attrs.Factory(dict)
    estimator_drift: dict[str, float] = attrs.Factory(dict)
    path_length: float = 0.0
    delay_xy: float | None = None
    delay_wz: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Convert the result to its entry in `eval.json`.

        Returns:
            Command, seed, mean velocity, errors and whether the robot fell.
        """
        s = self.segment
        return {
            "command": rounded(self.cell.command),
            "seed": self.cell.seed,
            "mean": rounded(s.mean) if s else None,
            "error_xy": rounded(s.error_xy) if s else None,
            "error_wz": rounded(s.error_wz) if s else None,
            "fell": s is None,
        }


def grid_cells(grid: str, seeds: int) -> list[Cell]:
    """List every command of a grid with every seed.

    Args:
        grid: Key of GRIDS.
        seeds: Number of seeds; they are 0, 1, ...

    Returns:
        Cells, seed by seed.
    """
    vx, vy, wz = GRIDS[grid]
    commands = [(float(x), float(y), float(z)) for x in vx for y in vy for z in wz]
    return [Cell(command, seed) for seed in range(seeds) for command in commands]


def run_cell(
    setup: Setup, cell: Cell, shadow_estimators: Sequence[str] = ("learned", "kalman")
) -> CellResult:
    """Simulate one robot that follows one command from standing for COMMAND_DURATION_S.

    Args:
        setup: Robot, policy, estimator and ground.
        cell: Command and seed.
        shadow_estimators: Further estimators to measure; they do not influence the robot.

    Returns:
        The figures of the run.
    """
    loop = make_loop(setup, cell.seed, shadow_estimators)
    walk = record_walk(loop, [(cell.command, COMMAND_DURATION_S)])
    return evaluate_walk(walk, cell, robot_mass(loop)) if walk else CellResult(cell)


def robot_mass(loop: RobotLoop) -> float:
    """Return the mass of the robot with its payload.

    Args:
        loop: Loop whose simulator holds the robot.

    Returns:
        Mass, kg.
    """
    return float(loop.simulator.model.body_subtreemass[1])


def evaluate_walk(walk: Walk, cell: Cell, mass: float) -> CellResult:
    """Compute the figures of a walk under one command.

    Args:
        walk: The recorded walk.
        cell: Command and seed of the walk.
        mass: Mass of robot and payload, kg.

    Returns:
        The figures; tracking, jitter and cost count from SETTLING_TIME_S on.
    """
    segment = measure_segment(walk.time, walk.velocity, cell.command, SETTLING_TIME_S, COMMAND_DURATION_S)
    late = walk.time >= SETTLING_TIME_S
    return CellResult(
        cell,
        segment,
        jitter(walk.targets[late]),
        cost_of_transport(float(walk.power[late].mean()), mass, segment.command, segment.mean),
        {name: np.square(error).mean(axis=0) for name, error in walk.estimate_errors.items()},
        walk.estimate_drifts,
        float(np.linalg.norm(np.diff(walk.position[:, :2], axis=0), axis=1).sum()),
        *_response_delays(walk, np.asarray(cell.command)),
    )


def _response_delays(walk: Walk, command: Array) -> tuple[float | None, float | None]:
    """Delays (s) of the velocity along the command and of the yaw rate; None for slow commands."""
    speed, turn = float(np.hypot(*command[:2])), abs(command[2])
    commanded, found, xy, wz = walk.commanded, walk.velocity, None, None
    if speed >= MIN_SPEED_FOR_DELAY:
        ahead = command[:2] / speed
        xy = response_delay(commanded[:, :2] @ ahead, found[:, :2] @ ahead, CONTROL_PERIOD_S)
    if turn >= MIN_YAW_RATE_FOR_DELAY:
        wz = response_delay(commanded[:, 2], found[:, 2], CONTROL_PERIOD_S)
    return xy, wz


def run_stance(setup: Setup, seed: int) -> float | None:
    """Measure the drift of a robot that stands for STANCE_DURATION_S after a short walk.

    The policy controls the robot throughout.

    Args:
        setup: Robot, policy, estimator and ground.
        seed: Seed of the run.

    Returns:
        Largest horizontal distance from the first position, m; None if the robot fell.
    """
    loop = make_loop(setup, seed)
    if record_walk(loop, WALK_BEFORE_STANCE) is None:
        return None
    walk = record_walk(loop, [((0.0, 0.0, 0.0), STANCE_DURATION_S)])
    return None if walk is None else max_displacement(walk.position)


def max_displacement(position: Array) -> float:
    """Return the largest horizontal distance from the first position.

    Args:
        position: Positions (n, 3), m.

    Returns:
        Distance, m.
    """
    return float(np.linalg.norm(position[:, :2] - position[0, :2], axis=1).max())


def summarise(results: Sequence[CellResult], drifts: Sequence[float | None]) -> dict[str, Any]:
    """Summarise runs and stances as the content of `eval.json`, without the setup.

    Aggregates cover the runs without a fall. If every robot fell, the errors are those of a
    robot that does not move, and the jitter is zero.

    Args:
        results: Results of the runs, in the order of the file.
        drifts: Drift of each stance, m; None for a fall.

    Returns:
        Cells and aggregates. `cot` has one entry per run, null if undefined.
    """
    stood = [r for r in results if r.segment is not None]
    segments = [r.segment for r in stood if r.segment is not None]
    still = [Segment(np.array(r.cell.command), np.zeros(3)) for r in results]
    return {
        "schema": SCHEMA,
        "cells": [r.to_json() for r in results],
        **tracking_errors(segments or still),
        "delay_xy": _mean_of_known([r.delay_xy for r in stood]),
        "delay_wz": _mean_of_known([r.delay_wz for r in stood]),
        "falls": len(results) - len(stood),
        "jitter": rounded(np.mean([r.jitter for r in stood])) if stood else 0.0,
        "cot": [None if r.cot is None else rounded(r.cot) for r in results],
        "stance": {"drift_10s_m": _largest_drift(drifts)},
        "estimator": _estimator_errors(stood),
    }


def _mean_of_known(values: Sequence[float | None]) -> Any:
    """Mean of the known values, rounded; None without any."""
    known = [value for value in values if value is not None]
    return rounded(np.mean(known)) if known else None


def _largest_drift(drifts: Sequence[float | None]) -> Any:
    """Largest drift (m), rounded; None if a robot fell."""
    known = [drift for drift in drifts if drift is not None]
    return rounded(max(known)) if len(known) == len(drifts) else None


def _estimator_errors(stood: Sequence[CellResult]) -> dict[str, Any]:
    """RMSE of each estimator over all walks (m/s per axis), and drift divided by path length.

    Every walk has the same number of ticks, so that the mean of the mean squares is exact.
    """
    names = stood[0].estimator_mse if stood else ()
    path_length = sum(r.path_length for r in stood)
    return {
        name: {
            "rmse": rounded(np.sqrt(np.mean([r.estimator_mse[name] for r in stood], axis=0))),
            "drift": rounded(sum(r.estimator_drift[name] for r in stood) / path_length),
        }
        for name in names
    }


def evaluate(
    setup: Setup,
    grid: str,
    seeds: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Run the whole grid on all PLANTS in parallel.

    Args:
        setup: Robot, policy, estimator and ground; its own plant fields override those of PLANTS.
        grid: Key of GRIDS.
        seeds: Number of seeds.
        progress: Called with the number of finished runs and the number of all runs.
        cluster: Address of a Dask scheduler; None for the cores of this machine.

    Returns:
        Summary of the usual plant, and under `second_plant` that of the second plant.
    """
    todo = grid_cells(grid, seeds)
    calls: list[Call] = []
    for plant in PLANTS.values():
        there = attrs.evolve(setup, plant={**plant, **setup.plant})
        calls += [(run_cell, there, cell) for cell in todo]
        calls += [(run_stance, there, seed) for seed in range(seeds)]
    results: list[Any] = [None] * len(calls)
    for done, (i, result) in enumerate(run_in_parallel(calls, cluster), start=1):
        results[i] = result
        progress(done, len(calls))
    usual, second = results[: len(calls) // 2], results[len(calls) // 2 :]
    return {
        **summarise(usual[: len(todo)], usual[len(todo) :]),
        "second_plant": summarise(second[: len(todo)], second[len(todo) :]),
    }

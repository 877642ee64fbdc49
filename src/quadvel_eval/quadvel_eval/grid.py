"""Velocity tracking over a grid of commands, in parallel processes: what `quadvel eval` computes.

Files and pictures are `report`'s matter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_sim.physics import HELD_OUT_PHYSICS

from .pool import Call, in_parallel
from .robot_loop import PERIOD, RobotLoop
from .segments import SETTLE, Segment, measure, response_delay, rounded, tracking_errors
from .walk import Setup, Walk, cost_of_transport, jitter, make_loop, record

Array = NDArray[np.float64]

SCHEMA = 1
DURATION = 6.0  # s of each command, of which the last 4 are evaluated
GRIDS: dict[str, tuple[Array, Array, Array]] = {  # vx, vy (m/s), wz (rad/s): every combination
    "quick": (np.arange(-2, 4) / 2, np.array([-0.4, 0.0, 0.4]), np.array([-1.0, 0.0, 1.0])),
    "paper": (np.arange(-5, 6) / 2, np.arange(-5, 6) / 5, np.array([0.0])),
}
STANCE_WALK = [((0.5, 0.0, 0.0), 2.0), ((0.0, 0.0, 0.0), 2.0)]  # how the robot comes to stand
STANCE_SECONDS = 10.0
LEAST_SPEED, LEAST_TURN = 0.2, 0.3  # m/s, rad/s: of slower ones no delay can be told
PLANTS: dict[str, Mapping[str, Any]] = {"usual": {}, "second": {"physics": HELD_OUT_PHYSICS}}
"""Fields of `SimulatorConfig` of the plants that a policy is judged on: the usual one, and one that solves contacts otherwise."""


@attrs.frozen
class Cell:
    """One run of the grid."""

    command: tuple[float, float, float]
    seed: int


@attrs.frozen
class CellResult:
    """What came of it; a robot that fell has nothing but that."""

    cell: Cell
    segment: Segment | None = None
    jitter: float | None = None
    cot: float | None = None
    estimator_mse: dict[str, Array] = attrs.Factory(dict)  # (3,) (m/s)^2, over the whole walk
    estimator_drift: dict[str, float] = attrs.Factory(dict)  # m, at its end
    way: float = 0.0  # m, that the trunk went
    delay_xy: float | None = (
        None  # s, from the velocity asked for to the robot's, along the command; None: too slow to tell
    )
    delay_wz: float | None = None  # s, the same of the yaw rate

    def to_json(self) -> dict[str, Any]:
        """The entry of `eval.json`."""
        s = self.segment
        return {
            "command": rounded(self.cell.command),
            "seed": self.cell.seed,
            "mean": rounded(s.mean) if s else None,
            "error_xy": rounded(s.error_xy) if s else None,
            "error_wz": rounded(s.error_wz) if s else None,
            "fell": s is None,
        }


def cells(grid: str, seeds: int) -> list[Cell]:
    """Every command of the grid with every seed 0, 1, ..."""
    vx, vy, wz = GRIDS[grid]
    commands = [(float(x), float(y), float(z)) for x in vx for y in vy for z in wz]
    return [Cell(command, seed) for seed in range(seeds) for command in commands]


def run_cell(setup: Setup, cell: Cell, beside: Sequence[str] = ("learned", "kalman")) -> CellResult:
    """One robot from standing through `DURATION` of one command, with the estimators `beside`."""
    loop = make_loop(setup, cell.seed, beside)
    walk = record(loop, [(cell.command, DURATION)])
    return judge(walk, cell, mass(loop)) if walk else CellResult(cell)


def mass(loop: RobotLoop) -> float:
    """Of the robot and its payload, kg."""
    return float(loop.simulator.model.body_subtreemass[1])


def judge(walk: Walk, cell: Cell, mass: float) -> CellResult:
    """The figures of a walk under `cell.command`; mass: of the robot, kg."""
    segment = measure(walk.time, walk.velocity, cell.command, SETTLE, DURATION)
    late = walk.time >= SETTLE
    return CellResult(
        cell,
        segment,
        jitter(walk.targets[late]),
        cost_of_transport(float(walk.power[late].mean()), mass, segment.command, segment.mean),
        {name: np.square(error).mean(axis=0) for name, error in walk.estimate_errors.items()},
        walk.estimate_drifts,
        float(np.linalg.norm(np.diff(walk.position[:, :2], axis=0), axis=1).sum()),
        *_delays(walk, np.asarray(cell.command)),
    )


def _delays(walk: Walk, command: Array) -> tuple[float | None, float | None]:
    """Of the velocity along the command and of the yaw rate, s."""
    speed, turn = float(np.hypot(*command[:2])), abs(command[2])
    asked, found, xy, wz = walk.asked, walk.velocity, None, None
    if speed >= LEAST_SPEED:
        ahead = command[:2] / speed
        xy = response_delay(asked[:, :2] @ ahead, found[:, :2] @ ahead, PERIOD)
    if turn >= LEAST_TURN:
        wz = response_delay(asked[:, 2], found[:, 2], PERIOD)
    return xy, wz


def run_stance(setup: Setup, seed: int) -> float | None:
    """Largest distance (m) from where the robot came to stand, in 10 s of standing; None where it fell.

    The policy stands all the while, after a short walk.
    """
    loop = make_loop(setup, seed)
    if record(loop, STANCE_WALK) is None:
        return None
    walk = record(loop, [((0.0, 0.0, 0.0), STANCE_SECONDS)])
    return None if walk is None else drift(walk.position)


def drift(position: Array) -> float:
    """Largest horizontal distance from the first of the positions (n, 3), m."""
    return float(np.linalg.norm(position[:, :2] - position[0, :2], axis=1).max())


def summarise(results: Sequence[CellResult], drifts: Sequence[float | None]) -> dict[str, Any]:
    """`eval.json` without the description of the run: cells in the order given, aggregates that are numbers.

    Aggregates are taken over the cells that did not fall. Where all did, the errors are those of a robot that
    does not move, and jitter is zero. `cot` has one entry a cell, null where that has no number.
    """
    stood = [r for r in results if r.segment is not None]
    segments = [r.segment for r in stood if r.segment is not None]
    still = [Segment(np.array(r.cell.command), np.zeros(3)) for r in results]
    return {
        "schema": SCHEMA,
        "cells": [r.to_json() for r in results],
        **tracking_errors(segments or still),
        "delay_xy": _mean([r.delay_xy for r in stood]),
        "delay_wz": _mean([r.delay_wz for r in stood]),
        "falls": len(results) - len(stood),
        "jitter": rounded(np.mean([r.jitter for r in stood])) if stood else 0.0,
        "cot": [None if r.cot is None else rounded(r.cot) for r in results],
        "stance": {"drift_10s_m": _largest(drifts)},
        "estimator": _estimator_errors(stood),
    }


def _mean(values: Sequence[float | None]) -> Any:
    """Of those that are known, or None."""
    known = [value for value in values if value is not None]
    return rounded(np.mean(known)) if known else None


def _largest(drifts: Sequence[float | None]) -> Any:
    """The largest, or None where a robot fell."""
    known = [drift for drift in drifts if drift is not None]
    return rounded(max(known)) if len(known) == len(drifts) else None


def _estimator_errors(stood: Sequence[CellResult]) -> dict[str, Any]:
    """Root mean square over all walks, m/s an axis (every walk has the same number of ticks); drift over way."""
    names = stood[0].estimator_mse if stood else ()
    way = sum(r.way for r in stood)
    return {
        name: {
            "rmse": rounded(np.sqrt(np.mean([r.estimator_mse[name] for r in stood], axis=0))),
            "drift": rounded(sum(r.estimator_drift[name] for r in stood) / way),
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
    """Run the whole grid on all PLANTS as `pool.in_parallel` does; `progress` hears how many runs of how many are done.

    What comes of the usual plant, and under `second_plant` the same of the other one.
    """
    todo = cells(grid, seeds)
    calls: list[Call] = []
    for plant in PLANTS.values():
        there = attrs.evolve(setup, plant={**plant, **setup.plant})
        calls += [(run_cell, there, cell) for cell in todo]
        calls += [(run_stance, there, seed) for seed in range(seeds)]
    results: list[Any] = [None] * len(calls)
    for done, (i, result) in enumerate(in_parallel(calls, cluster), start=1):
        results[i] = result
        progress(done, len(calls))
    usual, second = results[: len(calls) // 2], results[len(calls) // 2 :]
    return {
        **summarise(usual[: len(todo)], usual[len(todo) :]),
        "second_plant": summarise(second[: len(todo)], second[len(todo) :]),
    }

"""Compares the velocity estimators by speed and ground: learned network and Kalman filter.

`quadvel_estimator` holds the estimators; `study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_policy.observation import VelocityCommandLimits
from quadvel_sim.terrain import Terrain

from ..walk import Setup, Walk, make_loop, record_until_fall
from .cells import command_limits
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, column, distinct, mean, select

BANDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)  # m/s, lower ends of the bands of true speed, each 0.5 wide
MAX_COMMAND_SPEED = 2.5  # m/s, for vx and vy each
COMMAND_HOLD_S = 2.5  # duration of each command
ESTIMATORS = ("learned", "kalman")
GROUNDS = ("flat", "rough")


def random_walk(setup: Setup, seed: int, bounds: VelocityCommandLimits, seconds: float) -> Walk | None:
    """Walk random commands, uniform in the ellipsoid spanned by the limits.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of robot and commands.
        bounds: Limits of the policy.
        seconds: Duration, s.

    Returns:
        The walk up to a fall; None without a sample.
    """
    rng = np.random.default_rng(seed)
    commands = []
    for _ in range(round(seconds / COMMAND_HOLD_S)):
        # Uniform in the unit ball: a normal direction with length u^(1/3), u uniform in [0, 1).
        direction = rng.standard_normal(3)
        direction *= rng.uniform() ** (1.0 / 3.0) / np.linalg.norm(direction)
        command = direction * np.where(direction > 0, bounds.high, np.negative(bounds.low))
        command[:2] = np.clip(command[:2], -MAX_COMMAND_SPEED, MAX_COMMAND_SPEED)
        commands.append((command, COMMAND_HOLD_S))
    walk, _ = record_until_fall(make_loop(setup, seed, ESTIMATORS), commands)
    return walk


@attrs.frozen
class Estimator(Section):
    """Random walks on both grounds.

    Attributes:
        seconds: Duration of each walk, s.
        grounds: Kinds of terrain.
    """

    name: ClassVar[str] = "estimator"
    title: ClassVar[str] = "Velocity estimator"
    method: ClassVar[str] = (
        "Walks of 20 s with a random command each 2.5 s, on flat and rough ground (humps of 3 cm), every estimator on the same "
        "walks. Root mean square error an axis against the true velocity, by bands of true speed; drift: distance between "
        "where the integrated estimate leads and where the robot got to, over the way. The paper gives no figure."
    )
    seconds: float = 20.0
    grounds: tuple[str, ...] = GROUNDS

    @override
    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            bounds = command_limits(study, policy)
            for ground in self.grounds:
                for seed in range(study.seeds):
                    setup = study.setup(policy, terrain=Terrain(kind=ground, roughness=0.03, seed=seed))
                    call = (random_walk, setup, seed, bounds, self.seconds)
                    jobs.append(Job({"policy": policy, "ground": ground, "seed": seed}, call))
        return jobs

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        records: list[Record] = []
        for labels, walk in answers:
            if walk is None:
                continue
            way = float(np.linalg.norm(np.diff(walk.position[:, :2], axis=0), axis=1).sum())
            speed = np.hypot(*walk.velocity[:, :2].T)
            for name, error in walk.estimate_errors.items():
                whole = {"estimator": name, "way": way, "drift": walk.estimate_drifts[name]}
                for band in BANDS:
                    inside = (band <= speed) & (speed < band + 0.5)
                    squares = np.square(error[inside]).sum(axis=0)
                    sums = dict(zip(("x", "y", "z"), squares.tolist(), strict=True))
                    records.append({**labels, **whole, "band": band, "samples": int(inside.sum()), **sums})
        return records

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        grounds = distinct(records, "ground")
        figure = Figure(figsize=(4.5 * len(grounds), 3.4), layout="constrained")
        panels = figure.subplots(1, len(grounds), sharey=True, squeeze=False)[0]
        for panel, ground in zip(panels, grounds, strict=True):
            for policy in distinct(records, "policy"):
                for name, style in zip(ESTIMATORS, ("o-", "s--"), strict=True):
                    mine = select(records, ground=ground, policy=policy, estimator=name)
                    values = [rmse(select(mine, band=band)) for band in BANDS]
                    panel.plot(np.array(BANDS) + 0.25, values, style, label=f"{name}, walks of {policy}")
            panel.set_title(f"{ground} ground")
            panel.set_xlabel("true speed, m/s")
            panel.set_xlim(0.0, BANDS[-1] + 0.5)
        panels[0].set_ylim(0.0, None)
        panels[0].set_ylabel("RMSE of the worst axis, m/s")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        for ground in distinct(records, "ground"):
            for name in ESTIMATORS:
                mine = select(records, ground=ground, estimator=name)
                what = f"{ground} ground, {name}"
                rows += [
                    Row(f"{what}: RMSE of the worst axis", "m/s", None, by_policy(mine, rmse), key=True),
                    Row(f"{what}: drift", "% of the way", None, by_policy(mine, drift), 1, key=True),
                ]
        return rows


def rmse(records: Sequence[Record]) -> float:
    """Return the root mean square error of the worst axis over all samples.

    Args:
        records: Records of one estimator.

    Returns:
        Error, m/s; nan without samples.
    """
    samples = column(records, "samples").sum()
    if not samples:
        return float("nan")
    return float(np.sqrt(max(column(records, axis).sum() for axis in "xyz") / samples))


def drift(records: Sequence[Record]) -> float:
    """Return the dead reckoning error divided by the path length; each walk counts once.

    Args:
        records: Records of one estimator.

    Returns:
        Drift, %.
    """
    once = select(records, band=BANDS[0])
    return 100.0 * mean(once, "drift") / mean(once, "way")

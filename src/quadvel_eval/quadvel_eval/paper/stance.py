"""Standing still: drift, steps and joint speed, compared with constant joint targets.

`gait` evaluates walking; `study` runs the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand
from quadvel_policy.observation import CONTROL_PERIOD_S

from ..gait_kind import touchdowns
from ..grid import WALK_BEFORE_STANCE, max_displacement
from ..robot_loop import SIMULATOR_STEPS_PER_TICK, RobotLoop
from ..walk import Setup, make_loop, record_walk
from .gait import debounce_contacts
from .section import (
    Job,
    JobResults,
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
    walk_jobs,
)

SETTLING_TIME_S = 1.0  # after the zero command
ZERO_COMMAND = (0.0, 0.0, 0.0)


def measure_standing(
    setup: Setup, seed: int, seconds: float
) -> tuple[Array, float, int, float, float] | None:
    """Measure a robot that stands after a short walk.

    Joint speeds are true values, root mean square over joints and time.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of the run.
        seconds: Duration of standing, s.

    Returns:
        Positions (n, 3) m, drift (m), number of steps, joint speed (rad/s), and joint speed under
        constant targets (rad/s); None if the robot fell.
    """
    loop = make_loop(setup, seed, ())
    if record_walk(loop, [*WALK_BEFORE_STANCE, (ZERO_COMMAND, SETTLING_TIME_S)]) is None:
        return None
    speeds, places, touching, targets = [], [], [], []
    for _ in range(round(seconds / CONTROL_PERIOD_S)):
        sample = loop.tick(ZERO_COMMAND)
        if sample.fallen or sample.mode != "walk":
            return None
        speeds.append(loop.simulator.data.qvel[6:].copy())
        places.append(sample.truth.position)
        touching.append(sample.truth.contact)
        targets.append(sample.command)
    steady = debounce_contacts(np.array(touching))
    steps = sum(len(touchdowns(steady[:, foot])) for foot in range(4))
    position = np.array(places)
    constant = _speed_under_constant_target(
        loop, np.mean([command.q for command in targets], axis=0), targets[-1], 5.0
    )
    return position, max_displacement(position), steps, _rms(speeds), constant


def _speed_under_constant_target(loop: RobotLoop, target: Array, like: JointCommand, seconds: float) -> float:
    """Joint speed under one constant target with the gains of `like`, rad/s."""
    command = JointCommand(q=target, kp=like.kp, kd=like.kd)
    speeds = []
    for _ in range(round((SETTLING_TIME_S + seconds) / CONTROL_PERIOD_S)):
        loop.simulator.command(command)
        loop.simulator.step(SIMULATOR_STEPS_PER_TICK)
        speeds.append(loop.simulator.data.qvel[6:].copy())
    return _rms(speeds[round(SETTLING_TIME_S / CONTROL_PERIOD_S) :])


def _rms(values: Sequence[Array]) -> float:
    """Root mean square over all values."""
    return float(np.sqrt(np.mean(np.square(values))))


@attrs.frozen
class Stance(Section):
    """Half a minute of standing per policy and seed.

    Attributes:
        seconds: Duration that counts, s.
    """

    name: ClassVar[str] = "stance"
    title: ClassVar[str] = "Standing still"
    method: ClassVar[str] = (
        "After a short walk the robot stands for 30 s; the first second does not count. Drift: the largest "
        "distance from where it stood then. Steps: touchdowns of feet. Joint speed: true, root mean square, next to that of "
        "the same robot with its targets frozen at their mean, which the torque noise alone moves. The paper gives no figure."
    )
    seconds: float = 29.0

    @override
    def jobs(self, study: Study) -> list[Job]:
        return walk_jobs(study, measure_standing, self.seconds)

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        records: list[Record] = []
        for labels, answer in answers:
            if answer is None:
                whole = dict.fromkeys(("drift", "steps", "joint_speed", "constant_speed"))
                records.append({**labels, **whole, "fell": 1, "time": None, "x": None, "y": None})
                continue
            position, *numbers = answer
            whole = dict(zip(("drift", "steps", "joint_speed", "constant_speed"), numbers, strict=True))
            for i in range(0, len(position), 40):
                x, y = (position[i] - position[0])[:2].tolist()
                records.append(
                    {**labels, **whole, "fell": 0, "time": round(i * CONTROL_PERIOD_S, 3), "x": x, "y": y}
                )
        return records

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(7.0, 3.0), layout="constrained")
        panel = figure.subplots()
        for policy in distinct(records, "policy"):
            for seed in distinct(records, "seed"):
                mine = select(records, policy=policy, seed=seed)
                distance = np.hypot(column(mine, "x"), column(mine, "y"))
                panel.plot(column(mine, "time"), 100.0 * distance, label=f"{policy}, seed {seed}")
        panel.set_xlabel("time, s")
        panel.set_ylabel("distance from the start, cm")
        panel.set_ylim(0.0, None)
        panel.legend(fontsize="small")
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        def centimetres(mine: Sequence[Record]) -> float:
            return 100.0 * largest(mine, "drift")

        def over_constant(mine: Sequence[Record]) -> float:
            return mean(mine, "joint_speed") / mean(mine, "constant_speed")

        steps, speed, fell = (
            by_policy(records, partial(largest, name=name)) for name in ("steps", "joint_speed", "fell")
        )
        return [
            Row("largest drift in 30 s", "cm", None, by_policy(records, centimetres), 2, key=True),
            Row("steps, most", "", None, steps, 0),
            Row("joint speed, largest", "rad/s", None, speed),
            Row("joint speed over that of constant targets", "", None, by_policy(records, over_constant), 2),
            Row("whether one fell", "", 0.0, fell, 0),
        ]

"""The gap: policies on plants whose drives hold what the actuator model lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure

from quadvel_actuator import ActuatorParameters, Effect
from quadvel_description.robot import JOINT_NAMES

from ..output import replacing
from .cells import Command, cell_record, falls, largest_error, limits, mean_error
from .conditions import Condition, condition_job, draw
from .identification import mixed
from .section import Answers, Job, Record, Row, Section, Study, by_policy, distinct, mean, select

MORE_DELAY = 0.003  # s
COMMANDS: tuple[Command, ...] = (
    (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0), (1.0, 0.4, 0.0), (1.0, -0.4, 0.0), (0.8, 0.0, 0.8), (0.8, 0.0, -0.8),
)  # fmt: skip


def _with(name: str, settings: Mapping[str, Any] | None = None, **parameters: float) -> ActuatorParameters:
    """The shipped actuator model with an effect on all joints."""
    effect = Effect(name, JOINT_NAMES, {**(settings or {}), **parameters})
    return attrs.evolve(ActuatorParameters.default(), name=f"aliengo with {name}", effects=(effect,))


def _delayed() -> ActuatorParameters:
    """The shipped actuator model with commands that take MORE_DELAY longer."""
    default = ActuatorParameters.default()
    pairs = tuple(attrs.evolve(p, input_delay_s=p.input_delay_s + MORE_DELAY) for p in default.pairs)
    return attrs.evolve(default, name="aliengo with more delay", pairs=pairs)


def plants() -> list[Condition]:
    """The plant of the actuator model, and those whose drives hold more."""
    drives = {
        "as in training": ActuatorParameters.default(),
        "friction": _with("stribeck_friction", c=1.2, c_s=1.8, v_s=0.3, v_0=0.05),
        "torque-speed limit": _with("torque_speed_limit", stall=24.0, no_load=12.0),
        "3 ms more delay": _delayed(),
        "backlash": _with("backlash", {"on": "q"}, gap=0.015),
    }
    return [Condition("drives", name, {"actuator": parameters}) for name, parameters in drives.items()]


def record_walk(policy: Path, plant: str, out: Path, seed: int = 0) -> None:
    """Write a log (NPZ, 1 kHz) of a mixed walk on one of the `plants`, for `quadvel identify`. ValueError: no such plant."""
    known = {one.level: one for one in plants()}
    if plant not in known:
        raise ValueError(f"plant: found {plant!r}, expected one of {', '.join(known)}")
    study = Study(policies={"walker": policy})
    log = mixed(study.setup("walker", **known[plant].plant), seed, limits(study, "walker"))
    fields = {name: getattr(log, name) for name in ("t", "q", "dq", "tau", "q_des", "tau_ff", "kp", "kd")}
    with replacing(out) as draft:
        np.savez_compressed(draft, joint_names=np.array(log.joints), **fields)


def cut(records: Sequence[Record], policy: str) -> dict[str, float | None]:
    """By how much (%) the mean error of each other policy is below that of `policy`, on walks that neither fell on."""

    def errors(name: str) -> dict[tuple[Any, ...], Record]:
        mine = select(records, policy=name, fell=0)
        return {tuple(r[key] for key in ("level", "vx", "vy", "wz", "seed")): r for r in mine}

    before = errors(policy)
    found: dict[str, float | None] = {}
    for other in distinct(records, "policy"):
        after = errors(other)
        both = before.keys() & after.keys()
        if other != policy and both:
            was, is_now = (mean([walks[key] for key in both], "error_xy") for walks in (before, after))
            found[other] = 100.0 * (1.0 - is_now / was)
    return found


@attrs.frozen
class Gap(Section):
    """Every plant with every command and seed."""

    name: ClassVar[str] = "gap"
    title: ClassVar[str] = "The gap: drives that hold what the model lacks"
    method: ClassVar[str] = (
        "Ten commands of 6 s on the plant of the actuator model and on four whose drives hold, in addition, dry friction "
        "(1.2 N m, 1.8 at rest), a torque limit of 24 N m that falls to nothing at 12 rad/s in the direction of motion, 3 ms "
        "more delay of the commands, and a backlash of ±15 mrad. The shipped policy's training drew torque limits, and none of "
        "the others. Errors are those of the robots that did not fall; the cut of the error is against the first policy, on the "
        "walks that neither fell on. The paper's own gap is that between simulation and robot: RL-PD fell 3 times there, the EAM "
        "policies never."
    )
    commands: tuple[Command, ...] = COMMANDS

    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy in study.policies
            for one in plants()
            for command in self.commands
            for seed in range(study.seeds)
        ]

    def judge(self, answers: Answers) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(8.0, 5.0), layout="constrained")
        error, stood = figure.subplots(2, 1, sharex=True)
        draw(error, stood, records)
        error.set_ylabel("mean error, m/s")
        stood.set_ylabel("survival, %")
        error.legend()
        return figure

    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows, first = [], distinct(records, "policy")[0]
        for level in distinct(records, "level"):
            mine = select(records, level=level)
            rows += [
                Row(f"{level}: falls", "", 0.0, by_policy(mine, falls), 0),
                Row(f"{level}: mean error", "m/s", None, by_policy(mine, mean_error)),
                Row(f"{level}: largest error", "m/s", 0.084, by_policy(mine, largest_error), key=True),
            ]
            if against := cut(mine, first):
                rows.append(Row(f"{level}: mean error below that of {first}", "%", None, against, 0))
        return rows

"""Reality gap: policies on plants whose drives have effects that the actuator model lacks.

`conditions` makes the jobs and draws the errors; `study` runs the section.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_actuator import ActuatorParameters, Effect
from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot, load_robot
from quadvel_recordings.output import atomic_write, output_file

from .cells import Command, cell_record, command_limits, count_falls, largest_error, mean_error
from .conditions import Condition, condition_job, draw_error_and_survival
from .identification import record_mixed_walk
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, distinct, select

LAG_S = 0.005  # s
TRAINED = "as in training"
"""Name of the plant with the robot's own actuator model."""
COMMANDS: tuple[Command, ...] = (
    (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0), (1.0, 0.4, 0.0), (1.0, -0.4, 0.0), (0.8, 0.0, 0.8), (0.8, 0.0, -0.8),
)  # fmt: skip


def _default_with_effect(
    robot: Robot, name: str, settings: Mapping[str, Any] | None = None, **parameters: float
) -> ActuatorParameters:
    """The robot's actuator model with an effect on all joints."""
    effect = Effect(name, JOINT_NAMES, {**(settings or {}), **parameters})
    return attrs.evolve(ActuatorParameters.of(robot), name=f"{robot.name} with {name}", effects=(effect,))


def _drives_of(other: str, robot: Robot) -> ActuatorParameters:
    """The delays, gain deviations and effects of another robot's drives, with this robot's torque limits."""
    return attrs.evolve(
        ActuatorParameters.of(load_robot(other)),
        name=f"{robot.name} with the drives of the {other}",
        robot=robot.name,
        torque_limit=ActuatorParameters.of(robot).torque_limit,
    )


def drive_conditions(robot: Robot) -> list[Condition]:
    """List the plant of the actuator model and the plants with additional effects.

    Args:
        robot: The robot.

    Returns:
        One condition per plant.
    """
    other = "aliengo" if robot.name == "go2" else "go2"
    drives = {
        TRAINED: ActuatorParameters.of(robot),
        "friction": _default_with_effect(robot, "stribeck_friction", c=1.2, c_s=1.8, v_s=0.3, v_0=0.05),
        "torque-speed limit": _default_with_effect(robot, "torque_speed_limit", stall=24.0, no_load=12.0),
        "lag": _default_with_effect(robot, "first_order_lag", T=LAG_S),
        "backlash": _default_with_effect(robot, "backlash", {"on": "q"}, gap=0.015),
        f"drives of the {other}": _drives_of(other, robot),
    }
    return [Condition("drives", name, {"actuator": parameters}) for name, parameters in drives.items()]


def write_walk_log(robot: Robot, policy: Path, plant: str, out: Path, seed: int = 0) -> None:
    """Write a log of a mixed walk on one of the plants, for `quadvel identify`.

    Args:
        robot: The robot, a shipped one.
        policy: ONNX file of the policy.
        plant: Name of a plant of `drive_conditions`.
        out: NPZ file to write, rows at 1 kHz.
        seed: Seed of the run.

    Raises:
        ValueError: The plant is unknown, or `out` is no NPZ file.
    """
    if out.suffix != ".npz":
        raise ValueError(f"{out}: found the suffix {out.suffix!r}, expected .npz")
    output_file(out)
    known = {one.level: one for one in drive_conditions(robot)}
    if plant not in known:
        raise ValueError(f"plant: found {plant!r}, expected one of {', '.join(known)}")
    study = Study(robot=robot.name, policies={"walker": policy})
    log = record_mixed_walk(
        study.setup("walker", **known[plant].plant), seed, command_limits(study, "walker")
    )
    fields = {name: getattr(log, name) for name in ("t", "q", "dq", "tau", "q_des", "tau_ff", "kp", "kd")}
    with atomic_write(out) as draft:
        np.savez_compressed(draft, joint_names=np.array(log.joints), **fields)


def paired_errors(records: Sequence[Record], one: str, other: str) -> tuple[Array, Array]:
    """Return the errors of two policies on the same walks, of those that neither fell on.

    Args:
        records: Records of `cell_record`.
        one: A policy.
        other: Another policy.

    Returns:
        Errors of both, (n,) each, m/s.
    """

    def errors(name: str) -> dict[tuple[Any, ...], float]:
        mine = select(records, policy=name, fell=0)
        return {tuple(r[key] for key in ("level", "vx", "vy", "wz", "seed")): r["error_xy"] for r in mine}

    both = errors(one), errors(other)
    walks = both[0].keys() & both[1].keys()
    first, second = (np.array([by_walk[walk] for walk in sorted(walks)]) for by_walk in both)
    return first, second


def error_reduction(records: Sequence[Record], policy: str) -> dict[str, float | None]:
    """Return how much lower the mean error of each other policy is, on walks without a fall.

    Args:
        records: Records of `cell_record`.
        policy: Reference policy.

    Returns:
        Reduction relative to the reference, %, by policy.
    """
    found: dict[str, float | None] = {}
    for other in distinct(records, "policy"):
        before, after = paired_errors(records, policy, other)
        if other != policy and len(before):
            found[other] = 100.0 * (1.0 - float(after.mean() / before.mean()))
    return found


@attrs.frozen
class Gap(Section):
    """Walks of every command on every plant.

    Attributes:
        commands: vx, vy (m/s), wz (rad/s) of each walk.
    """

    name: ClassVar[str] = "gap"
    title: ClassVar[str] = "The gap: drives with effects that the model lacks"
    method: ClassVar[str] = (
        "Ten commands of 6 s on the plant of the actuator model and on five others. Four have, in addition, dry friction "
        "(1.2 N m, 1.8 at rest), a torque limit of 24 N m that falls to nothing at 12 rad/s in the direction of motion, a "
        "torque that lags (first order, 5 ms), and a backlash of ±15 mrad. The fifth has the drives of the other shipped "
        "robot. The shipped policy was trained with none of them, its teacher with more varied torque limits. Errors are those of "
        "the robots that did not fall; the cut of the error is against the first policy, on the walks that neither fell on. "
        "The paper's own gap is that between simulation and robot: RL-PD fell 3 times there, the EAM policies never."
    )
    commands: tuple[Command, ...] = COMMANDS

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            condition_job(study, policy, one, command, seed)
            for policy in study.policies
            for one in drive_conditions(load_robot(study.robot))
            for command in self.commands
            for seed in range(study.seeds)
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [cell_record(labels, result) for labels, result in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        figure = Figure(figsize=(8.0, 5.0), layout="constrained")
        error, stood = figure.subplots(2, 1, sharex=True)
        draw_error_and_survival(error, stood, records)
        error.set_ylabel("mean error, m/s")
        stood.set_ylabel("survival, %")
        error.legend()
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows, first = [], distinct(records, "policy")[0]
        for level in distinct(records, "level"):
            mine = select(records, level=level)
            rows += [
                Row(f"{level}: falls", "", 0.0, by_policy(mine, count_falls), 0),
                Row(f"{level}: mean error", "m/s", None, by_policy(mine, mean_error)),
                Row(f"{level}: largest error", "m/s", 0.084, by_policy(mine, largest_error), key=True),
            ]
            if against := error_reduction(mine, first):
                rows.append(Row(f"{level}: mean error below that of {first}", "%", None, against, 0))
        return rows

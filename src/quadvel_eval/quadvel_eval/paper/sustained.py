"""Section 4.3: largest sustained velocities in six directions, and the load of the drives.

`study` runs the section; `quadvel_training.limiting` writes narrower limits into a policy file.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_description.robot import load_robot
from quadvel_policy.observation import CONTROL_PERIOD_S

from ..walk import Setup, make_loop, record_until_fall
from .cells import Command, command_limits, count_falls, max_command_along
from .conditions import HARD_PLANTS, PLANT_NAMES
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
    select,
)

ACCELERATION = 0.7  # of the command, m/s^2; twice as many rad/s^2 for spins
HOLD_TIME_S = 5.0  # at the full command
EVALUATED_TIME_S = 4.0  # at the end of HOLD_TIME_S
DIRECTIONS: dict[str, tuple[Command, float]] = {  # direction, and the paper's largest velocity, m/s, rad/s
    "forward": ((1.0, 0.0, 0.0), 4.2),
    "backward": ((-1.0, 0.0, 0.0), 3.2),
    "left": ((0.0, 1.0, 0.0), 2.0),
    "right": ((0.0, -1.0, 0.0), 2.0),
    "spin left": ((0.0, 0.0, 1.0), 6.0),
    "spin right": ((0.0, 0.0, -1.0), 6.0),
}
DRIVE_FIGURES = {
    "joint_speed": "fastest joint, share of its drive's speed",
    "torque": "largest torque, share of its drive's",
}


def measure_sustained(setup: Setup, seed: int, direction: Command, speed: float) -> Record:
    """Hold one command, and measure the last EVALUATED_TIME_S before the end or the fall.

    Args:
        setup: Robot, policy and plant.
        seed: Seed of the run.
        direction: Unit vector of the command.
        speed: Length of the command, m/s or rad/s.

    Returns:
        `reached`: mean velocity along `direction` (m/s, rad/s), None after a fall; `fell`;
        `ended`: reason of the supervisor for the end; `joint_speed` and `torque`: largest of all
        joints, divided by the limit of the drive.
    """
    # The command rises as min(t / rise, 1) * speed, then stays for HOLD_TIME_S.
    along = np.array(direction)
    rise = speed / (2 * ACCELERATION if along[2] else ACCELERATION)
    shares = np.minimum(
        np.arange(round((rise + HOLD_TIME_S) / CONTROL_PERIOD_S)) * CONTROL_PERIOD_S / rise, 1.0
    )
    loop, last = make_loop(setup, seed, ()), slice(-round(EVALUATED_TIME_S / CONTROL_PERIOD_S), None)
    walk, stood = record_until_fall(loop, [(share * speed * along, CONTROL_PERIOD_S) for share in shares])
    robot = load_robot(setup.robot)
    assert walk is not None  # it stood when it began
    return {
        "reached": float(walk.velocity[last].mean(axis=0) @ along) if stood else None,
        "fell": int(not stood),
        "ended": "" if stood else loop.supervisor.reason,
        "joint_speed": float((np.abs(walk.joint_velocity[last]) / robot.velocity_limit).max()),
        "torque": float((np.abs(walk.torque[last]) / robot.torque_limit).max()),
    }


@attrs.frozen
class Sustained(Section):
    """Walks in each direction at some shares of the policy's limit.

    Attributes:
        shares: Shares of the largest command.
        directions: Keys of DIRECTIONS.
    """

    name: ClassVar[str] = "sustained"
    title: ClassVar[str] = "Section 4.3: largest sustained velocities"
    method: ClassVar[str] = (
        "The command rises at 0.7 m/s² (spins: 1.4 rad/s²) to 60, 80, 90 and 100 % of the policy's own limit in that "
        "direction, or of 1.1 times the paper's velocity where the limit is beyond it, and stays there for 5 s. The result is the "
        "mean true velocity of the last 4 s; the largest of the robots that did not fall is in the table. With it stands what "
        "the command asks of the drives: the largest speed and torque of any joint, as shares of what its drive can do. The "
        "supervisor stops a robot whose joints move at 1.25 times that speed, which counts as a fall. The second plant is that of "
        "Figure 10; with loose joints it has neither friction nor damping in its joints, and their speeds are the largest."
    )
    shares: tuple[float, ...] = (0.6, 0.8, 0.9, 1.0)
    directions: tuple[str, ...] = tuple(DIRECTIONS)

    @override
    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            bounds = command_limits(study, policy)
            for name in self.directions:
                direction, paper = DIRECTIONS[name]
                top = min(max_command_along(direction, bounds), 1.1 * paper)
                speeds = [round(share * top, 3) for share in self.shares]
                for (plant, fields), speed in itertools.product(HARD_PLANTS.items(), speeds):
                    labels = {
                        "policy": policy,
                        "plant": plant,
                        "direction": name,
                        "command": speed,
                        "limit": top,
                    }
                    jobs.append(
                        Job(labels, (measure_sustained, study.setup(policy, **fields), 0, direction, speed))
                    )
        return jobs

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        return [{**labels, **became} for labels, became in answers]

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        records = select(records, plant="usual")
        policies = distinct(records, "policy")
        names = distinct(records, "direction")
        figure = Figure(figsize=(12.5, 3.8), layout="constrained")
        walks, spins, drives = figure.subplots(1, 3, width_ratios=(2, 1, 2))
        for panel, spinning, unit in ((walks, False, "m/s"), (spins, True, "rad/s")):
            mine = [name for name in names if name.startswith("spin") == spinning]
            places, width = np.arange(len(mine)), 0.8 / len(policies)
            for k, policy in enumerate(policies):
                tops = [largest(select(records, policy=policy, direction=name), "reached") for name in mine]
                panel.bar(places + k * width, tops, width, label=policy, align="edge")
            paper = [DIRECTIONS[name][1] for name in mine]
            panel.hlines(paper, places, places + 0.8, color="black", linestyle="--", label="paper")
            panel.set_xticks(places + 0.4, mine)
            panel.set_ylabel(f"sustained velocity, {unit}")
        walks.legend()
        for name in names:
            mine = select(records, direction=name, policy=policies[-1])
            drives.plot(column(mine, "command"), column(mine, "joint_speed"), "o-", label=name)
        drives.axhline(1.0, color="black", linestyle="--")
        drives.set_xlabel("command, m/s, rad/s")
        drives.set_ylabel("fastest joint, share of its drive's speed")
        drives.set_title(policies[-1])
        drives.legend(fontsize="small")
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        rows = []
        usual = select(records, plant="usual")
        for name in distinct(records, "direction"):
            mine = select(usual, direction=name)
            unit, paper = "rad/s" if name.startswith("spin") else "m/s", DIRECTIONS[name][1]
            reached, tried = (by_policy(mine, partial(largest, name=what)) for what in ("reached", "command"))
            rows += [
                Row(f"{name}: reached", unit, paper, reached, 2, key=True),
                Row(f"{name}: largest command that was tried", unit, None, tried, 2),
                *_drive_rows(name, mine),
            ]
        rows.append(Row("falls", "", 0.0, by_policy(usual, count_falls), 0))
        for plant in distinct(records, "plant"):
            if plant != "usual":
                rows += _plant_rows(plant, select(records, plant=plant))
        return rows


def _drive_rows(what: str, records: Sequence[Record]) -> list[Row]:
    """Rows of the largest joint speed and torque."""
    return [
        Row(f"{what}: {drive}", "", None, by_policy(records, partial(largest, name=key)), 2)
        for key, drive in DRIVE_FIGURES.items()
    ]


def _plant_rows(plant: str, records: Sequence[Record]) -> list[Row]:
    """Rows of another plant: load of the drives in each direction, and falls."""
    rows = []
    for name in distinct(records, "direction"):
        rows += _drive_rows(f"{PLANT_NAMES[plant]}, {name}", select(records, direction=name))
    return [*rows, Row(f"{PLANT_NAMES[plant]}: falls", "", None, by_policy(records, count_falls), 0)]

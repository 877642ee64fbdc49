"""Figures 7 and 8 of the paper: torque over velocity of all legs, and actions over a gait cycle.

`walk.record_walk` simulates the walks, `study` runs the section, and `files.write_section` writes
CSV, figure and JSON.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from quadvel_description.arrays import Array, Indices
from quadvel_description.quadruped import LEFT, LEGS
from quadvel_description.symmetry import JOINTS as MIRROR

from ..gait_kind import touchdowns
from ..walk import Setup, Walk, make_loop, record_walk
from .cells import command_limits
from .gait import debounce_contacts
from .section import Job, JobResults, Record, Row, Section, Study, by_policy, column, distinct, select

WALK_DURATION_S, SETTLING_TIME_S = 7.0, 3.0  # duration, and start of the evaluated part
PHASES_PER_CYCLE = 80
PARTS = ("hip", "thigh", "calf")
PAIRS = (("FL", "FR"), ("RL", "RR"))


def walk_forward(setup: Setup, seed: int, speed: float) -> Walk | None:
    """Walk straight ahead for WALK_DURATION_S.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of the run.
        speed: Commanded velocity, m/s.

    Returns:
        The walk; None if the robot fell.
    """
    return record_walk(make_loop(setup, seed, ()), [((speed, 0.0, 0.0), WALK_DURATION_S)])


def resample_cycles(down: Indices, values: Array) -> Array:
    """Cut series into gait cycles and interpolate each at PHASES_PER_CYCLE even phases.

    Args:
        down: Indices of the samples at which a foot touches down, increasing.
        values: Series, (n, k), sampled at the same times.

    Returns:
        Values, (cycles, PHASES_PER_CYCLE, k), in the unit of the series.
    """
    # Phase p of a cycle from tick t_k to t_{k+1} lies at t_k + p (t_{k+1} - t_k).
    ticks, phases = np.arange(len(values)), np.arange(PHASES_PER_CYCLE) / PHASES_PER_CYCLE
    at = [begin + (end - begin) * phases for begin, end in pairwise(down)]
    each = [np.column_stack([np.interp(places, ticks, series) for series in values.T]) for places in at]
    return np.array(each).reshape(-1, PHASES_PER_CYCLE, values.shape[1])


def leg_curves(walk: Walk, leg: str) -> dict[str, Array] | None:
    """Compute torque, velocity and targets of a leg's joints over the gait cycle.

    Right legs are mirrored in all three, so that a symmetric gait gives equal curves. Torque and
    velocity are means of all cycles; the targets are those of the first cycle.

    Args:
        walk: The walk.
        leg: Name of the leg.

    Returns:
        `torque` (N m), `velocity` (rad/s) and `target` (rad), each (PHASES_PER_CYCLE, 3) from
        touchdown on, with columns in the order of PARTS; None without two full cycles.
    """
    late = walk.time >= SETTLING_TIME_S
    i = LEGS.index(leg)
    down = touchdowns(debounce_contacts(walk.contact[late])[:, i])
    if len(down) < 3:
        return None
    sign = np.ones(3) if LEFT[leg] > 0 else MIRROR.sign[3 * i : 3 * i + 3]
    joints = slice(3 * i, 3 * i + 3)
    torque, velocity, target = (
        resample_cycles(down, series[late][:, joints] * sign)
        for series in (walk.torque, walk.joint_velocity, walk.targets)
    )
    return {"torque": torque.mean(axis=0), "velocity": velocity.mean(axis=0), "target": target[0]}


def asymmetry(records: Sequence[Record]) -> float:
    """Return the asymmetry of the torque curves of left and right legs.

    It is the RMS of their difference over the RMS of their mean, over legs, joints and phases.

    Args:
        records: Records of one policy and speed.

    Returns:
        0 for mirror images, 2 if one side does all the work; nan without all legs.
    """
    names = [f"{part}_torque" for part in PARTS]
    apart, together = [], []
    for left, right in PAIRS:
        sides = [
            np.column_stack([column(select(records, leg=leg), name) for name in names])
            for leg in (left, right)
        ]
        if not all(len(side) for side in sides):
            return float("nan")
        apart.append(sides[0] - sides[1])
        together.append(0.5 * (sides[0] + sides[1]))
    # ||left - right|| / ||(left + right) / 2||, over legs, joints and phases.
    return float(np.linalg.norm(apart) / np.linalg.norm(together))


@attrs.frozen
class Symmetry(Section):
    """One straight walk per policy and speed. A record holds one phase of one leg.

    Attributes:
        speeds: Commanded velocities, m/s; the policy's fastest if that is less.
    """

    name: ClassVar[str] = "symmetry"
    title: ClassVar[str] = "Figures 7 and 8: symmetry and actions over a gait cycle"
    method: ClassVar[str] = (
        "Straight walks of 7 s, the last 4 s cut into gait cycles at each foot's touchdowns. Torque over velocity is the mean "
        "of all cycles, right legs mirrored, so that a symmetric gait draws one loop; the actions are those of one cycle, as "
        "they are. Asymmetry: root mean square difference of the left and right torque curves of all legs over that of their "
        "mean; 0 where they are mirror images, 2 where one side does it all. The paper gives no figure for it."
    )
    speeds: tuple[float, ...] = (1.0, 2.0)

    @override
    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            top = command_limits(study, policy).high[0]
            for speed in self.speeds:
                labels = {"policy": policy, "speed": min(speed, top)}
                jobs.append(Job(labels, (walk_forward, study.setup(policy), 0, labels["speed"])))
        return jobs

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        records: list[Record] = []
        for labels, walk in answers:
            for leg in LEGS if walk is not None else ():
                curves = leg_curves(walk, leg)
                if curves is not None:
                    records += [
                        {**labels, "leg": leg, **_phase_record(curves, k)} for k in range(PHASES_PER_CYCLE)
                    ]
        return records

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        shown = [
            (policy, speed)
            for policy in distinct(records, "policy")
            for speed in distinct(select(records, policy=policy), "speed")
        ]
        figure = Figure(figsize=(14.0, 2.6 * len(shown)), layout="constrained")
        panels = figure.subplots(len(shown), 4, squeeze=False)
        for row, (policy, speed) in zip(panels, shown, strict=True):
            mine = select(records, policy=policy, speed=speed)
            _draw_loops(row[:3], mine)
            _draw_actions(row[3], mine)
            row[0].set_ylabel(f"{policy}, {speed:g} m/s\ntorque, N m")
        for panel in panels[-1, :3]:
            panel.set_xlabel("velocity, rad/s")
        panels[-1, 3].set_xlabel("share of the gait cycle")
        panels[0, 0].legend()
        figure.legend(*panels[0, 3].get_legend_handles_labels(), loc="outside lower right", ncols=6)
        return figure

    @override
    def rows(self, records: Sequence[Record]) -> list[Row]:
        indices = {v: by_policy(select(records, speed=v), asymmetry) for v in distinct(records, "speed")}
        return [Row(f"asymmetry at {v:g} m/s", "", None, index, key=True) for v, index in indices.items()]


def _phase_record(curves: dict[str, Array], k: int) -> Record:
    """Return the columns of one phase: torque (N m), velocity (rad/s), target (rad) by joint."""
    values = {
        f"{part}_{name}": float(curve[k, joint])
        for joint, part in enumerate(PARTS)
        for name, curve in curves.items()
    }
    return {"phase": k / PHASES_PER_CYCLE, **values}


def _draw_loops(panels: Any, records: Sequence[Record]) -> None:
    """Draw torque over velocity of the front legs, one panel per joint."""
    for panel, part in zip(panels, PARTS, strict=True):
        for leg, style in (("FL", "-"), ("FR", "--")):
            mine = select(records, leg=leg)
            loop = [*mine, *mine[:1]]
            panel.plot(
                column(loop, f"{part}_velocity"), column(loop, f"{part}_torque"), style, label=f"{leg}"
            )
        panel.set_title(part)


def _draw_actions(panel: Any, records: Sequence[Record]) -> None:
    """Draw joint targets of the front legs over one cycle."""
    for leg, style in (("FL", "-"), ("FR", "--")):
        mine = select(records, leg=leg)
        for part, colour in zip(PARTS, ("tab:blue", "tab:orange", "tab:green"), strict=True):
            label = f"{leg} {part}"
            panel.plot(
                column(mine, "phase"), column(mine, f"{part}_target"), style, color=colour, label=label
            )
    panel.set_title("actions of one cycle")
    panel.set_ylabel("joint target, rad")

"""Figures 7 and 8: torque over velocity of left and right legs, and what the policy asks for, over a gait cycle."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from quadvel_description import robot
from quadvel_description.symmetry import JOINTS as MIRROR

from ..gait_kind import touchdowns
from ..walk import Setup, Walk, make_loop, record
from .cells import limits
from .gait import contacts
from .section import Answers, Job, Record, Row, Section, Study, by_policy, column, distinct, select

Array = NDArray[np.float64]

SECONDS, SETTLED = 7.0, 3.0  # s of a walk, and from where on it counts
PHASES = 80  # of a gait cycle
PARTS = ("hip", "thigh", "calf")
PAIRS = (("FL", "FR"), ("RL", "RR"))


def walk_ahead(setup: Setup, seed: int, speed: float) -> Walk | None:
    """`SECONDS` of walking ahead."""
    return record(make_loop(setup, seed, ()), [((speed, 0.0, 0.0), SECONDS)])


def cycles(down: NDArray[np.intp], values: Array) -> Array:
    """The series `values` (n, k) between touchdowns of a foot, at PHASES even phases each: (cycles, PHASES, k)."""
    ticks, phases = np.arange(len(values)), np.arange(PHASES) / PHASES
    at = [begin + (end - begin) * phases for begin, end in pairwise(down)]
    each = [np.column_stack([np.interp(places, ticks, series) for series in values.T]) for places in at]
    return np.array(each).reshape(-1, PHASES, values.shape[1])


def leg_curves(walk: Walk, leg: str) -> dict[str, Array] | None:
    """Of one leg's joints (PHASES, 3) from touchdown on: mean torque (N m) and velocity (rad/s), targets (rad) of one cycle.

    Right legs as their mirror images, so that a symmetric gait gives equal curves. None without two full cycles.
    """
    late = walk.time >= SETTLED
    i = robot.LEGS.index(leg)
    down = touchdowns(contacts(walk.contact[late])[:, i])
    if len(down) < 3:
        return None
    sign = np.ones(3) if robot.LEFT[leg] > 0 else MIRROR.sign[3 * i : 3 * i + 3]
    joints = slice(3 * i, 3 * i + 3)
    torque, velocity, target = (
        cycles(down, series[late][:, joints] * sign)
        for series in (walk.torque, walk.joint_velocity, walk.targets)
    )
    return {"torque": torque.mean(axis=0), "velocity": velocity.mean(axis=0), "target": target[0]}


def asymmetry(records: Sequence[Record]) -> float:
    """Difference of left and right torque curves over their mean, root mean squares over legs, joints and phases.

    0: mirror images. 2: one side does it all.
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
    return float(np.linalg.norm(apart) / np.linalg.norm(together))


@attrs.frozen
class Symmetry(Section):
    """One walk a policy and speed (m/s)."""

    name: ClassVar[str] = "symmetry"
    title: ClassVar[str] = "Figures 7 and 8: symmetry and actions over a gait cycle"
    method: ClassVar[str] = (
        "Straight walks of 7 s, the last 4 s cut into gait cycles at each foot's touchdowns. Torque over velocity is the mean "
        "of all cycles, right legs mirrored, so that a symmetric gait draws one loop; the actions are those of one cycle, as "
        "they are. Asymmetry: root mean square difference of the left and right torque curves of all legs over that of their "
        "mean; 0 where they are mirror images, 2 where one side does it all. The paper gives no figure for it."
    )
    speeds: tuple[float, ...] = (1.0, 2.0)

    def jobs(self, study: Study) -> list[Job]:
        jobs = []
        for policy in study.policies:
            top = limits(study, policy).high[0]
            for speed in self.speeds:
                labels = {"policy": policy, "speed": min(speed, top)}
                jobs.append(Job(labels, (walk_ahead, study.setup(policy), 0, labels["speed"])))
        return jobs

    def judge(self, answers: Answers) -> list[Record]:
        records: list[Record] = []
        for labels, walk in answers:
            for leg in robot.LEGS if walk is not None else ():
                curves = leg_curves(walk, leg)
                if curves is not None:
                    records += [{**labels, "leg": leg, **_line(curves, k)} for k in range(PHASES)]
        return records

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

    def rows(self, records: Sequence[Record]) -> list[Row]:
        indices = {v: by_policy(select(records, speed=v), asymmetry) for v in distinct(records, "speed")}
        return [Row(f"asymmetry at {v:g} m/s", "", None, index, key=True) for v, index in indices.items()]


def _line(curves: dict[str, Array], k: int) -> Record:
    values = {
        f"{part}_{name}": float(curve[k, joint])
        for joint, part in enumerate(PARTS)
        for name, curve in curves.items()
    }
    return {"phase": k / PHASES, **values}


def _draw_loops(panels: Any, records: Sequence[Record]) -> None:
    """Torque over velocity of the front legs, a panel a joint."""
    for panel, part in zip(panels, PARTS, strict=True):
        for leg, style in (("FL", "-"), ("FR", "--")):
            mine = select(records, leg=leg)
            loop = [*mine, *mine[:1]]
            panel.plot(
                column(loop, f"{part}_velocity"), column(loop, f"{part}_torque"), style, label=f"{leg}"
            )
        panel.set_title(part)


def _draw_actions(panel: Any, records: Sequence[Record]) -> None:
    """Joint targets of the front legs over one cycle."""
    for leg, style in (("FL", "-"), ("FR", "--")):
        mine = select(records, leg=leg)
        for part, colour in zip(PARTS, ("tab:blue", "tab:orange", "tab:green"), strict=True):
            label = f"{leg} {part}"
            panel.plot(
                column(mine, "phase"), column(mine, f"{part}_target"), style, color=colour, label=label
            )
    panel.set_title("actions of one cycle")
    panel.set_ylabel("joint target, rad")

"""Figure 6: how the gait changes while the robot speeds up, and what is counted of any gait."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from quadvel_description import robot

from ..gait_kind import GaitKind, gait_frequency
from ..robot_loop import PERIOD
from ..walk import Setup, Walk, make_loop, record_to_the_fall
from .section import (
    Answers,
    Job,
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
)

Array = NDArray[np.float64]

WINDOW = 1.0  # s, over which a gait is counted
STEADY = 5  # ticks: a shorter touch or gap is a bounce
SHOWN = 4  # ticks from one line of the CSV to the next
KIND_SPEEDS = (0.5, 1.0, 2.0, 2.75)  # m/s of the ramp, at which the kind of gait is in the table,
KIND_SPAN = 0.125  # m/s, from so much below to so much above
KINDS = {  # what the table has of a gait's kind, with units and factors
    "diagonal": ("diagonal feet alike", "%", 100.0),
    "side": ("feet of one side alike", "%", 100.0),
    "frequency": ("gait frequency", "Hz", 1.0),
    "contact_ratio": ("contact ratio", "", 1.0),
    "sway": ("sway", "m/s", 1.0),
}
SHOWN_LEGS = ("FL", "FR", "RL", "RR")


def contacts(raw: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Contacts (n, 4) at 200 Hz without bounces: what half of `STEADY` ticks around say."""
    steady: NDArray[np.bool_] = median_filter(raw, size=(STEADY, 1), mode="nearest")
    return steady


def ramp(setup: Setup, seed: int, top: float, slope: float, hold: float) -> tuple[Walk | None, bool]:
    """Stand for `hold` (s), speed up to `top` (m/s) by `slope` (m/s^2), and hold that."""
    times = np.arange(round((top / slope + 2 * hold) / PERIOD)) * PERIOD
    speeds = np.clip(slope * (times - hold), 0.0, top)
    return record_to_the_fall(
        make_loop(setup, seed, ()), [((speed, 0.0, 0.0), PERIOD) for speed in speeds.tolist()]
    )


@attrs.frozen
class Gait(Section):
    """One ramp a policy; speeds in m/s, m/s^2, s."""

    name: ClassVar[str] = "gait"
    title: ClassVar[str] = "Figure 6: gait over a velocity ramp"
    method: ClassVar[str] = (
        "From standing the command vx rises by 0.25 m/s each second to 3.5 m/s. Foot contacts are the simulator's. "
        "Gait frequency (steps of a foot a second) and contact ratio (share of the time on the ground) are counted over "
        "windows of 1 s, mean of the four feet. A policy follows commands up to the limit in its file, no further. The kind of "
        "gait is the mean over the part of the ramp within 0.125 m/s of a speed: share of the time that two diagonal feet, and "
        "two feet of one side, are both on the ground or both in the air (a trot: diagonal feet near 100 %; a pace: feet of one "
        "side near 100 %), from contacts as they are; sway is the standard deviation of the sideways velocity."
    )
    top: float = 3.5
    slope: float = 0.25
    hold: float = 2.0

    def jobs(self, study: Study) -> list[Job]:
        return [
            Job({"policy": policy}, (ramp, study.setup(policy), 0, self.top, self.slope, self.hold))
            for policy in study.policies
        ]

    def judge(self, answers: Answers) -> list[Record]:
        records: list[Record] = []
        for labels, (walk, stood) in answers:
            if walk is not None:
                records += [{**labels, **line} for line in self._lines(walk, stood)]
        return records

    def _lines(self, walk: Walk, stood: bool) -> list[Record]:
        contact, half = contacts(walk.contact), round(0.5 * WINDOW / PERIOD)
        lines = []
        for i in range(0, len(walk.time), SHOWN):
            part = slice(max(0, i - half), i + half)
            window = contact[part]
            kind = GaitKind.of(walk.contact[part], walk.velocity[part, 1], PERIOD)
            feet = {leg: int(contact[i, robot.LEGS.index(leg)]) for leg in SHOWN_LEGS}
            lines.append(
                {
                    "time": round(float(walk.time[i]), 3),
                    "command": float(np.clip(self.slope * (walk.time[i] - self.hold), 0.0, self.top)),
                    "vx": float(walk.velocity[part, 0].mean()),
                    "frequency": gait_frequency(window, PERIOD),
                    "contact_ratio": float(window.mean()),
                    "diagonal": kind.diagonal,
                    "side": kind.side,
                    "sway": kind.sway,
                    **feet,
                    "fell": int(not stood),
                }
            )
        return lines

    def figure(self, records: Sequence[Record]) -> Figure:
        policies = distinct(records, "policy")
        figure = Figure(figsize=(7.5 * len(policies), 6.0), layout="constrained")
        panels = figure.subplots(3, len(policies), sharex=True, squeeze=False)
        for k, policy in enumerate(policies):
            self._draw(panels[:, k], policy, select(records, policy=policy))
        return figure

    def _draw(self, panels: Any, policy: str, records: Sequence[Record]) -> None:
        speed, feet, gait = panels
        time = column(records, "time")
        speed.plot(time, column(records, "command"), "k--", linewidth=1.0, label="command")
        speed.plot(time, column(records, "vx"), label="measured, mean over 1 s")
        speed.set_title(policy)
        speed.set_ylabel("$v_x$, m/s")
        speed.legend()
        _draw_contacts(feet, time, records)
        gait.plot(time, column(records, "frequency"), color="tab:green")
        gait.set_ylabel("gait frequency, Hz", color="tab:green")
        gait.set_ylim(0.0, None)
        ratio = gait.twinx()
        ratio.plot(time, column(records, "contact_ratio"), color="tab:red")
        ratio.set_ylabel("contact ratio", color="tab:red")
        ratio.set_ylim(0.0, 1.05)
        gait.set_xlabel("time, s")

    def rows(self, records: Sequence[Record]) -> list[Row]:
        def walking(mine: Sequence[Record]) -> list[Record]:
            return [r for r in mine if r["frequency"] > 0.0 and r["vx"] > 0.2]

        def first(name: str) -> Any:
            return lambda mine: walking(mine)[0][name] if walking(mine) else None

        def last(name: str) -> Any:
            return lambda mine: np.median(column(mine[-50:], name))

        return [
            Row("velocity at the end of the ramp", "m/s", 3.5, by_policy(records, last("vx")), 2),
            Row("highest velocity", "m/s", 3.5, by_policy(records, lambda r: largest(r, "vx")), 2),
            Row("gait frequency, first steps", "Hz", 2.0, by_policy(records, first("frequency")), 2),
            Row("gait frequency at the end", "Hz", 4.0, by_policy(records, last("frequency")), 2, key=True),
            Row("contact ratio, standing", "", 1.0, by_policy(records, lambda r: r[0]["contact_ratio"]), 2),
            Row("contact ratio at the end", "", 0.39, by_policy(records, last("contact_ratio")), 2, key=True),
            Row("fell during the ramp", "", 0.0, by_policy(records, lambda r: r[0]["fell"]), 0),
            *_kind_rows(records),
        ]


def _mean_near(records: Sequence[Record], speed: float, name: str) -> float:
    """Mean of a column over the part of the ramp within KIND_SPAN of a speed (m/s); nan where there is none."""
    return mean([r for r in records if abs(r["command"] - speed) < KIND_SPAN], name)


def _kind_rows(records: Sequence[Record]) -> list[Row]:
    """The kind of gait at each of KIND_SPEEDS; nothing where the ramp ends before."""
    rows = []
    for speed, (name, (what, unit, factor)) in itertools.product(KIND_SPEEDS, KINDS.items()):
        ours = by_policy(records, partial(_mean_near, speed=speed, name=name))
        scaled = {policy: None if value is None else factor * value for policy, value in ours.items()}
        digits, key = (0, speed == 1.0) if unit == "%" else (2, False)
        rows.append(Row(f"{speed:g} m/s: {what}", unit, None, scaled, digits, key=key))
    return rows


def _draw_contacts(panel: Axes, time: Array, records: Sequence[Record]) -> None:
    """A bar where a foot is on the ground."""
    step = time[1] - time[0] if len(time) > 1 else PERIOD
    for row, leg in enumerate(reversed(SHOWN_LEGS)):
        down = time[column(records, leg) > 0]
        panel.broken_barh([(t, step) for t in down], (row + 0.1, 0.8), color="tab:blue")
    panel.set_yticks(np.arange(4) + 0.5, list(reversed(SHOWN_LEGS)))
    panel.set_ylabel("contact")

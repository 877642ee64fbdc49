"""Figure 6: change of the gait over a velocity ramp, with gait figures per window.

`symmetry` compares left and right legs, and `gait_kind` classifies the gait. `study` runs the
section.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import attrs
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import median_filter
from typing_extensions import override

from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import LEGS
from quadvel_policy.observation import CONTROL_PERIOD_S

from ..gait_kind import GaitKind, gait_frequency
from ..walk import Setup, Walk, make_loop, record_until_fall
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
)

WINDOW_S = 1.0  # for gait figures
MEDIAN_FILTER_TICKS = 5  # touches or gaps shorter than half of it are bounces
CSV_INTERVAL_TICKS = 4  # between lines of the CSV
GAIT_KIND_SPEEDS = (0.5, 1.0, 2.0, 2.75)  # m/s, in the table
GAIT_KIND_HALF_SPAN = 0.125  # m/s around each of GAIT_KIND_SPEEDS
GAIT_KIND_FIGURES = {  # name, unit and factor in the table
    "diagonal": ("diagonal feet alike", "%", 100.0),
    "side": ("feet of one side alike", "%", 100.0),
    "frequency": ("gait frequency", "Hz", 1.0),
    "contact_ratio": ("contact ratio", "", 1.0),
    "sway": ("sway", "m/s", 1.0),
}
SHOWN_LEGS = ("FL", "FR", "RL", "RR")


def debounce_contacts(raw: Bools) -> Bools:
    """Remove short touches and gaps from foot contacts by a median filter.

    Args:
        raw: Contacts (n, 4) at 200 Hz.

    Returns:
        Filtered contacts (n, 4).
    """
    steady: Bools = median_filter(raw, size=(MEDIAN_FILTER_TICKS, 1), mode="nearest")
    return steady


def walk_ramp(setup: Setup, seed: int, top: float, slope: float, hold: float) -> tuple[Walk | None, bool]:
    """Stand, accelerate forward at a constant rate, and hold the final velocity.

    Args:
        setup: Robot, policy and ground.
        seed: Seed of the run.
        top: Final velocity, m/s.
        slope: Acceleration, m/s^2.
        hold: Duration of standing and of the final velocity, s.

    Returns:
        The walk, and whether the robot stayed on its feet.
    """
    times = np.arange(round((top / slope + 2 * hold) / CONTROL_PERIOD_S)) * CONTROL_PERIOD_S
    speeds = np.clip(slope * (times - hold), 0.0, top)
    return record_until_fall(
        make_loop(setup, seed, ()), [((speed, 0.0, 0.0), CONTROL_PERIOD_S) for speed in speeds.tolist()]
    )


@attrs.frozen
class Gait(Section):
    """One velocity ramp per policy.

    Attributes:
        top: Final velocity, m/s.
        slope: Acceleration, m/s^2.
        hold: Duration of standing and of the final velocity, s.
    """

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

    @override
    def jobs(self, study: Study) -> list[Job]:
        return [
            Job({"policy": policy}, (walk_ramp, study.setup(policy), 0, self.top, self.slope, self.hold))
            for policy in study.policies
        ]

    @override
    def to_records(self, answers: JobResults) -> list[Record]:
        records: list[Record] = []
        for labels, (walk, stood) in answers:
            if walk is not None:
                records += [{**labels, **line} for line in self._lines(walk, stood)]
        return records

    def _lines(self, walk: Walk, stood: bool) -> list[Record]:
        """Records of a walk, one every CSV_INTERVAL_TICKS."""
        contact, half = debounce_contacts(walk.contact), round(0.5 * WINDOW_S / CONTROL_PERIOD_S)
        lines = []
        for i in range(0, len(walk.time), CSV_INTERVAL_TICKS):
            part = slice(max(0, i - half), i + half)
            window = contact[part]
            kind = GaitKind.of(walk.contact[part], walk.velocity[part, 1], CONTROL_PERIOD_S)
            feet = {leg: int(contact[i, LEGS.index(leg)]) for leg in SHOWN_LEGS}
            lines.append(
                {
                    "time": round(float(walk.time[i]), 3),
                    "command": float(np.clip(self.slope * (walk.time[i] - self.hold), 0.0, self.top)),
                    "vx": float(walk.velocity[part, 0].mean()),
                    "frequency": gait_frequency(window, CONTROL_PERIOD_S),
                    "contact_ratio": float(window.mean()),
                    "diagonal": kind.diagonal,
                    "side": kind.side,
                    "sway": kind.sway,
                    **feet,
                    "fell": int(not stood),
                }
            )
        return lines

    @override
    def figure(self, records: Sequence[Record]) -> Figure:
        policies = distinct(records, "policy")
        figure = Figure(figsize=(7.5 * len(policies), 6.0), layout="constrained")
        panels = figure.subplots(3, len(policies), sharex=True, squeeze=False)
        for k, policy in enumerate(policies):
            self._draw(panels[:, k], policy, select(records, policy=policy))
        return figure

    def _draw(self, panels: Any, policy: str, records: Sequence[Record]) -> None:
        """Draw velocity, contacts and gait figures of a policy in three panels."""
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

    @override
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
            *_gait_kind_rows(records),
        ]


def _mean_near(records: Sequence[Record], speed: float, name: str) -> float:
    """Mean of a column within GAIT_KIND_HALF_SPAN of a commanded speed (m/s); nan without records."""
    return mean([r for r in records if abs(r["command"] - speed) < GAIT_KIND_HALF_SPAN], name)


def _gait_kind_rows(records: Sequence[Record]) -> list[Row]:
    """Rows of the gait kind at each of GAIT_KIND_SPEEDS; None beyond the end of the ramp."""
    rows = []
    for speed, (name, (what, unit, factor)) in itertools.product(GAIT_KIND_SPEEDS, GAIT_KIND_FIGURES.items()):
        ours = by_policy(records, partial(_mean_near, speed=speed, name=name))
        scaled = {policy: None if value is None else factor * value for policy, value in ours.items()}
        digits, key = (0, speed == 1.0) if unit == "%" else (2, False)
        rows.append(Row(f"{speed:g} m/s: {what}", unit, None, scaled, digits, key=key))
    return rows


def _draw_contacts(panel: Axes, time: Array, records: Sequence[Record]) -> None:
    """Draw a bar while a foot is on the ground."""
    step = time[1] - time[0] if len(time) > 1 else CONTROL_PERIOD_S
    for row, leg in enumerate(reversed(SHOWN_LEGS)):
        down = time[column(records, leg) > 0]
        panel.broken_barh([(t, step) for t in down], (row + 0.1, 0.8), color="tab:blue")
    panel.set_yticks(np.arange(4) + 0.5, list(reversed(SHOWN_LEGS)))
    panel.set_ylabel("contact")

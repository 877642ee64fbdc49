"""Drives: do they give the torque that is asked for, and do the joints move?"""

from __future__ import annotations

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import KINDS

from ..cause import NOTHING, Cause, Link, Measurement, Trace, worst_span
from ..signals import Signals
from ..torque import robust_std
from .contract import CLEAR_COEFFICIENT, HOT_DEG_C, MIN_SHARE_USED, joint_trace, torque_span

SHORT_OF = 6.0
"""A torque is too small if it lacks more than this many standard deviations."""
MIN_ASKED_NM = 4.0
PROPORTIONAL, CLEARLY_LESS = 1.5, 0.1
"""Spread around a constant share of the asked torque, by that of the fit, and how much less it has to be."""
MIN_SHORT_ROWS = 8
FLAT_SHARE, FALLS = 0.05, -0.4
"""Spread of a plateau by its height, and correlation of torque and speed of a limit that falls."""
REST_WINDOW_S = 0.5
REST_RAD_S, MOVING_RAD_S = 0.25, 0.6
"""Speed of a joint at rest, and median speed of all joints of a robot that moves."""
HEALTHY_REST_SHARES = (0.68, 0.32, 0.19)
"""Largest surplus of the time at rest of a hip, thigh and calf in healthy walks."""


class Temperature(Cause):
    """A motor is hotter than it may be; drives then give less torque or switch off."""

    link = Link.DRIVES
    unit = "deg C"
    least = 0.0
    needs = ("temperature",)
    remedy = "Let it cool; walk slower or with less load; look for a joint that drags"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        assert run.temperature is not None
        time, value = run.temperature.time, run.temperature.value
        j = int(np.argmax(value.max(axis=0)))
        limit = np.full(len(time), HOT_DEG_C)
        trace = Trace(f"temperature of {run.joints[j]} and limit, deg C", time, value[:, j], limit)
        sentence = f"{run.joints[j]} is at {value[:, j].max():.0f} deg C, limit {HOT_DEG_C:.0f}"
        return Measurement(
            float(value.max()), sentence, (float(time[0]), float(time[-1])), (trace,), limit=HOT_DEG_C
        )


class WeakDrive(Cause):
    """One drive gives less torque than its command asks for, while the others follow theirs."""

    link = Link.DRIVES
    unit = "share"
    least = 0.15
    needs = ("torque",)
    remedy = "Exchange the drive with another one of its kind: if the weakness moves along, it is the drive"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, fits = signals.run, signals.torque.fits
        given = np.array([fit.command for fit in fits])
        middle = float(np.median(given))
        if middle < CLEAR_COEFFICIENT:
            return None
        lacks = np.array(
            [1.0 - fit.command / middle if fit.share_used > MIN_SHARE_USED else 0.0 for fit in fits]
        )
        j = int(np.argmax(lacks))
        sentence = f"{run.joints[j]} gives {100 * given[j]:.0f} % of the asked torque, the others {100 * middle:.0f} %"
        gain = "its gains may be set lower instead: read them from the drive"
        return Measurement(
            float(lacks[j]), f"{sentence} ({gain})", torque_span(signals, j), (joint_trace(signals, j),)
        )


class JammedJoint(Cause):
    """A joint stands still much longer than the others of its kind, while these move: it is jammed or sluggish."""

    link = Link.DRIVES
    unit = "times the largest of healthy walks"
    least = 1.4
    needs = ("robot",)
    remedy = "Switch off and move the joint by hand; look for a brake, a cable or a broken gear"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        width = min(round(REST_WINDOW_S / run.period), len(run.time) - 1)
        others = np.convolve(
            np.median(np.abs(run.dq), axis=1),
            np.full(2 * (width // 5) + 1, 1.0 / (2 * (width // 5) + 1)),
            "same",
        )
        moving = run.walking & (others > MOVING_RAD_S)
        rest = (np.abs(run.dq) < REST_RAD_S) & moving[:, None]
        total, rests = _moving_sum(moving[:, None], width), _moving_sum(rest, width)
        full = total[:, 0] >= 0.5 * width
        if not full.any():
            return None
        # Share of the time at rest, less that of the median joint of its kind, by what healthy walks show of it.
        share = (rests / np.maximum(total, 1.0)).reshape(-1, 4, len(KINDS))
        more = (share - np.median(share, axis=1, keepdims=True)) / np.array(HEALTHY_REST_SHARES)
        more = np.where(full[:, None], more.reshape(-1, 12), 0.0)
        row, j = np.unravel_index(int(np.argmax(more)), more.shape)
        other = (int(j) + 3) % 12
        span = float(run.time[row]), float(run.time[int(row) + width])
        title = f"speed of {run.joints[j]} and of {run.joints[other]}, rad/s"
        trace = Trace(title, run.time, run.dq[:, j], run.dq[:, other])
        sentence = (
            f"{run.joints[j]} stands still for {100 * share.reshape(-1, 12)[row, j]:.0f} % of {span[1] - span[0]:.1f} s"
            " while the others move"
        )
        return Measurement(float(more[row, j]), sentence, span, (trace,))


def _moving_sum(values: Array | Bools, width: int) -> Array:
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    return np.asarray(total[width:-1] - total[: -width - 1])


@attrs.frozen(eq=False)
class _Shortfall:
    """Rows in which a joint gives less torque than its fit explains.

    Attributes:
        joint: Index of the joint.
        rows: (n,).
        share: Share of the usable rows.
        level: Median torque of these rows, N m.
        falls_with_speed: Whether the torque of these rows falls with the joint's speed.
    """

    joint: int
    rows: Bools
    share: float
    level: float
    falls_with_speed: bool


def _shortfall(signals: Signals) -> _Shortfall | None:
    """Shortfall of the joint with most of it."""
    run, model = signals.run, signals.torque
    assert run.tau is not None
    found = []
    gain = float(np.median([fit.command for fit in model.fits]))
    for j, fit in enumerate(model.fits):
        asked, given = gain * model.asked[:, j], run.tau[:, j]
        # A drive that gives a constant share of what is asked for is weak, not limited.
        x, y = asked[model.rows], given[model.rows]
        share = float(x @ y) / max(float(x @ x), 1e-9)
        if robust_std(y - share * x) < PROPORTIONAL * fit.spread and share < 1.0 - CLEARLY_LESS:
            continue
        lacks = np.abs(asked) - given * np.sign(asked)
        rows = model.rows & (lacks > SHORT_OF * fit.spread) & (np.abs(asked) > MIN_ASKED_NM)
        # A late torque is as often too large as too small; a limit only makes it smaller.
        excess = model.rows & (lacks < -SHORT_OF * fit.spread) & (np.abs(asked) > MIN_ASKED_NM)
        found.append((int(rows.sum()) - 3 * int(excess.sum()), j, rows))
    count, j, rows = max(found, key=lambda entry: entry[0], default=(0, 0, model.rows))
    if count < MIN_SHORT_ROWS:
        return None
    given, speed = np.abs(run.tau[rows, j]), np.abs(run.dq[rows, j])
    level = float(np.median(given))
    # Of a constant limit the torques do not vary, but for noise.
    varies = float(np.std(given)) > FLAT_SHARE * level
    falls = varies and float(np.corrcoef(given, speed)[0, 1]) < FALLS
    return _Shortfall(j, rows, float(rows.sum() / model.rows.sum()), level, falls)


class TorqueLimit(Cause):
    """A drive gives no more than a constant torque, although more is asked for."""

    link = Link.DRIVES
    unit = "share"
    least = 0.01
    needs = ("torque",)
    remedy = "Compare the limit with the drive's data; walk slower, or train with this limit (`actuator` of the recipe)"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        short = _shortfall(signals)
        if short is None or short.falls_with_speed:
            return NOTHING
        run, j = signals.run, short.joint
        rated = f", rated {run.robot.torque_limit[j]:.1f} N m" if run.is_own else ""
        sentence = (
            f"{run.joints[j]} gives {short.level:.1f} N m{rated} while more is asked for, in "
            f"{100 * short.share:.1f} % of the states"
        )
        trace = joint_trace(signals, j, signals.torque.asked[:, j])
        return Measurement(short.share, sentence, worst_span(run.time, short.rows.astype(float)), (trace,))


class SpeedTorqueLimit(Cause):
    """A drive gives less torque the faster the joint turns, although more is asked for."""

    link = Link.DRIVES
    unit = "share"
    least = 0.01
    needs = ("torque",)
    remedy = "Compare with the drive's speed-torque curve and the supply voltage; walk slower, or train with the curve"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        short = _shortfall(signals)
        if short is None or not short.falls_with_speed:
            return NOTHING
        run, j = signals.run, short.joint
        assert run.tau is not None
        slope, stall = np.polyfit(np.abs(run.dq[short.rows, j]), np.abs(run.tau[short.rows, j]), 1)
        sentence = (
            f"{run.joints[j]}: the torque falls from {stall:.0f} N m at rest by {-slope:.1f} N m for each rad/s, in "
            f"{100 * short.share:.1f} % of the states"
        )
        trace = joint_trace(signals, j, signals.torque.asked[:, j])
        return Measurement(short.share, sentence, worst_span(run.time, short.rows.astype(float)), (trace,))

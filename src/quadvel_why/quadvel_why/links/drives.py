"""Drives: do they give the torque that is asked for, and do the joints move?"""

from __future__ import annotations

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import KINDS

from ..cause import NOTHING, Cause, Link, Measurement, Trace, worst_span
from ..legs import WALKED_SLOPE_RAD
from ..run import Run
from ..signals import Signals
from ..torque import robust_std
from .contract import CERTAIN, CLEAR_COEFFICIENT, HOT_DEG_C, MIN_SHARE_USED, joint_trace, torque_span

CERTAIN_GAIN = 0.1
"""Standard error below which a joint shows the gain of the drives."""
SHORT_OF = 6.0
"""A torque is too small if it lacks more than this many standard deviations."""
MIN_ASKED_NM = 4.0
PROPORTIONAL, CLEARLY_LESS = 1.5, 0.1
"""Spread around a constant share of the asked torque, by that of the fit, and how much less it has to be."""
MIN_SHORT_ROWS = 8
FALLING_SHARE, MAX_T = 0.03, -5.0
"""Fall of a limit with the speed, by its torque, and t of their correlation; a constant limit has 0.001 and -1."""
GIVES_MORE = 1.5
"""A drive whose largest torque is so many times the torque at its limit has no constant limit."""
REST_WINDOW_S = 0.5
REST_RAD_S, MOVING_RAD_S = 0.25, 0.6
"""Speed of a joint at rest, and median speed of all joints of a robot that moves."""
HEALTHY_REST_SHARES, HEALTHY_RANGE_SHARES = (0.57, 0.40, 0.46), (0.08, 0.43, 0.37)
"""Largest surplus of the time at rest, and smallest share of the range of motion, of a hip, thigh and calf in healthy
walks, trotting or pacing (24 of each), relative to the median joint of the kind."""
WINDOWS_OVERLAP = 10
"""Windows that begin within the length of one."""


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
    needs = ("drives",)
    remedy = "Exchange the drive with another one of its kind: if the weakness moves along, it is the drive"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        given, error, used = _given_shares(signals)
        middle = float(np.median(given))
        if middle < CLEAR_COEFFICIENT or not (used > 0.0).any():
            return None
        # A joint that hardly moves does not determine its share: only what is certain counts.
        lacks = np.where(used > MIN_SHARE_USED, 1.0 - (given + CERTAIN * error) / middle, 0.0)
        j = int(np.argmax(lacks))
        sentence = f"{run.joints[j]} gives {100 * given[j]:.0f} % of the asked torque, the others {100 * middle:.0f} %"
        gain = "its gains may be set lower instead: read them from the drive"
        return Measurement(
            float(lacks[j]), f"{sentence} ({gain})", torque_span(signals, j), (joint_trace(signals, j),)
        )


def _given_shares(signals: Signals) -> tuple[Array, Array, Array]:
    """Share of the asked torque that each joint gives, its standard error, and the share of rows that fit, (J,) each.

    The last is 0 for a joint that has not moved.
    """
    if "torque" in signals.parts:
        each = [(f.command, f.errors[0], f.share_used * f.has_moved) for f in signals.torque.fits]
        return tuple(np.array(x) for x in zip(*each, strict=True))  # type: ignore[return-value]
    # A robot that stopped at once: tau = share asked, with the commanded gains.
    run, exact = signals.run, signals.torque.exact
    assert run.tau is not None
    rows = run.command_rows(exact.delay)
    keep = (rows >= 0) & run.commands.servo[np.maximum(rows, 0)]
    x, y = signals.torque.asked_at(exact.delay)[keep], run.tau[keep]
    energy = np.maximum((x**2).sum(axis=0), 1e-9)
    share = (x * y).sum(axis=0) / energy
    error = np.sqrt(np.mean((y - share * x) ** 2, axis=0) / energy)
    return share, error, np.ones(len(share))


class JammedJoint(Cause):
    """A joint stands still much longer than the others of its kind, or moves much less, while these move: it is jammed
    or sluggish.
    """

    link = Link.DRIVES
    unit = "times the largest of healthy walks"
    least = 1.4
    needs = ("robot",)
    remedy = "Switch off and move the joint by hand; look for a brake, a cable or a broken gear"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        if {"torque", "imu"} <= signals.parts:
            if "ground" not in signals.parts:
                return None  # whoever moves the joints of a suspended robot need not move them alike
            if signals.legs.plane.angle > WALKED_SLOPE_RAD:
                return NOTHING  # on such ground sound joints rest for longer, too
        width = min(round(REST_WINDOW_S / run.period), len(run.time) - 1)
        smooth = 2 * (width // 5) + 1
        others = np.convolve(np.median(np.abs(run.dq), axis=1), np.full(smooth, 1.0 / smooth), "same")
        moving = run.walking & (others > MOVING_RAD_S)
        total = _moving_sum(moving[:, None], width)
        if not (total >= 0.5 * width).any():
            return None
        row, joint, value, what = max(
            _longest_rest(run, moving, total, width),
            _smallest_range(run, total, width),
            key=lambda one: one[2],
        )
        other = (joint + len(KINDS)) % len(run.joints)
        span = float(run.time[row]), float(run.time[row + width])
        title = f"speed of {run.joints[joint]} and of {run.joints[other]}, rad/s"
        trace = Trace(title, run.time, run.dq[:, joint], run.dq[:, other])
        sentence = f"{run.joints[joint]} {what} of {span[1] - span[0]:.1f} s in which the others move"
        return Measurement(value, sentence, span, (trace,))


def _longest_rest(run: Run, moving: Bools, total: Array, width: int) -> tuple[int, int, float, str]:
    """First row, joint, surplus of the time at rest by that of healthy walks, and a text, of the worst window."""
    rest = (np.abs(run.dq) < REST_RAD_S) & moving[:, None]
    share = (_moving_sum(rest, width) / np.maximum(total, 1.0)).reshape(-1, 4, len(KINDS))
    more = (share - np.median(share, axis=1, keepdims=True)) / np.array(HEALTHY_REST_SHARES)
    more = np.where(total >= 0.5 * width, more.reshape(-1, 12), 0.0)
    row, joint = np.unravel_index(int(np.argmax(more)), more.shape)
    at_rest = 100 * share.reshape(-1, 12)[row, joint]
    return int(row), int(joint), float(more[row, joint]), f"stands still for {at_rest:.0f} %"


def _smallest_range(run: Run, total: Array, width: int) -> tuple[int, int, float, str]:
    """The same for the range of motion: that of the median joint of the kind by the joint's own."""
    rows = np.flatnonzero(total[:, 0] >= 0.5 * width)[:: max(width // WINDOWS_OVERLAP, 1)]
    if not len(rows):
        return 0, 0, 0.0, ""
    ranges = np.array([np.ptp(run.q[row : row + width], axis=0) for row in rows]).reshape(-1, 4, len(KINDS))
    share = ranges / np.maximum(np.median(ranges, axis=1, keepdims=True), 1e-6)
    less = (np.array(HEALTHY_RANGE_SHARES) / np.maximum(share, 1e-3)).reshape(-1, 12)
    k, joint = np.unravel_index(int(np.argmax(less)), less.shape)
    moves = 100 * share.reshape(-1, 12)[k, joint]
    return (
        int(rows[k]),
        int(joint),
        float(less[k, joint]),
        f"moves by {moves:.0f} % of the range of its kind in the course",
    )


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
        is_at_rest: Whether the joint hardly turns in these rows, so that a fall would not show.
    """

    joint: int
    rows: Bools
    share: float
    level: float
    falls_with_speed: bool
    is_at_rest: bool

    @property
    def alternatives(self) -> tuple[tuple[str, str], ...]:
        """What looks the same as a constant limit in these rows, and how to tell them apart."""
        experiment = "let the joint turn fast under load: only the limit of a speed-torque curve falls then"
        return (("speed_torque_limit", experiment),) if self.is_at_rest else ()


def _shortfall(signals: Signals) -> _Shortfall | None:
    """Shortfall of the joint with most of it."""
    run, model = signals.run, signals.torque
    assert run.tau is not None
    found = []
    certain = [fit.command for fit in model.fits if fit.errors[0] < CERTAIN_GAIN]
    gain = float(np.median(certain)) if certain else signals.trained.gains[0]
    for j, fit in enumerate(model.fits):
        asked, given = gain * model.asked[:, j], run.tau[:, j]
        # A drive that gives a constant share of what is asked for is weak, not limited.
        x, y = asked[model.rows], given[model.rows]
        share = float(x @ y) / max(float(x @ x), 1e-9)
        magnitude = np.abs(y)
        level, spread = float(np.median(magnitude)), robust_std(y - share * x)
        is_constant = robust_std(magnitude - level) < spread and level > SHORT_OF * fit.spread
        is_proportional = spread < PROPORTIONAL * fit.spread and not is_constant
        if is_proportional and share < 1.0 - CLEARLY_LESS:
            continue
        lacks = np.abs(asked) - given * np.sign(asked)
        rows = model.rows & (lacks > SHORT_OF * fit.spread) & (np.abs(asked) > MIN_ASKED_NM)
        # A late torque is as often too large as too small; a limit only makes it smaller.
        excess = model.rows & (lacks < -SHORT_OF * fit.spread) & (np.abs(asked) > MIN_ASKED_NM)
        found.append((int(rows.sum()) - 3 * int(excess.sum()), j, rows))
    count, j, rows = max(found, key=lambda entry: entry[0], default=(0, 0, model.rows))
    if count < MIN_SHORT_ROWS:
        return None
    given, speed = np.abs(run.tau[rows, j]), _motoring_speed(run.tau[rows, j], run.dq[rows, j])
    return _Shortfall(
        j,
        rows,
        float(rows.sum() / model.rows.sum()),
        float(np.median(given)),
        _falls(given, speed)
        or bool(np.percentile(np.abs(run.tau[model.rows, j]), 99.0) > GIVES_MORE * np.median(given)),
        bool(np.percentile(speed, 95.0) < REST_RAD_S),
    )


def _falls(torque: Array, speed: Array) -> bool:
    """Whether torques at a limit fall with the speed, clearly and by more than their noise.

    The fall is that of a line between the 5 % slowest and fastest. For a correlation r of n pairs,
    t = r sqrt((n - 2) / (1 - r^2)) is Student's if they are independent.
    """
    slow, fast = np.percentile(speed, (5.0, 95.0))
    if np.ptp(torque) == 0.0 or slow == fast:
        return False
    fall = -np.polyfit(speed, torque, 1)[0] * (fast - slow)
    r = float(np.corrcoef(torque, speed)[0, 1])
    t = r * np.sqrt((len(torque) - 2) / max(1.0 - r**2, 1e-9))
    return bool(fall > FALLING_SHARE * np.median(torque) and t < MAX_T)


def _motoring_speed(torque: Array, speed: Array) -> Array:
    """Speed in the direction of the torque, rad/s; 0 while the motor brakes."""
    return np.maximum(speed * np.sign(torque), 0.0)


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
        span = worst_span(run.time, short.rows.astype(float))
        return Measurement(short.share, sentence, span, (trace,), short.alternatives)


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
        given = run.tau[short.rows, j]
        slope, stall = np.polyfit(_motoring_speed(given, run.dq[short.rows, j]), np.abs(given), 1)
        sentence = (
            f"{run.joints[j]}: the torque falls from {stall:.0f} N m at rest by {-slope:.1f} N m for each rad/s, in "
            f"{100 * short.share:.1f} % of the states"
        )
        trace = joint_trace(signals, j, signals.torque.asked[:, j])
        return Measurement(short.share, sentence, worst_span(run.time, short.rows.astype(float)), (trace,))

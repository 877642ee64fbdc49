"""Checks of single channels: motionless, repeated, clipped, duplicated or missing ones.

`table` runs all checks in order. `response` compares channels with each other; `commands` looks for
commands that rest.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.arrays import Bools, Floats, Indices
from quadvel_description.name_list import format_names
from quadvel_description.quadruped import JOINT_NAMES

from ..findings import Finding
from ..log import Log

MAX_ROWS = 20_000
"""Rows that a check reads at most; they are spread evenly over the log to bound its memory."""
TURN_RAD = 2.0 * np.pi
"""rad; one full turn."""
DEGREE_RAD = np.pi / 180.0
"""rad; one degree."""
SLOPE_HALF_WIDTH_S = 0.005
"""s to either side over which a slope of q is computed, at least one row."""
MOVING_SPEED_RAD_S = 0.05
"""rad/s; a joint moves from this speed on."""
MOVING_SPAN_RAD = 1e-3
"""rad; a joint whose q spans less is motionless."""
RESTING_RAD, RESTING_RATIO = 0.01, 1.3
"""Standard deviation of q, and its ratio to that of white noise with the same second differences, below
which a joint rests but for the noise of its encoder. Of noise the ratio is 1, of motion that a log can show
it is larger: 2 at a sixth of the rate of the rows.
"""
REPEATED_ROWS_SHARE = 0.5
"""If more than this share of the rows in motion repeats the row before, the logger is faster than
the state.
"""
MIN_CLIP_ROWS, MIN_CLIP_VISITS = 3, 3
"""Rows of one visit of an extreme value, and number of such visits, from which a channel is clipped."""
MAX_CLIP_SHARE, MIN_CLIP_SHARE = 0.5, 0.002
"""Share of the rows at the extreme value between which a channel is clipped."""
HELD_COMMAND_S = 0.25
"""s; a command that rests longer at an extreme value is a held posture, such as between two steps."""
MIN_CLIP_STEP = 0.1
"""Step of a command into the extreme value, relative to its mean step in motion, below which it comes
to rest there by itself.
"""
CONSTANT_SPAN = 1e-9
"""A channel that spans less is constant but for rounding."""
RANGE_MARGIN_RAD = 0.4
"""rad beyond the model's joint range; from there the joint's name is doubted."""


def sample_rows(log: Log) -> Indices:
    """Select at most `MAX_ROWS` rows, spread evenly over the log.

    Args:
        log: The log.

    Returns:
        (R,) row indices, increasing.
    """
    return np.unique(np.linspace(0, len(log.t) - 1, min(MAX_ROWS, len(log.t))).astype(np.intp))


def slope_at_rows(log: Log, values: Floats, row: Indices) -> Floats:
    """Compute central differences over `SLOPE_HALF_WIDTH_S` to either side.

    Args:
        log: The log whose times apply.
        values: (N, J) signal.
        row: (R,) rows at which the slope is computed.

    Returns:
        (R, J) slope, units of `values` per second.
    """
    reach = max(1, round(SLOPE_HALF_WIDTH_S / log.period))
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, len(log.t) - 1)
    return np.asarray((values[last] - values[first]) / (log.t[last] - log.t[first])[:, None], dtype=float)


def resting(log: Log) -> Bools:
    """Return which joints never move, but for the noise of their encoders.

    Args:
        log: The log.

    Returns:
        (J,).
    """
    span, spread = np.ptp(log.q, axis=0), np.std(log.q, axis=0)
    # White noise of variance s^2 has second differences of variance 6 s^2.
    noise = np.std(np.diff(log.q, n=2, axis=0), axis=0) / np.sqrt(6.0)
    rests = (spread < RESTING_RAD) & (spread < RESTING_RATIO * noise)
    return np.asarray((span < MOVING_SPAN_RAD) | rests)


def motionless(log: Log) -> Iterator[Finding]:
    """Joints that never move, but for the noise of their encoders.

    Args:
        log: The log to check.

    Yields:
        A refusal if no joint moves, a warning if some joints do not.
    """
    still = log.joints_where(resting(log))
    if len(still) == len(log.joints):
        largest = 1e3 * np.std(log.q, axis=0).max()
        text = f"q: no joint moves by more than {largest:.1f} mrad (rms), so nothing can be identified"
        yield Finding("refusal", "q", still, f"{text}: record a motion, as `quadvel excite` does")
    elif still:
        text = f"q: never moves: {format_names(still)}; only their torque at rest is observed"
        yield Finding("warning", "q", still, text)


def torque_presence(log: Log) -> Iterator[Finding | Log]:
    """Torque that is not there, or never changes.

    Args:
        log: The log to check.

    Yields:
        A note or a warning; the log without `tau` if it is constant on all joints.
    """
    tau = log.tau
    if tau is not None:
        constant = log.joints_where(np.ptp(tau, axis=0) == 0.0)
        if len(constant) == len(log.joints):
            values = ", ".join(f"{value:g}" for value in np.unique(tau[0]))
            text = f"tau: is {values} throughout, which is no measurement; treated as not logged"
            yield Finding("warning", "tau", constant, text)
            tau, log = None, attrs.evolve(log, tau=None)
            yield log
        elif constant:
            yield Finding("warning", "tau", constant, f"tau: never changes: {format_names(constant)}")
    if tau is None:
        text = "tau: not in the log; effects are judged by the motion that follows from the commands"
        yield Finding("note", "tau", (), text)


def torque_or_gains(log: Log) -> Iterator[Finding]:
    """Gains that are not there although the torque is missing, so that nothing gives the scale.

    Args:
        log: The log to check.

    Yields:
        A refusal if both the torque and one of the gains are missing.
    """
    lacking = [name for name in ("kp", "kd") if getattr(log, name) is None]
    if log.tau is None and lacking:
        text = (
            f"tau, {', '.join(lacking)}: not in the log; expected the torque, or the commanded gains in N m/rad "
            "and N m s/rad (--gains KP KD), as nothing else gives the scale; gains in a servo's own units do not"
        )
        yield Finding("refusal", "tau", (), text)


def commanded_gains(log: Log) -> Iterator[Finding]:
    """Gains that are not there, change, or are negative.

    Args:
        log: The log to check.

    Yields:
        A refusal of negative gains, notes on missing or changing ones.
    """
    for field, values in (("kp", log.kp), ("kd", log.kd)):
        if values is None:
            fitted = "" if log.tau is None else "; it is fitted"
            yield Finding("note", field, (), f"{field}: not in the log{fitted}")
            continue
        if (values < 0.0).any():
            text = f"{field}: found {values.min():g}, expected gains of 0 or more"
            yield Finding("refusal", field, (), text)
        used = values[(values > 0.0).any(axis=1)]
        if len(used) and (np.ptp(used, axis=0) > 1e-6 * used.max()).any():
            text = f"{field}: changes in the log, {used.min():g} to {used.max():g}"
            yield Finding("note", field, (), text)
        if field == "kd" and not len(used):
            text = "kd: 0 was commanded; the drive's own damping is fitted"
            yield Finding("note", field, (), text)


def repeated_rows(log: Log) -> Iterator[Finding | Log]:
    """Rows that repeat the whole state before although the joints move.

    If most rows repeat, the rows in which the state changed become the log.

    Args:
        log: The log to check.

    Yields:
        A note or warning; the log without the repeated rows if these are the majority.
    """
    parts = [log.q, log.tau, None if "dq" in log.derived else log.dq]
    same = np.all([(np.diff(x, axis=0) == 0.0).all(axis=1) for x in parts if x is not None], axis=0)
    # Rows from one change of the state to the next.
    runs = np.diff(np.flatnonzero(np.concatenate([[True], ~same, [True]])))
    low, usual, high = np.percentile(runs, [25, 50, 75])
    if usual >= 2 and high - low <= 0.25 * usual:
        moving = np.ones_like(same)  # regular repeats come from the logger, so all rows count
    else:
        moving = np.abs(log.dq[1:]).max(axis=1) > MOVING_SPEED_RAD_S
    repeated, total = int((same & moving).sum()), max(1, int(moving.sum()))
    share = repeated / total
    if share > REPEATED_ROWS_SHARE:
        fresh = log.select_rows(np.concatenate([[True], ~same]))
        text = (
            f"q: {100 * share:.0f} % of the rows repeat the state before (usually {usual:.0f} rows show one "
            f"state); those in which it changed are used, {1.0 / fresh.period:.3g} Hz"
        )
        yield Finding("warning", "q", (), text)
        yield fresh
        return
    if log.tau is not None:
        late = (np.diff(log.tau, axis=0) == 0.0).all(axis=1)
        tau_share = int((late & moving).sum()) / total
        if tau_share > REPEATED_ROWS_SHARE:
            text = (
                f"tau: {100 * tau_share:.0f} % of the rows repeat the torque before; those in which it changed "
                "are used"
            )
            yield Finding("warning", "tau", (), text)
            yield attrs.evolve(log, valid=log.valid & ~np.concatenate([[False], late])[:, None])
    if repeated:
        text = f"q: {repeated} rows ({100 * share:.1f} % of those in motion) repeat the row before"
        yield Finding("warning" if share > 0.01 else "note", "q", (), text)


def duplicated_channels(log: Log) -> Iterator[Finding]:
    """Two joints whose measurements are the same to the bit.

    Args:
        log: The log to check.

    Yields:
        A warning for the first such pair of each field.
    """
    row = sample_rows(log)
    for field in ("q", "tau"):
        values = getattr(log, field)
        seen: dict[bytes, str] = {}
        for j, joint in enumerate(log.joints if values is not None else ()):
            column = np.ascontiguousarray(values[row, j])
            other = seen.setdefault(column.tobytes(), joint)
            if other != joint and np.ptp(column) > 0.0:
                text = f"{field}: {joint} and {other} are the same to the bit: one measured joint under two names?"
                yield Finding("warning", field, (other, joint), text)
                break


def joint_ranges(log: Log) -> Iterator[Finding]:
    """Joints outside the range of the model's joint of that name; unknown names next to known ones.

    Args:
        log: The log to check.

    Yields:
        Warnings.
    """
    named = [name for name in log.joints if name in JOINT_NAMES]
    if named and len(named) < len(log.joints):
        strange = tuple(name for name in log.joints if name not in JOINT_NAMES)
        text = f"joint_names: {format_names(strange)}: not among the model's joints, though {named[0]} is"
        yield Finding("warning", "joint_names", strange, text)
    if log.robot is None:
        return
    outside, robot = {}, log.robot
    for name in named:
        low, high = np.percentile(log.q[:, log.joints.index(name)], [1, 99])
        joint = JOINT_NAMES.index(name)
        lower, upper = robot.lower[joint], robot.upper[joint]
        if low < lower - RANGE_MARGIN_RAD or high > upper + RANGE_MARGIN_RAD:
            outside[name] = f"{name} {low:.2f} to {high:.2f} (the model's: {lower:.2f} to {upper:.2f})"
    if outside:
        text = (
            f"joint_names: q contradicts the model's range, rad: {format_names(list(outside.values()), 2)}: "
            "another order of names, or another robot?"
        )
        yield Finding("warning", "joint_names", tuple(outside), text)


def clipped_channels(log: Log) -> Iterator[Finding]:
    """Channels whose motion ends at one extreme value again and again.

    A command that comes to rest smoothly, or is held for long, is a posture, not a clip.

    Args:
        log: The log to check.

    Yields:
        A warning for each field with clipped joints; a note for commands.
    """
    for field, unit in (("q", "rad"), ("dq", "rad/s"), ("tau", "N m"), ("q_des", "rad")):
        values = getattr(log, field)
        hit: dict[str, str] = {}
        for j, joint in enumerate(log.joints if values is not None else ()):
            channel = values[:, j]
            if np.ptp(channel) < CONSTANT_SPAN:
                continue
            for bound in (float(channel.min()), float(channel.max())):
                at = np.abs(channel - bound) < CONSTANT_SPAN
                edges = np.flatnonzero(np.diff(np.concatenate([[0], at, [0]])))
                first, runs = edges[::2], np.diff(edges)[::2]  # first row and number of rows of each run
                if field == "q_des":
                    steps = np.abs(np.diff(channel, prepend=channel[0]))
                    abrupt = steps[first] >= MIN_CLIP_STEP * steps[steps > CONSTANT_SPAN].mean()
                    runs = runs[abrupt & (runs * log.period <= HELD_COMMAND_S)]
                share = runs.sum() / len(channel)
                repeated = np.sum(runs >= MIN_CLIP_ROWS) >= MIN_CLIP_VISITS
                if repeated and MIN_CLIP_SHARE < share < MAX_CLIP_SHARE:
                    shown = 0.0 if abs(bound) < CONSTANT_SPAN else bound
                    hit[joint] = f"{joint} at {shown:.4g} in {100 * share:.1f} %"
        if hit:
            text = f"{field}: clipped ({unit}): {format_names(list(hit.values()))} of the rows"
            yield Finding("note" if field == "q_des" else "warning", field, tuple(hit), text)

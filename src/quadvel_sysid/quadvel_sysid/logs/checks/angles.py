"""Checks of joint angles against speeds and torques: wraps, signs, units, unusable speeds.

A check that can correct the defect yields the corrected log; the checks after it receive that
log.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.arrays import Bools, Floats
from quadvel_description.name_list import format_names
from quadvel_description.quadruped import JOINT_NAMES

from ..findings import Finding, Kind
from ..log import Log
from .channels import (
    DEGREE_RAD,
    MOVING_SPAN_RAD,
    MOVING_SPEED_RAD_S,
    TURN_RAD,
    sample_rows,
    slope_at_rows,
)
from .response import measure_response
from .slopes import encoder_step, resting_rows, smooth_motion
from .torque import lacks_sign

WRAP_TOLERANCE_RAD = 1.0
"""rad; how far a step from row to row may differ from a full turn (50 rad/s at 50 Hz)."""
UNIT_CORRELATION, UNIT_FACTOR = 0.95, 1.4
"""A ratio of the slope of q to dq is a unit if their correlation exceeds `UNIT_CORRELATION` and the
ratio, or its inverse, this factor.
"""
EXCHANGED_CORRELATION, EXCHANGED_ERROR_RATIO = 0.9, 0.25
"""q and q_des are exchanged if dq correlates above `EXCHANGED_CORRELATION` with the slope of q_des,
which leaves less than this share of what the slope of q leaves of its variance.
"""
UNRELATED_CORRELATION = 0.3
"""If the correlation of dq with the slope of q is below, dq is not the speed of that joint."""
ZERO_SPEED_SHARE = 2e-4
"""Size of dq over that of the slope of q, below which dq is noise about 0."""
SAME_ANGLE_SHARE = 0.7
"""q and q_des are one angle in two units if they differ by less than this share of their size."""
MAX_ANGLE_RAD = 10.0
"""rad; no joint of a leg or an arm reaches so far."""
MAX_MISSED_RAD = 1.0
"""rms of q_des - q: a joint that turns further than a leg's, and is controlled, stays nearer to its command."""
UNITS_OF_SPEED = (
    (1.0 / DEGREE_RAD, "q is in degrees where dq is in rad/s, or t is off by 57"),
    (DEGREE_RAD, "dq is in degrees/s where q is in rad"),
    (1e-3, "q is in units of 1000 rad, or t in milliseconds"),
    (1e3, "dq is in units of 1000 rad/s, or t in 1000 s"),
    (TURN_RAD / 60.0, "dq is in turns a minute where q is in rad"),
)
"""Known ratios of the slope of q to dq, each with the mistake that causes it."""
UNIT_TOLERANCE_LOG = np.log(1.7)
"""Natural logarithm of the factor by which a noisy ratio may differ from a known one."""


def wrapped_angles(log: Log) -> Iterator[Finding | Log]:
    """Angles that jump by a full turn from one row to the next.

    Args:
        log: The log to check.

    Yields:
        A warning, and the log with `q` and `q_des` unwrapped. `dq` is corrected in rows where it
        is the difference across the jump.
    """
    for turn, unit in ((TURN_RAD, "2 pi"), (360.0, "360")):
        jumps = np.abs(np.abs(np.diff(log.q, axis=0)) - turn) < WRAP_TOLERANCE_RAD * turn / TURN_RAD
        hit: Bools = np.asarray(jumps.any(axis=0))
        if not hit.any():
            continue
        q, q_des = (
            np.unwrap(
                np.asarray(x, dtype=float), turn * (1.0 - WRAP_TOLERANCE_RAD / TURN_RAD), axis=0, period=turn
            )
            for x in (log.q, log.q_des)
        )
        # The unwrapped angles may differ from the commands by full turns; remove these.
        off = np.median(q_des[log.command_rows(log.t)] - q, axis=0)
        q = np.where(hit, q + turn * np.round(off / turn), log.q)
        listed = format_names(log.joints_where(hit))
        text = f"q: jumps by {unit} in one row, {int(jumps.sum())} times on {listed}; unwrapped"
        yield Finding("warning", "q", log.joints_where(hit), text)
        # Speed of the jumps that were removed, in the rows where they happen.
        leap = (
            np.diff(q - log.q, axis=0, prepend=0.0 * q[:1])
            / np.diff(log.t, prepend=log.t[0] - log.period)[:, None]
        )
        differs = np.abs(log.dq + leap) < 0.5 * np.abs(leap)  # dq is the difference across the jump
        dq = np.where(differs, log.dq + leap, log.dq)
        yield attrs.evolve(log, q=q, dq=dq, q_des=np.where(hit, q_des, log.q_des))
        return


def exchanged_angles(log: Log) -> Iterator[Finding]:
    """Speeds that are the slope of q_des and not of q.

    Args:
        log: The log to check.

    Yields:
        A refusal, if it is so on most joints that move.
    """
    if "dq" in log.derived:
        return
    row = sample_rows(log)
    dq = np.asarray(log.dq[row], dtype=float)
    q_des = np.asarray(log.q_des[log.command_rows(log.t)], dtype=float)
    own, other = (_correlation(slope_at_rows(log, x, row), dq) for x in (log.q, q_des))
    moving = (_rms(dq) > MOVING_SPEED_RAD_S) & (np.ptp(log.q, axis=0) > MOVING_SPAN_RAD)
    hit = (
        moving
        & (other > EXCHANGED_CORRELATION)
        & (1.0 - other**2 < EXCHANGED_ERROR_RATIO * (1.0 - own * np.abs(own)))
    )
    if 2 * hit.sum() > moving.sum():
        listed = format_names(log.joints_where(hit))
        text = f"q: dq is the slope of q_des, and not of q, on {listed}: are q and q_des exchanged?"
        yield Finding("refusal", "q", log.joints_where(hit), text)


def unusable_speed(log: Log) -> Iterator[Finding | Log]:
    """Speeds that are missing, unsigned, not the slope of q, or differences of coarse angles.

    Args:
        log: The log to check.

    Yields:
        A note or a warning, and the log with `dq` computed from `q`. If commands, angles and the
        logged `dq` explain the torque better, the drive acted on the logged speed and it stays.
    """
    row = sample_rows(log)
    slope, dq = slope_at_rows(log, log.q, row), np.asarray(log.dq[row], dtype=float)
    moving = (np.minimum(_rms(slope), _rms(dq)) > MOVING_SPEED_RAD_S) & (
        np.ptp(log.q, axis=0) > MOVING_SPAN_RAD
    )
    coarse = encoder_step(log.q)
    size = format_names([f"{1e3 * step:.3g}" for step in dict.fromkeys(np.round(coarse[coarse > 0.0], 7))], 2)
    counts = f"q, dq: q counts in steps of {size} mrad, dq is its difference; recomputed"
    missing = np.full(len(coarse), "dq" in log.derived)
    unrelated = moving & (np.abs(_correlation(slope, dq)) < UNRELATED_CORRELATION)
    unsigned = "dq: has no sign on {}: it is never negative, though q goes both ways; made from q"
    cases: tuple[tuple[Kind, Bools, str], ...] = (
        ("note", missing, "dq: not in the log; made from q"),
        ("warning", lacks_sign(dq, slope), unsigned),
        ("warning", unrelated, "dq: is not the slope of q on {}; made from q"),
        ("warning", (coarse > 0.0) & _is_difference(log), counts),
    )
    for kind, hit, text in cases:
        if hit.any():
            made = smooth_motion(log.t, log.q, log.tau)
            resting = hit & resting_rows(log.t, log.q, coarse)
            mended = attrs.evolve(
                log,
                q=np.where(hit & (coarse > 0.0), made.q, log.q),
                dq=np.where(hit, made.dq, log.dq),
                valid=log.valid & ~resting,
            )
            if "dq" not in log.derived and _explained_share(mended) < _explained_share(log):
                text += ": but the drive acted on it, so it stays as logged"
                yield Finding(
                    "note", "dq", log.joints_where(hit), text.format(format_names(log.joints_where(hit)))
                )
            else:
                text += f" by cubics over {1e3 * made.window_s:.3g} ms"
                if resting.any():
                    text += (
                        f"; left out: {100.0 * resting.mean():.2g} % of the values, where q rests on one "
                        "count, so that the sign of the speed is not known"
                    )
                yield Finding(
                    kind, "dq", log.joints_where(hit), text.format(format_names(log.joints_where(hit)))
                )
                yield mended
            return


def _rms(x: Floats) -> Floats:
    """Root mean square of each column."""
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def _correlation(a: Floats, b: Floats) -> Floats:
    """Correlation of each column about 0; 0 if a column is 0."""
    return np.asarray(np.mean(a * b, axis=0) / (_rms(a) * _rms(b) + 1e-12))


def _explained_share(log: Log) -> float:
    """Share of the torque that commands, angles and speeds explain; 0 without torque."""
    found = measure_response(log)
    return 0.0 if found is None else 1.0 - float(np.mean(found.min_error_share))


def _is_difference(log: Log) -> Bools:
    """Joints (J,) whose dq equals, but for rounding, the backward or forward difference of q."""
    steps = np.diff(np.asarray(log.q, dtype=float), axis=0) / np.diff(log.t)[:, None]
    scale = np.sqrt(np.mean(steps**2, axis=0)) + 1e-12
    found = [np.mean(np.abs(dq - steps) < 1e-2 * scale, axis=0) > 0.95 for dq in (log.dq[1:], log.dq[:-1])]
    return np.asarray(found[0] | found[1])


def speed_units(log: Log) -> Iterator[Finding]:
    """Ratio of the slope of q to dq that shows a wrong unit, a wrong sign or a speed of 0.

    Args:
        log: The log to check.

    Yields:
        A refusal that names the mistake, or a warning of a noisy speed.
    """
    row = sample_rows(log)
    slope, dq = slope_at_rows(log, log.q, row), np.asarray(log.dq[row], dtype=float)
    turning, size, alike = _rms(slope), _rms(dq), _correlation(slope, dq)
    moving = (size > MOVING_SPEED_RAD_S) & (np.ptp(log.q, axis=0) > MOVING_SPAN_RAD)
    ratio = alike * turning / (size + 1e-12)
    off = np.abs(np.log(np.maximum(ratio, 1e-12)))
    known = np.any(
        [
            np.abs(np.log(np.maximum(ratio, 1e-12) / factor)) < UNIT_TOLERANCE_LOG
            for factor, _ in UNITS_OF_SPEED
        ],
        axis=0,
    )
    clear = (alike > UNIT_CORRELATION) & (off > np.log(UNIT_FACTOR))
    zero = (turning > MOVING_SPEED_RAD_S) & (size < ZERO_SPEED_SHARE * turning)
    opposite = moving & (alike < -UNRELATED_CORRELATION)
    noisy = "on {joints} the slope of q is {number:.2f} times dq: a noisy speed?"
    cases: tuple[tuple[Kind, Bools, str], ...] = (
        ("refusal", zero, "is 0 on {joints} although q moves; expected rad/s"),
        ("refusal", opposite, "has the opposite sign of the slope of q on {joints}"),
        ("refusal", moving & (clear | known), "the slope of q is {number:.3g} times dq on {joints}: {unit}"),
        ("warning", moving & (off > np.log(2.0)), noisy),
    )
    for kind, hit, text in cases:
        if hit.any():
            number = float(np.median(ratio[hit]))
            unit = next(
                (
                    text
                    for factor, text in UNITS_OF_SPEED
                    if abs(np.log(max(number, 1e-12) / factor)) < UNIT_TOLERANCE_LOG
                ),
                "expected q in rad, dq in rad/s, t in s",
            )
            description = text.format(joints=format_names(log.joints_where(hit)), number=number, unit=unit)
            yield Finding(kind, "dq", log.joints_where(hit), f"dq: {description}")
            return


def _is_same_angle(degrees: Floats, radians: Floats, valid: Bools) -> bool:
    """Whether the first angles, taken as degrees, are the second ones but for what a drive leaves."""
    off = np.sqrt(np.mean((DEGREE_RAD * degrees - radians) ** 2, where=valid))
    return bool(off < SAME_ANGLE_SHARE * np.sqrt(np.mean(radians**2, where=valid)))


def angle_units(log: Log) -> Iterator[Finding]:
    """Angles in valid rows that are too large for a joint, in q, in the commands or in both.

    Args:
        log: The log to check.

    Yields:
        A refusal or a warning.
    """
    row = sample_rows(log)
    valid = log.valid[row]
    if not valid.any():
        return
    q = np.asarray(log.q[row], dtype=float)
    q_des = np.asarray(log.q_des[log.command_rows(log.t[row])], dtype=float)
    for field, other, large, small in (("q_des", "q", q_des, q), ("q", "q_des", q, q_des)):
        share = float(np.sqrt(np.mean(large**2, where=valid) / (np.mean(small**2, where=valid) + 1e-300)))
        if 25.0 < share < 130.0 and _is_same_angle(large, small, valid):
            text = f"{field}: about {share:.0f} times as large as {other}: degrees? expected rad in both"
            yield Finding("refusal", field, (), text)
            return
    most = np.percentile(np.where(valid, np.abs(q), 0.0), 95, axis=0)
    # A joint of others may turn several times, but follows its command; in degrees it seems not to.
    error = np.where(valid, q_des - q, 0.0)
    missed = np.sqrt((error**2).sum(axis=0) / np.maximum(valid.sum(axis=0), 1))
    is_ours = set(log.joints) <= set(JOINT_NAMES)
    far = most > MAX_ANGLE_RAD
    findings: tuple[tuple[Kind, Bools, str], ...] = (
        ("refusal", far & (is_ours | (missed > MAX_MISSED_RAD)), ": degrees? expected rad"),
        ("warning", far, "; expected rad"),
    )
    for kind, hit, advice in findings:
        if joints := log.joints_where(hit):
            yield Finding(kind, "q", joints, f"q: up to {most.max():.0f} on {format_names(joints)}{advice}")
            return

"""Checks of what angles, speeds and torques say of each other: wrapped angles, missing signs, units; speeds made anew.

A check that can mend what it found yields the mended log, which those that follow are given.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.robot import JOINT_NAMES

from .channels import DEGREE, MOVING, REACHES, TURN, names, rows_of, slope_of
from .findings import Finding, Kind, some
from .log import Array, Bools, Log
from .response import measured
from .slopes import smoothed, tick
from .torque import unsigned

WRAPPED = 1.0
"""rad, how far a step from row to row may be off a full turn: 50 rad/s at 50 Hz."""
ALIKE, OFF = 0.95, 1.4
"""Correlation of dq with the slope of q from which their ratio is a unit, and how far, as a factor, that may be off 1."""
UNLIKE = 0.3
"""Correlation of dq with the slope of q below which they have nothing to do with each other."""
DEAD = 2e-4
"""Of the slope of q, that a speed of 0 may be by its noise."""
TURNS = 10.0
"""rad; a joint of a leg or an arm does not reach so far."""
UNITS_OF_SPEED = (
    (1.0 / DEGREE, "q is in degrees where dq is in rad/s, or t is off by 57"),
    (DEGREE, "dq is in degrees/s where q is in rad"),
    (1e-3, "q is in units of 1000 rad, or t in milliseconds"),
    (1e3, "dq is in units of 1000 rad/s, or t in 1000 s"),
    (TURN / 60.0, "dq is in turns a minute where q is in rad"),
)
"""What the slope of q divided by dq may be, when it is not 1: the mistake behind it."""
WITHIN = np.log(1.7)
"""Of the logarithm of such a ratio, that noisy speeds may be off it."""


def wrapped(log: Log) -> Iterator[Finding | Log]:
    """Angles that jump by a full turn from one row to the next."""
    for turn, unit in ((TURN, "2 pi"), (360.0, "360")):
        jumps = np.abs(np.abs(np.diff(log.q, axis=0)) - turn) < WRAPPED * turn / TURN
        hit: Bools = np.asarray(jumps.any(axis=0))
        if not hit.any():
            continue
        q, q_des = (
            np.unwrap(np.asarray(x, dtype=float), turn * (1.0 - WRAPPED / TURN), axis=0, period=turn)
            for x in (log.q, log.q_des)
        )
        off = np.median(q_des[log.command_rows(log.t)] - q, axis=0)
        q = np.where(hit, q + turn * np.round(off / turn), log.q)
        text = (
            f"q: jumps by {unit} in one row, {int(jumps.sum())} times on {some(names(log, hit))}; unwrapped"
        )
        yield Finding("warning", "q", names(log, hit), text)
        leap = (
            np.diff(q - log.q, axis=0, prepend=0.0 * q[:1])
            / np.diff(log.t, prepend=log.t[0] - log.period)[:, None]
        )
        differs = np.abs(log.dq + leap) < 0.5 * np.abs(leap)  # dq that was taken over the jump
        dq = np.where(differs, log.dq + leap, log.dq)
        yield attrs.evolve(log, q=q, dq=dq, q_des=np.where(hit, q_des, log.q_des))
        return


def speed(log: Log) -> Iterator[Finding | Log]:
    """Speeds that are not there, have no sign, are not the slope of q, or are the difference of coarse angles: made anew."""
    row = rows_of(log)
    slope, dq = slope_of(log, log.q, row), np.asarray(log.dq[row], dtype=float)
    moving = (np.minimum(_size(slope), _size(dq)) > MOVING) & (np.ptp(log.q, axis=0) > REACHES)
    coarse = tick(log.q)
    size = some([f"{1e3 * step:.3g}" for step in dict.fromkeys(np.round(coarse[coarse > 0.0], 7))], 2)
    counts = f"q, dq: q counts in steps of {size} mrad, dq is its difference; made anew"
    cases: tuple[tuple[Kind, Bools, str], ...] = (
        ("note", np.full(len(coarse), "dq" in log.made), "dq: not in the log; made from q"),
        ("warning", unsigned(dq, slope), "dq: has no sign on {}: it is never negative, though q goes both ways; made from q"),
        ("warning", moving & (np.abs(_alike(slope, dq)) < UNLIKE), "dq: is not the slope of q on {}; made from q"),
        ("warning", (coarse > 0.0) & _is_difference(log), counts),
    )  # fmt: skip
    for kind, hit, text in cases:
        if hit.any():
            made = smoothed(log.t, log.q, log.tau)
            mended = attrs.evolve(
                log, q=np.where(hit & (coarse > 0.0), made.q, log.q), dq=np.where(hit, made.dq, log.dq)
            )
            if "dq" not in log.made and _explained(mended) < _explained(log):
                text += ": but the drive acted on it, and it stays as logged"
                yield Finding("note", "dq", names(log, hit), text.format(some(names(log, hit))))
            else:
                text += f" by cubics over {1e3 * made.span:.3g} ms"
                yield Finding(kind, "dq", names(log, hit), text.format(some(names(log, hit))))
                yield mended
            return


def _size(x: Array) -> Array:
    """Root mean square of each column."""
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def _alike(a: Array, b: Array) -> Array:
    """Correlation of each column about 0; that of nothing is 0."""
    return np.asarray(np.mean(a * b, axis=0) / (_size(a) * _size(b) + 1e-12))


def _explained(log: Log) -> float:
    """Share of the torque that commands, angles and speeds explain; 0 without torque."""
    found = measured(log)
    return 0.0 if found is None else 1.0 - float(np.mean(found.best))


def _is_difference(log: Log) -> Bools:
    """Joints (J,) whose dq is, but for rounding, what q changed by since the row before, or until the next, over the time."""
    steps = np.diff(np.asarray(log.q, dtype=float), axis=0) / np.diff(log.t)[:, None]
    scale = np.sqrt(np.mean(steps**2, axis=0)) + 1e-12
    found = [np.mean(np.abs(dq - steps) < 1e-2 * scale, axis=0) > 0.95 for dq in (log.dq[1:], log.dq[:-1])]
    return np.asarray(found[0] | found[1])


def units(log: Log) -> Iterator[Finding]:
    """What dq is beside the slope of q: nothing, a multiple of it, its opposite, or something else."""
    row = rows_of(log)
    slope, dq = slope_of(log, log.q, row), np.asarray(log.dq[row], dtype=float)
    turning, size, alike = _size(slope), _size(dq), _alike(slope, dq)
    moving = (size > MOVING) & (np.ptp(log.q, axis=0) > REACHES)
    ratio = alike * turning / (size + 1e-12)
    off = np.abs(np.log(np.maximum(ratio, 1e-12)))
    known = np.any(
        [np.abs(np.log(np.maximum(ratio, 1e-12) / factor)) < WITHIN for factor, _ in UNITS_OF_SPEED], axis=0
    )
    clear = (alike > ALIKE) & (off > np.log(OFF))
    cases: tuple[tuple[Kind, Bools, str], ...] = (
        ("refusal", (turning > MOVING) & (size < DEAD * turning), "is 0 on {joints} although q moves; expected rad/s"),
        ("refusal", moving & (alike < -UNLIKE), "has the opposite sign of the slope of q on {joints}"),
        ("refusal", moving & (clear | known), "the slope of q is {number:.3g} times dq on {joints}: {unit}"),
        ("warning", moving & (off > np.log(2.0)), "on {joints} the slope of q is {number:.2f} times dq: a noisy speed?"),
    )  # fmt: skip
    for kind, hit, text in cases:
        if hit.any():
            number = float(np.median(ratio[hit]))
            unit = next(
                (
                    text
                    for factor, text in UNITS_OF_SPEED
                    if abs(np.log(max(number, 1e-12) / factor)) < WITHIN
                ),
                "expected q in rad, dq in rad/s, t in s",
            )
            said = text.format(joints=some(names(log, hit)), number=number, unit=unit)
            yield Finding(kind, "dq", names(log, hit), f"dq: {said}")
            return


def degrees(log: Log) -> Iterator[Finding]:
    """Angles that are too large for a joint, in q and in the commands, or in one of them."""
    row = rows_of(log)
    q = np.asarray(log.q[row], dtype=float)
    q_des = np.asarray(log.q_des[log.command_rows(log.t[row])], dtype=float)
    size, asked = (float(np.sqrt(np.mean(x**2))) for x in (q, q_des))
    for field, other, large, small in (("q_des", "q", asked, size), ("q", "q_des", size, asked)):
        share = large / small if small > 0.0 else np.inf
        if 25.0 < share < 130.0:
            text = f"{field}: about {share:.0f} times as large as {other}: degrees? expected rad in both"
            yield Finding("refusal", field, (), text)
            return
    most = np.percentile(np.abs(q), 95, axis=0)
    if (joints := names(log, most > TURNS)) and set(log.joints) <= set(JOINT_NAMES):
        text = f"q: up to {most.max():.0f} on {some(joints)}: degrees? expected rad"
        yield Finding("refusal", "q", joints, text)
    elif joints:
        text = f"q: up to {most.max():.0f} on {some(joints)}; expected rad"
        yield Finding("warning", "q", joints, text)

"""Checks of what angles, speeds and torques say of each other: wrapped angles, missing signs, units; speeds made anew.

A check that can mend what it found yields the mended log, which those that follow are given.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.robot import JOINT_NAMES

from .channels import DEGREE, MOVING, REACHES, TURN, names, rows_of, slope_of_q
from .findings import Finding, Kind, some
from .log import Array, Bools, Log
from .response import measured
from .slopes import smoothed, tick

WRAPPED = 1.0
"""rad, how far a step from row to row may be off a full turn: 50 rad/s at 50 Hz."""
BOTH_WAYS = 0.05
"""Share of the rows in which a signed quantity has the rarer of its signs, where it goes both ways."""
DOWN_TO_ZERO = 0.1
"""Of its usual largest size: what a quantity comes below in one row of twenty where it comes down to 0."""
ALIKE, OFF = 0.95, 1.4
"""Correlation of dq with the slope of q from which their ratio is a unit, and how far, as a factor, that may be off 1."""
DEAD = 2e-4
"""Of the slope of q, that a speed of 0 may be by its noise."""
TURNS = 10.0
"""rad; a joint of a leg or an arm does not reach so far."""
UNITS_OF_SPEED = (
    (1.0 / DEGREE, "q is in degrees where dq is in rad/s, or t is off by 57"),
    (DEGREE, "dq is in degrees/s where q is in rad"),
    (1e-3, "q is in units of 1000 rad, or t in milliseconds"),
    (1e3, "dq is in units of 1000 rad/s, or t in 1000 s"),
    (60.0 / TURN, "q is in rad where dq is in turns a minute, or the other way round"),
)
"""What the slope of q divided by dq may be, when it is not 1, within a factor of 1.7 or less: the mistake behind it."""


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
        yield attrs.evolve(log, q=q, q_des=np.where(hit, q_des, log.q_des))
        return


def unsigned(values: Array, twin: Array) -> Bools:
    """Joints (J,) whose `values` never change their sign although they come down to 0 and their `twin` has both signs."""
    size = np.abs(values)
    one_way = ((values >= 0.0).all(axis=0) | (values <= 0.0).all(axis=0)) & (np.ptp(values, axis=0) > 0.0)
    touches = np.percentile(size, 5, axis=0) < DOWN_TO_ZERO * np.percentile(size, 95, axis=0)
    scale = 0.1 * np.sqrt(np.mean(twin**2, axis=0))
    both = np.minimum((twin > scale).mean(axis=0), (twin < -scale).mean(axis=0)) > BOTH_WAYS
    return np.asarray(one_way & touches & both)


def sign_of_torque(log: Log) -> Iterator[Finding]:
    """Torque without its sign: never negative, although the position error has both signs."""
    if log.tau is None:
        return
    row = rows_of(log)
    error = np.asarray(log.q_des[log.command_rows(log.t[row])] - log.q[row], dtype=float)
    error -= np.median(error, axis=0) * (np.abs(np.median(error, axis=0)) > TURNS)
    hit = unsigned(np.asarray(log.tau[row], dtype=float), error)
    if hit.any():
        joints = names(log, hit)
        text = (
            f"tau: has no sign on {some(joints)}: it never changes its sign, though it comes down to 0 and the position error "
            "goes both ways; expected a torque with its sign (leave it out if only its magnitude is measured)"
        )
        yield Finding("refusal", "tau", joints, text)


def speed(log: Log) -> Iterator[Finding | Log]:
    """Speeds that are not there, have no sign, or are the difference of coarse angles: made anew from the angles."""
    row = rows_of(log)
    unsign = unsigned(np.asarray(log.dq[row], dtype=float), slope_of_q(log, row))
    coarse = tick(log.q)
    kind: Kind = "warning"
    if "dq" in log.made:
        hit, kind, why = np.ones(len(log.joints), bool), "note", "dq: not in the log; made from q"
    elif unsign.any():
        hit = unsign
        why = f"dq: has no sign on {some(names(log, unsign))}: it is never negative, though q goes both ways; made from q"
    else:
        hit = (coarse > 0.0) & _is_difference(log)
        size = some([f"{1e3 * step:.3g}" for step in dict.fromkeys(np.round(coarse[hit], 7))], 2)
        why = f"q, dq: q counts in steps of {size} mrad, and dq is its difference; both made anew"
    if not hit.any():
        return
    made = smoothed(log.t, log.q, log.tau)
    mended = attrs.evolve(
        log, q=np.where(hit & (coarse > 0.0), made.q, log.q), dq=np.where(hit, made.dq, log.dq)
    )
    if kind == "warning" and not unsign.any() and _explained(mended) < _explained(log):
        text = "q counts in steps, and dq is its difference, which the drive acted on; they stay as logged"
        yield Finding("note", "dq", names(log, hit), f"dq: {text}")
        return
    yield Finding(kind, "dq", names(log, hit), f"{why} by cubics over {1e3 * made.span:.3g} ms")
    yield mended


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
    slope, dq = slope_of_q(log, row), np.asarray(log.dq[row], dtype=float)
    turning, size = (np.sqrt(np.mean(x**2, axis=0)) for x in (slope, dq))
    moving = (size > MOVING) & (np.ptp(log.q, axis=0) > REACHES)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.mean(slope * dq, axis=0) / size**2
        alike = ratio * size / turning
        off = np.abs(np.log(np.maximum(ratio, 1e-12)))
    times = "the slope of q is {number:.3g} times dq on {joints}"
    table: list[tuple[Kind, Bools, str, Array]] = [
        (
            "refusal",
            moving & (np.abs(np.log(np.maximum(ratio, 1e-12) / factor)) < np.log(1.7)),
            f"{times}: {mistake}",
            ratio,
        )
        for factor, mistake in UNITS_OF_SPEED
    ]
    table += [
        ("refusal", (turning > MOVING) & (size < DEAD * turning), "is 0 on {joints} although q moves; expected rad/s", ratio),
        ("refusal", moving & (ratio < -0.3), "has the opposite sign of the slope of q on {joints}", ratio),
        ("refusal", moving & (alike > ALIKE) & (off > np.log(OFF)), f"{times}; expected q in rad, dq in rad/s, t in s", ratio),
        ("warning", moving & ((ratio < 0.5) | (ratio > 2.0)), "is not the slope of q on {joints}: correlation {number:.2f}", alike),
    ]  # fmt: skip
    for kind, hit, text, numbers in table:
        if hit.any():
            joints = names(log, hit)
            said = text.format(joints=some(joints), number=float(np.median(numbers[hit])))
            yield Finding(kind, "dq", joints, f"dq: {said}")
            return


def degrees(log: Log) -> Iterator[Finding]:
    """Angles that are too large for a joint, in q and in the commands, or in one of them."""
    row = rows_of(log)
    q = np.asarray(log.q[row], dtype=float)
    q_des = np.asarray(log.q_des[log.command_rows(log.t[row])], dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = float(np.sqrt(np.mean(q_des**2) / np.mean(q**2)))
        shares = (("q_des", "q", ratio), ("q", "q_des", 1.0 / ratio))
    for field, other, share in shares:
        if 25.0 < share < 130.0:
            text = f"{field}: about {share:.0f} times as large as {other}: degrees? expected rad in both"
            yield Finding("refusal", field, (), text)
            return
    large = np.percentile(np.abs(q), 95, axis=0)
    if (joints := names(log, large > TURNS)) and set(log.joints) <= set(JOINT_NAMES):
        text = f"q: up to {large.max():.0f} on {some(joints)}: degrees? expected rad"
        yield Finding("refusal", "q", joints, text)
    elif joints:
        text = f"q: up to {large.max():.0f} on {some(joints)}; expected rad"
        yield Finding("warning", "q", joints, text)

"""Do a log's columns mean what their names say: units, signs, joint names? All by what the columns imply of each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quadvel_description.robot import JOINT_NAMES, LOWER, UPPER

from .findings import Finding, some
from .log import Array, Log

ROWS = 20_000
"""So many rows tell as much as all, in bounded memory."""
DEGREE = np.pi / 180.0
HALF_WIDTH = 0.005  # s, of the slope of q
MOVING = 0.05  # rad/s
LAGS = (0.0, 0.006, 0.012)  # s, from a command to its torque
TURNS = 10.0  # rad; a joint of a leg does not reach so far
REACH = 0.4  # rad beyond the model's range
UNANSWERED = 0.1  # of the torque that the speed leaves, explained by the position error
FAR_OFF = 8.0  # times the commanded gain
ROWS_FOR_A_LAW = 50

# What the slope of q divided by dq may be, when it is not 1: the mistake behind it.
SLOPES = (
    (1.0 / DEGREE, "q is in degrees where dq is in rad/s, or t is off by 57"),
    (DEGREE, "dq is in degrees/s where q is in rad"),
    (1e-3, "t is in milliseconds, or q in units of 1000 rad"),
    (1e-6, "t is in microseconds"),
    (1e-9, "t is in nanoseconds"),
    (1e3, "dq is in units of 1000 rad/s, or t in 1000 s"),
)


def rows_of(log: Log) -> NDArray[np.intp]:
    """At most ROWS rows of the log, evenly spread."""
    return np.unique(np.linspace(0, len(log.t) - 1, min(ROWS, len(log.t))).astype(np.intp))


def units(log: Log) -> Iterator[Finding]:
    """Degrees and milliseconds: by the slope of q against dq, by q_des against q, by size."""
    reach = max(1, round(HALF_WIDTH / log.period))
    row = rows_of(log)
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, len(log.t) - 1)
    slope = (log.q[last] - log.q[first]) / (log.t[last] - log.t[first])[:, None]
    speed = log.dq[row].astype(float)
    moving = (np.sqrt(np.mean(speed**2, axis=0)) > MOVING) & (np.ptp(log.q, axis=0) > 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sum(slope * speed, axis=0) / np.sum(speed**2, axis=0)
    for factor, mistake in SLOPES:
        hit = moving & (np.abs(np.log(np.maximum(ratio, 1e-12) / factor)) < np.log(1.7))
        if hit.any():
            joints = _names(log, hit)
            number = float(np.median(ratio[hit]))
            text = (
                f"dq: the slope of q is {number:.3g} times dq on {some(joints)}: {mistake}; expected SI units"
            )
            yield Finding("refusal", "dq", joints, text)
            return
    reversed_ = _names(log, moving & (ratio < -0.3))
    if reversed_:
        yield Finding(
            "refusal", "dq", reversed_, f"dq: has the opposite sign of the slope of q on {some(reversed_)}"
        )
    odd = _names(log, moving & (ratio > -0.3) & ((ratio < 0.5) | (ratio > 2.0)))
    if odd:
        yield Finding("warning", "dq", odd, f"dq: is not the slope of q on {some(odd)}")
    yield from _degrees(log, row)


def _degrees(log: Log, row: NDArray[np.intp]) -> Iterator[Finding]:
    """Angles that are too large for a leg, in q and in the commands, or in one of them."""
    q = log.q[row].astype(float)
    q_des = log.q_des[log.command_rows(log.t[row])].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(np.mean(q_des**2) / np.mean(q**2))
    for field, other, share in (("q_des", "q", ratio), ("q", "q_des", 1.0 / ratio)):
        if 25.0 < share < 130.0:
            text = f"{field}: about {share:.0f} times as large as {other}: degrees? expected rad in both"
            yield Finding("refusal", field, (), text)
            return
    large = np.percentile(np.abs(q), 95, axis=0)
    joints = _names(log, large > TURNS)
    if not joints:
        return
    known = set(log.joints) <= set(JOINT_NAMES)
    text = f"q: up to {large.max():.0f} on {some(joints)}: degrees? expected rad"
    yield Finding("refusal" if known or _gain_in_degrees(log, row) else "warning", "q", joints, text)


def _gain_in_degrees(log: Log, row: NDArray[np.intp]) -> bool:
    if log.tau is None or log.kp is None:
        return False
    command = log.command_rows(log.t[row])
    asked = log.kp[command] * (log.q_des[command] - log.q[row])
    share = float(np.sum(asked * log.tau[row]) / max(float(np.sum(asked**2)), 1e-12))
    return 0.5 * DEGREE < share < 2.0 * DEGREE


def ranges(log: Log) -> Iterator[Finding]:
    """Names of the model on joints that move where the model's joint cannot; names that it does not have."""
    named = [name for name in log.joints if name in JOINT_NAMES]
    if named and len(named) < len(log.joints):
        strange = tuple(name for name in log.joints if name not in JOINT_NAMES)
        text = f"joint_names: {some(strange)}: not among the model's joints, though {named[0]} is"
        yield Finding("warning", "joint_names", strange, text)
    outside = {}
    for j, name in enumerate(log.joints):
        if name in JOINT_NAMES:
            low, high = np.percentile(log.q[:, j], [1, 99])
            lower, upper = LOWER[JOINT_NAMES.index(name)], UPPER[JOINT_NAMES.index(name)]
            if low < lower - REACH or high > upper + REACH:
                outside[name] = f"{name} {low:.2f} to {high:.2f} (the model's: {lower:.2f} to {upper:.2f})"
    if outside:
        text = (
            f"joint_names: q contradicts the model's range, rad: {some(list(outside.values()), 2)}: "
            "another order of names, or another robot?"
        )
        yield Finding("warning", "joint_names", tuple(outside), text)


def sign_of_torque(log: Log) -> Iterator[Finding]:
    """Torque that grows against the position error."""
    if log.tau is None:
        return
    row = rows_of(log)
    command = log.command_rows(log.t[row])
    error = log.q_des[command].astype(float) - log.q[row]
    tau = log.tau[row].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.sum(error * tau, axis=0) / np.sqrt(np.sum(error**2, axis=0) * np.sum(tau**2, axis=0))
    joints = _names(log, alike < -0.7)
    if joints:
        yield Finding(
            "refusal", "tau", joints, f"tau: has the sign against the position error on {some(joints)}"
        )


def answer_of_torque(log: Log) -> Iterator[Finding]:
    """Torque that has nothing to do with the position error, or only by a law with quite other gains than commanded."""
    if log.tau is None:
        return
    row = _some_valid(log)
    if len(row) < ROWS_FOR_A_LAW:
        return
    lags = [log.command_rows(log.t[row] - lag) for lag in LAGS]
    left, gain, answer = (np.zeros(len(log.joints)) for _ in range(3))
    for j in range(len(log.joints)):
        tau, q, dq = (x[row, j].astype(float) for x in (log.tau, log.q, log.dq))
        fits = (_law(log.q_des[at, j].astype(float) - q, dq, tau) for at in lags)
        least, gain[j] = min(fits, key=lambda one: one[0])
        left[j] = least / max(float(np.var(tau)), 1e-12)
        answer[j] = 1.0 - least / max(_law(np.zeros(len(row)), dq, tau)[0], 1e-12)
    if (answer < UNANSWERED).all():
        text = (
            f"tau: does not answer the position error on any joint (which explains {100 * answer.max():.0f} % of it at "
            "most); expected q_des, q and tau of the same joints, with the same signs"
        )
        yield Finding("refusal", "tau", log.joints, text)
    clear = left < 0.3
    if log.kp is not None and clear.any():
        asked = np.median(log.kp[lags[0]], axis=0)
        ratio = float(np.median(gain[clear] / np.maximum(asked[clear], 1e-12)))
        if ratio > FAR_OFF or ratio < 1.0 / FAR_OFF:
            text = f"tau: {ratio:.3g} times what kp asks for; expected N m, and kp in N m/rad"
            yield Finding("refusal", "tau", _names(log, clear), text)


def exchanged(log: Log) -> Iterator[Finding]:
    """Joints that answer another joint's command, or whose torque answers another joint's angle."""
    if len(log.joints) < 2:
        return
    found = _by_torque(log) if log.tau is not None else {j: ("q_des", k) for j, k in _by_motion(log).items()}
    said = {
        "q_des": "q follows another joint's command",
        "tau": "tau follows another joint's command and motion",
    }
    for field, what in said.items():
        mine = {j: k for j, (other, k) in found.items() if other == field}
        if mine:
            pairs = some([f"{log.joints[j]} follows {log.joints[k]}" for j, k in mine.items()])
            text = f"{field}: a joint's {what} ({pairs}): the columns stand in different orders"
            yield Finding("refusal", field, tuple(log.joints[j] for j in mine), text)


def _some_valid(log: Log) -> NDArray[np.intp]:
    row = rows_of(log)
    return row[log.valid[row].any(axis=1)][:: max(1, len(row) // 4000)]


def _by_torque(log: Log) -> dict[int, tuple[str, int]]:
    """Joint, and the one whose command or angle, or both, explain its torque far better than its own do.

    With the column that stands in another order than the others.
    """
    row = _some_valid(log)
    commands = [log.q_des[log.command_rows(log.t[row] - lag)].astype(float) for lag in LAGS]
    q, dq = log.q[row].astype(float), log.dq[row].astype(float)
    assert log.tau is not None
    tau = log.tau[row].astype(float)
    found = {}
    for j in range(len(log.joints)):
        total = float(np.var(tau[:, j]))
        if total < 1e-6:
            continue

        def left(k: int, m: int, j: int = j, total: float = total) -> float:
            """Share of the torque that the command of k and the motion of m leave."""
            return min(_law(c[:, k] - q[:, m], dq[:, m], tau[:, j])[0] for c in commands) / total

        own = left(j, j)
        if own < 0.3:
            continue
        others = [k for k in range(len(log.joints)) if k != j]
        tries = [
            (share, field, k)
            for k in others
            for share, field in ((left(k, j), "q_des"), (left(j, k), "q_des"), (left(k, k), "tau"))
        ]
        least, field, k = min(tries)
        if least < 0.3 * own and least < 0.3:
            found[j] = (field, k)
    return found


def _law(error: Array, speed: Array, tau: Array) -> tuple[float, float]:
    """Variance of the torque that a PD law with a positive gain leaves, and that gain."""
    regressors = np.stack([error, -speed, np.ones(len(error))], axis=1)
    solution = np.linalg.lstsq(regressors, tau, rcond=None)[0]
    if solution[0] < 0.0:
        return float(np.var(tau)), 0.0
    return float(np.var(tau - regressors @ solution)), float(solution[0])


def _by_motion(log: Log) -> dict[int, int]:
    """Joint and the one whose command its angle follows closely, while it does not follow its own."""
    row = rows_of(log)
    row = row[log.valid[row].any(axis=1)]
    q = _centred(log.q[row])
    alike = np.full((len(log.joints),) * 2, -1.0)
    for lag in np.arange(0.0, 0.1, 0.01):
        command = _centred(log.q_des[log.command_rows(log.t[row] - lag)])
        alike = np.maximum(alike, q.T @ command)
    own = alike.diagonal()
    best = alike.argmax(axis=1)
    return {
        j: int(best[j])
        for j in range(len(own))
        if alike[j, best[j]] > 0.8 and own[j] < alike[j, best[j]] - 0.3
    }


def _centred(values: Array) -> NDArray[np.float64]:
    """Columns without their means, of length 1; a column that never changes stays 0."""
    centred = values.astype(float) - values.astype(float).mean(axis=0)
    length = np.sqrt(np.sum(centred**2, axis=0))
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > 1e-6)


def _names(log: Log, hit: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple(name for name, one in zip(log.joints, hit, strict=True) if one)

"""Do a log's columns mean what their names say: units, signs, joint names? All by what the columns imply of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

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
DEAD = 2e-4  # of the slope of q, that a speed of 0 may be by its noise
OFF, ALIKE = 1.4, 0.95  # how far, as a factor, the slope of q may be off dq, where they are alike in shape
CLOCKS = np.arange(-1.0, 1.01, 0.02)  # s, from a command to its torque, looked at for clocks that differ
EARLIEST, LATEST = -0.005, 0.1  # s, between which a drive may answer
UNALIGNED = 0.2  # of the torque, left at the best lag that a drive may have: a motion that repeats fits a lag of its period, too
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
    row = rows_of(log)
    found = list(_speeds(log, row))
    yield from found
    if all(one.kind != "refusal" for one in found):
        yield from _degrees(log, row)


def _speeds(log: Log, row: NDArray[np.intp]) -> Iterator[Finding]:
    """What dq is beside the slope of q: nothing, a multiple of it, its opposite, or something else."""
    reach = max(1, round(HALF_WIDTH / log.period))
    first, last = np.maximum(row - reach, 0), np.minimum(row + reach, len(log.t) - 1)
    slope = (log.q[last] - log.q[first]) / (log.t[last] - log.t[first])[:, None]
    speed = log.dq[row].astype(float)
    turning, size = (np.sqrt(np.mean(x**2, axis=0)) for x in (slope, speed))
    moving = (size > MOVING) & (np.ptp(log.q, axis=0) > 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.mean(slope * speed, axis=0) / size**2
        alike = ratio * size / turning
        off = np.abs(np.log(np.maximum(ratio, 1e-12)))
    times = "the slope of q is {number:.3g} times dq on {joints}"
    for factor, mistake in SLOPES:
        hit = moving & (np.abs(np.log(np.maximum(ratio, 1e-12) / factor)) < np.log(1.7))
        if hit.any():
            yield _of_dq("refusal", log, hit, f"{times}: {mistake}; expected SI units", ratio)
            return
    for hit, what in (
        ((turning > MOVING) & (size < DEAD * turning), "is 0 on {joints} although q moves; expected rad/s"),
        (moving & (ratio < -0.3), "has the opposite sign of the slope of q on {joints}"),
        (moving & (alike > ALIKE) & (off > np.log(OFF)), f"{times}; expected q in rad, dq in rad/s, t in s"),
    ):
        if hit.any():
            yield _of_dq("refusal", log, hit, what, ratio)
            return
    odd = moving & ((ratio < 0.5) | (ratio > 2.0))
    if odd.any():
        what = "is not the slope of q on {joints}: correlation {number:.2f}, expected some 1"
        yield _of_dq("warning", log, odd, what, alike)


def _of_dq(
    kind: Literal["warning", "refusal"], log: Log, hit: NDArray[np.bool_], what: str, numbers: Array
) -> Finding:
    """What is wrong with dq of some joints, with their `joints` and the median of their `number`."""
    joints = _names(log, hit)
    text = what.format(joints=some(joints), number=float(np.median(numbers[hit])))
    return Finding(kind, "dq", joints, f"dq: {text}")


def _degrees(log: Log, row: NDArray[np.intp]) -> Iterator[Finding]:
    """Angles that are too large for a leg, in q and in the commands, or in one of them."""
    q = log.q[row].astype(float)
    q_des = log.q_des[log.command_rows(log.t[row])].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(np.mean(q_des**2) / np.mean(q**2))
        shares = (("q_des", "q", ratio), ("q", "q_des", 1.0 / ratio))
    for field, other, share in shares:
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


def copies(log: Log) -> Iterator[Finding]:
    """Two joints whose measurements are the same to the bit."""
    row = rows_of(log)
    for field in ("q", "tau"):
        values = getattr(log, field)
        if values is None:
            continue
        seen: dict[bytes, str] = {}
        for j, joint in enumerate(log.joints):
            column = np.ascontiguousarray(values[row, j])
            other = seen.setdefault(column.tobytes(), joint)
            if other != joint and np.ptp(column) > 0.0:
                text = f"{field}: {joint} and {other} are the same to the bit: one measured joint under two names?"
                yield Finding("warning", field, (other, joint), text)
                return


def time_bases(log: Log) -> Iterator[Finding]:
    """Torques that answer their commands before these were sent, or long after: by the lag that leaves least."""
    if log.tau is None:
        return
    answer = log.without_feed_forward()
    row = _some_valid(answer)[::2]
    row = row[(log.t[row] > log.t_cmd[0] + CLOCKS[-1]) & (log.t[row] < log.t_cmd[-1] + CLOCKS[0])]
    if len(row) < ROWS_FOR_A_LAW:
        return
    assert answer.tau is not None
    q, dq, tau = (x[row].astype(float) for x in (log.q, log.dq, answer.tau))
    moves = np.flatnonzero((np.ptp(q, axis=0) > 1e-3) & (np.var(tau, axis=0) > 1e-6))
    left = np.empty(len(CLOCKS))
    for k, lag in enumerate(CLOCKS):
        q_des = log.q_des[log.command_rows(log.t[row] - lag)]
        shares = [_law(q_des[:, j] - q[:, j], dq[:, j], tau[:, j])[0] / np.var(tau[:, j]) for j in moves]
        left[k] = np.median(shares) if shares else 1.0
    allowed = (CLOCKS >= EARLIEST) & (CLOCKS <= LATEST)
    best = float(CLOCKS[np.argmin(left)])
    aside = left[allowed].min() > UNALIGNED and left.min() < 0.3 * min(left[allowed].min(), 1.0)
    if aside and not EARLIEST <= best <= LATEST:
        way = f"{best:.2f} s after" if best > 0.0 else f"{-best:.2f} s before"
        text = (
            f"t_cmd: the torque answers commands {way} they were sent (it leaves {100 * left.min():.0f} % of the torque, at "
            f"no lag {100 * left[allowed].min():.0f} %); expected t and t_cmd on one clock"
        )
        yield Finding("refusal", "t_cmd", (), text)


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


def answer_of_torque(log: Log) -> Iterator[Finding]:
    """Torque that has nothing to do with the position error, or only by a law with quite other signs or gains."""
    if log.tau is None:
        return
    row = _some_valid(log)
    if len(row) < ROWS_FOR_A_LAW:
        return
    lags = [log.command_rows(log.t[row] - lag) for lag in LAGS]
    left, gain, answer = (np.zeros(len(log.joints)) for _ in range(3))
    wrong: dict[str, list[str]] = {}
    for j, joint in enumerate(log.joints):
        tau, q, dq = (x[row, j].astype(float) for x in (log.tau, log.q, log.dq))
        commands = [log.q_des[at, j].astype(float) for at in lags]
        least, gain[j] = min((_law(q_des - q, dq, tau) for q_des in commands), key=lambda one: one[0])
        left[j] = least / max(float(np.var(tau)), 1e-12)
        answer[j] = 1.0 - least / max(_law(np.zeros(len(row)), dq, tau)[0], 1e-12)
        if left[j] > 0.5 and (field := _reversed(commands, q, dq, tau)):
            wrong.setdefault(field, []).append(joint)
    if wrong:
        for field, names in wrong.items():
            text = f"{field}: has the wrong sign on {some(names)}: the torque answers it the other way round"
            yield Finding("refusal", field, tuple(names), text)
        return
    yield from _deaf(log, answer, np.ptp(log.q[row], axis=0) > 1e-3)
    if log.kp is not None:
        yield from _off_gain(log, gain, np.median(log.kp[lags[0]], axis=0), left < 0.3)


def _deaf(log: Log, answer: Array, moves: NDArray[np.bool_]) -> Iterator[Finding]:
    """`answer`: share of the torque of each joint that its position error explains."""
    deaf = answer < UNANSWERED
    if deaf.all():
        text = (
            f"tau: does not answer the position error on any joint (which explains {100 * answer.max():.0f} % of it at "
            "most); expected q_des, q and tau of the same joints, with the same signs"
        )
        yield Finding("refusal", "tau", log.joints, text)
    elif (deaf & moves).any():
        joints = _names(log, deaf & moves)
        text = f"tau: does not answer the position error on {some(joints)}: what is found there is not to be trusted"
        yield Finding("warning", "tau", joints, text)


def _off_gain(log: Log, gain: Array, asked: Array, clear: NDArray[np.bool_]) -> Iterator[Finding]:
    """The gain that the torque shows, N m/rad, beside the one that was asked for, of each joint."""
    ratio = np.where(asked > 0.0, gain / np.where(asked > 0.0, asked, 1.0), 1.0)
    off = clear & (np.abs(np.log(np.maximum(ratio, 1e-12))) > np.log(FAR_OFF))
    if off.any():
        joints, number = _names(log, off), float(np.median(ratio[off]))
        text = f"tau: {number:.3g} times what kp asks for on {some(joints)}; expected N m, and kp in N m/rad"
        yield Finding("refusal", "tau", joints, text)


def _reversed(commands: Sequence[Array], q: Array, dq: Array, tau: Array) -> str | None:
    """The field whose sign, turned round, lets a PD law explain most of a torque that it does not explain as it is."""
    turned = {
        "q": [(c + q, -dq, tau) for c in commands],
        "q_des": [(-c - q, dq, tau) for c in commands],
        "tau": [(c - q, dq, -tau) for c in commands],
    }
    left = {field: min(_law(*one)[0] for one in tries) for field, tries in turned.items()}
    field = min(left, key=lambda name: left[name])
    return field if left[field] < 0.2 * float(np.var(tau)) else None


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

"""When were the drives under PD control? Outside of these stretches no PD model applies, whatever its parameters.

A drive that was switched off, or put into damping, while the log goes on with the last command shows it: the torque no
longer answers the position error. Found from the data, so logged gains are not needed; where they are logged, a
kp of 0 says it too. What the drive does under PD control is for the identification, not for here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from .findings import Finding, some
from .log import Array, Bools, Log
from .response import motion

BIN = 0.02  # s
WINDOW = 5  # bins
LOST = 0.2
"""Share of the usual position gain below which the position error is no longer answered."""
SHORTEST = 0.15  # s, of a stretch out of PD control
MARGIN = 0.1  # s, on both sides of it
LEAST_VALID = 0.5  # s, of states that a model may be judged on
LAGS = np.arange(0.0, 0.021, 0.004)  # s, between the position error and its torque
ENOUGH = 40_000  # rows, of which the lag is read
FITTED, LEAST_ROWS = 4000, 200
"""Rows that a law of the joints under PD control is fitted to, at most and at least."""
AS_ELSEWHERE = 9.0
"""Times its mean squared error elsewhere, within which such a law holds in a stretch, too."""


def explainable(log: Log) -> tuple[Bools, list[Finding]]:
    """The rows that a PD model can explain, and what was left out of the others."""
    findings: list[Finding] = []
    for exclude in (_before_commands, _without_gain, _no_longer):
        out, why = exclude(log)
        log = attrs.evolve(log, valid=log.valid & ~out)
        findings += why
    seconds = float(log.valid.any(axis=1).sum()) * log.period
    if seconds < LEAST_VALID:
        text = f"valid: {seconds:.2f} s under PD control are left, expected {LEAST_VALID} s or more"
        findings.append(Finding("refusal", "valid", (), text))
    return log.valid, findings


def _before_commands(log: Log) -> tuple[Bools, list[Finding]]:
    early: Bools = (log.t < log.t_cmd[0])[:, None]
    text = f"t_cmd: no command before {log.t_cmd[0]:.3f} s; left out"
    return early, [Finding("note", "t_cmd", (), text)] if early.any() else []


def _without_gain(log: Log) -> tuple[Bools, list[Finding]]:
    off = without_position_gain(log)
    everywhere: Any = off.all(axis=1)
    findings = []
    if everywhere.any():
        text = f"kp: 0 (damping, switched off or torque control) {_spans(everywhere, log.t)}; left out"
        findings.append(Finding("warning", "kp", (), text))
    alone = tuple(log.joints[j] for j in np.flatnonzero((off & ~everywhere[:, None]).any(axis=0)))
    if alone:
        text = f"kp: 0 at times on {some(alone)} alone; left out there"
        findings.append(Finding("warning", "kp", alone, text))
    return off, findings


def _no_longer(log: Log) -> tuple[Bools, list[Finding]]:
    lost = out_of_control(log)
    field, what = (
        ("q", "the joints no longer follow") if log.tau is None else ("tau", "the torque no longer answers")
    )
    text = f"{field}: {what} the position error {_spans(lost, log.t)}: not under PD control (damping or switched off); left out"
    return lost[:, None], [Finding("warning", field, (), text)] if lost.any() else []


def masked(log: Log) -> Iterator[Finding]:
    """Rows that the log itself says are not to be explained."""
    out = ~log.valid.all(axis=1)
    if out.any():
        yield Finding("note", "valid", (), f"valid: false {_spans(out, log.t)}; left out, as the log says")


def _spans(rows: Any, t: Array) -> str:
    spans = stretches(rows, t)
    return f"{in_words(spans, t)} ({sum(last - first for first, last in spans):.2f} s)"


def without_position_gain(log: Log) -> Bools:
    """Rows and joints (N, J) whose logged kp was 0."""
    if log.kp is None:
        return np.zeros(log.q.shape, bool)
    return np.asarray(log.kp == 0.0)[log.command_rows(log.t)]


def out_of_control(log: Log) -> Bools:
    """Rows (N,) in which no drive answered the position error; none where the data cannot tell."""
    return _error_at_rest(log) if log.tau is None else _unanswered(log)


def stretches(rows: NDArray[Any], t: Array, least: float = 0.0) -> list[tuple[float, float]]:
    """First and last time (s) of each run of true rows that lasts `least` s or longer."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8)))
    pairs = [(float(t[a]), float(t[b - 1])) for a, b in edges.reshape(-1, 2)]
    return [(first, last) for first, last in pairs if last - first >= least]


def _unanswered(log: Log) -> Bools:
    """Torque against position error, in short windows over all joints: where is the gain far below its usual size?"""
    steps = np.diff(((log.t - log.t[0]) / BIN).astype(np.intp), prepend=0)
    bins = np.cumsum(np.minimum(steps, WINDOW))  # a gap is as good as one that no window bridges
    some = np.flatnonzero(bins % max(1, len(bins) // ENOUGH) == 0)
    lag = max(LAGS, key=lambda lag: _explained(_sums(log, bins, some, lag)))
    sums = _sums(log, bins, np.arange(len(bins)), lag)
    count, ee, ed, dd, et, dt, _ = (np.convolve(row, np.ones(WINDOW), "same") for row in sums)
    determinant = ee * dd - ed**2
    with np.errstate(divide="ignore", invalid="ignore"):
        alone, joint = et / ee, (et * dd - dt * ed) / determinant
        gain = np.where(determinant > 1e-3 * ee * dd, joint, alone)
        size = ee / count
    there = np.isfinite(gain) & np.isfinite(size) & (count > 0)
    if not there.any():
        return np.zeros(len(log.t), bool)
    tells = there & (size > 0.1 * np.median(size[there]))
    usual = float(np.percentile(gain[tells], 75))
    if usual <= 0.0:
        return np.zeros(len(log.t), bool)
    # A window that tells nothing, as the error is small there, is taken to be like the one before.
    last = np.maximum.accumulate(np.where(tells, np.arange(len(gain)), -1))
    lost = ((last >= 0) & (gain[last] < LOST * usual))[bins]
    left = _left_elsewhere(log, lost) if lost.any() else None
    for first, stop in stretches(lost, log.t, SHORTEST):
        there = (log.t >= first) & (log.t <= stop)
        explained = left is not None and np.mean(left[there]) < AS_ELSEWHERE
        if explained or _follows(log, there, lag) >= LOST * usual:
            lost &= ~there
    return _widened(lost, log.t)


def _follows(log: Log, rows: Bools, lag: float) -> float:
    """The gain with which the torque follows changes of the position error within `rows`, whatever its mean.

    What pushes against the drive all the while, a spring in part of the range, takes torque off without switching it off.
    """
    squares, products = np.zeros((2, 2)), np.zeros(2)
    for use, e, d, tau in _answers(log, np.flatnonzero(rows), lag):
        level = use / max(float(use.sum()), 1.0)
        x = np.stack([e, d])
        x = (x - (x @ level)[:, None]) * use
        squares += x @ x.T
        products += x @ (tau - tau @ level)
    found: Array = np.linalg.lstsq(squares, products, rcond=1e-3)[0]
    return float(found[0])


def _left_elsewhere(log: Log, lost: Bools) -> Array | None:
    """Squared error (N,) of a PD law of each joint with friction and an offset, over its mean where it was fitted: not in `lost`.

    None where that is too short. Where such a law holds within `lost` as well, the drives were under PD control there: friction, or
    a load that turns against a small position error, only looks like a gain of 0.
    """
    fitted = np.flatnonzero(~lost)
    fitted = fitted[:: max(1, len(fitted) // FITTED)]
    if len(fitted) < LEAST_ROWS:
        return None
    left = [
        min((_left_by(log, j, fitted, lag) for lag in LAGS), key=lambda x: float(x[fitted].mean()))
        for j in range(len(log.joints))
    ]
    return np.asarray(np.mean([one / (one[fitted].mean() + 1e-12) for one in left], axis=0))


def _left_by(log: Log, j: int, fitted: NDArray[np.intp], lag: float) -> NDArray[np.float64]:
    """Squared error (N,) of the law of one joint, `lag` s after its signals; 0 in rows that do not count."""
    assert log.tau is not None
    row = np.maximum(np.searchsorted(log.t, log.t - lag, side="right") - 1, 0)
    command = log.command_rows(log.t[row])
    kp, kd = (1.0 if gain is None else np.asarray(gain)[command, j] for gain in (log.kp, log.kd))
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    speed = [] if log.dq_des is None else [log.dq_des[command, j]]
    signals = (kp * (log.q_des[command, j] - q), kd * -dq, q - q.mean(), *motion(dq).T, *speed)
    law, tau = np.stack(signals, axis=1), np.asarray(log.tau[:, j], dtype=float)
    use = fitted[log.valid[fitted, j]]
    weights = np.linalg.lstsq(law[use], tau[use], rcond=1e-9)[0]
    return np.asarray(log.valid[:, j] * (tau - law @ weights) ** 2)


def _answers(log: Log, rows: NDArray[np.intp], lag: float) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Of each joint in `rows`: 1 where valid, and stiffness times error, -dq and torque there, the first two `lag` s earlier."""
    row = np.maximum(np.searchsorted(log.t, log.t[rows] - lag, side="right") - 1, 0)
    command = log.command_rows(log.t[row])
    assert log.tau is not None
    for j in range(len(log.joints)):
        use = log.valid[rows, j].astype(float)
        stiffness = 1.0 if log.kp is None else np.asarray(log.kp)[command, j]
        e = use * stiffness * (log.q_des[command, j] - log.q[row, j])
        yield use, e, -use * log.dq[row, j], use * log.tau[rows, j]


def _sums(log: Log, bins: NDArray[np.intp], rows: NDArray[np.intp], lag: float) -> NDArray[np.float64]:
    """Sums of `rows` in each bin, over the joints: 1, ee, e dq, dq dq, e tau, dq tau, tau tau; e and dq `lag` s earlier."""
    total = np.zeros((7, bins[-1] + 1))
    for use, e, d, tau in _answers(log, rows, lag):
        for k, product in enumerate((use, e * e, e * d, d * d, e * tau, d * tau, tau * tau)):
            total[k] += np.bincount(bins[rows], product, len(total[k]))
    return total


def _explained(sums: NDArray[np.float64]) -> float:
    """Share of the torque that the position error explains, where it does: the median over the bins."""
    _, ee, _, _, et, _, tt = sums
    there = (ee > 0.0) & (tt > 0.0)
    return float(np.median(et[there] ** 2 / (ee * tt)[there])) if there.any() else 0.0


def _error_at_rest(log: Log) -> Bools:
    """Without torque: stretches in which the command rests and the joints drift further off than they ever do else."""
    row = log.command_rows(log.t)
    changed = np.concatenate([[True], (np.diff(log.q_des, axis=0) != 0.0).any(axis=1)])
    changes = np.maximum.accumulate(np.where(changed, np.arange(len(changed)), 0))
    since = log.t - log.t_cmd[changes[row]]
    error = np.sqrt(np.mean((log.q_des[row] - log.q) ** 2, axis=1))
    resting = since > 0.5
    if resting.all() or not resting.any():
        return np.zeros(len(log.t), bool)
    off = resting & (error > 2.0 * np.percentile(error[~resting], 95))
    held = np.unique(changes[row][off])
    return _widened(np.isin(changes[row], held) & (since > 2.0 * MARGIN), log.t)


def _widened(rows: Bools, t: Array) -> Bools:
    """Runs of at least SHORTEST, with MARGIN on both sides."""
    wide = np.zeros(len(t), bool)
    for first, last in stretches(rows, t, SHORTEST):
        wide |= (t >= first - MARGIN) & (t <= last + MARGIN)
    return wide


def in_words(spans: list[tuple[float, float]], t: Array, most: int = 4) -> str:
    """`1.20 to 3.45 s, 9.70 s to the end`."""
    texts = [
        f"{first:.2f} s to the end" if last >= t[-1] else f"{first:.2f} to {last:.2f} s"
        for first, last in spans
    ]
    rest = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + rest

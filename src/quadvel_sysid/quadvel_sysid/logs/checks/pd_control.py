"""Find the rows in which the drives were not under PD control, which no PD model can explain.

A drive that was switched off or damped while the last command stays in the log shows it: the
torque no longer responds to the position error. The data show this without gains; if gains are
logged, kp = 0 shows it as well. `explainable_rows` returns the other rows. Shapes: N rows, J joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Bools, Floats, Indices
from quadvel_description.name_list import format_names

from ..findings import Finding
from ..log import TIME_TOLERANCE_S, Log
from .response import motion_regressors

BIN_S = 0.02
"""s; the log is divided into bins of this duration."""
WINDOW_BINS = 5
"""Bins of the sliding window over which a gain is estimated."""
LOST_GAIN_SHARE = 0.2
"""Share of the usual position gain, below which the drive does not respond to the position error."""
MIN_OUTAGE_S = 0.15
"""s; shortest stretch out of PD control."""
OUTAGE_MARGIN_S = 0.1
"""s; rows on both sides of such a stretch that are left out as well."""
MIN_VALID_S = 0.5
"""s; shortest duration of valid rows that a model can be evaluated on."""
LAGS_S = np.arange(0.0, 0.021, 0.004)
"""s; lags between the position error and its torque that are tried."""
MAX_LAG_ROWS = 40_000
"""Rows on which the lag is chosen, at most."""
MAX_FIT_ROWS, MIN_FIT_ROWS = 4000, 200
"""Rows that a PD law is fitted to: at least `MIN_FIT_ROWS`, at most `MAX_FIT_ROWS`."""
MAX_ERROR_RATIO = 9.0
"""A stretch with at most this many times the mean squared error elsewhere counts as under PD control."""

MAX_OFFSET_ERROR_RATIO = 0.5
"""A torque has a constant offset if it reduces the squared error of a PD law to at most this share."""


def explainable_rows(log: Log) -> tuple[Bools, list[Finding]]:
    """Find the rows that a PD model can explain.

    Args:
        log: The log, with the feed-forward torque subtracted.

    Returns:
        (N, J) mask, and the findings about the rows that were left out.
    """
    findings: list[Finding] = []
    for exclude in (_before_commands, _without_gain, _lost_control):
        out, why = exclude(log)
        log = attrs.evolve(log, valid=log.valid & ~out)
        findings += why
    seconds = float(log.valid.any(axis=1).sum()) * log.period
    if seconds < MIN_VALID_S:
        text = f"valid: {seconds:.2f} s under PD control are left, expected {MIN_VALID_S} s or more"
        findings.append(Finding("refusal", "valid", (), text))
    return log.valid, findings


def _before_commands(log: Log) -> tuple[Bools, list[Finding]]:
    """Rows (N, 1) before the first command."""
    early: Bools = (log.t < log.t_cmd[0])[:, None]
    text = f"t_cmd: no command before {log.t_cmd[0]:.3f} s; left out"
    return early, [Finding("note", "t_cmd", (), text)] if early.any() else []


def _without_gain(log: Log) -> tuple[Bools, list[Finding]]:
    """Rows and joints (N, J) with a commanded kp of 0."""
    off = without_position_gain(log)
    everywhere: Any = off.all(axis=1)
    findings = []
    if everywhere.any():
        text = f"kp: 0 (damping, switched off or torque control) {_span_text(everywhere, log.t)}; left out"
        findings.append(Finding("warning", "kp", (), text))
    alone = tuple(log.joints[j] for j in np.flatnonzero((off & ~everywhere[:, None]).any(axis=0)))
    if alone:
        text = f"kp: 0 at times on {format_names(alone)} alone; left out there"
        findings.append(Finding("warning", "kp", alone, text))
    return off, findings


def _lost_control(log: Log) -> tuple[Bools, list[Finding]]:
    """Rows (N, 1) in which the joints do not respond to the position error."""
    lost = out_of_control(log)
    field, what = (
        ("q", "the joints no longer follow") if log.tau is None else ("tau", "the torque no longer answers")
    )
    text = f"{field}: {what} the position error {_span_text(lost, log.t)}: not under PD control (damping or switched off); left out"
    return lost[:, None], [Finding("warning", field, (), text)] if lost.any() else []


def masked_rows(log: Log) -> Iterator[Finding]:
    """Rows that the log itself marks as invalid.

    Args:
        log: The log to check.

    Yields:
        A note.
    """
    out = ~log.valid.all(axis=1)
    if out.any():
        yield Finding("note", "valid", (), f"valid: false {_span_text(out, log.t)}; left out")


def _span_text(rows: Any, t: Floats) -> str:
    """Describe the time spans of a mask, with their total duration."""
    spans = true_runs(rows, t)
    return f"{format_spans(spans, t)} ({sum(last - first for first, last in spans):.2f} s)"


def without_position_gain(log: Log) -> Bools:
    """Find rows and joints with a logged kp of 0.

    Args:
        log: The log.

    Returns:
        (N, J) mask.
    """
    if log.kp is None:
        return np.zeros(log.q.shape, bool)
    return np.asarray(log.kp == 0.0)[log.command_rows(log.t)]


def out_of_control(log: Log) -> Bools:
    """Find rows in which no drive responds to the position error.

    Args:
        log: The log, with the feed-forward torque subtracted.

    Returns:
        (N,) mask; all false if the data cannot decide.
    """
    return _drifting_rows(log) if log.tau is None else _low_gain_rows(log)


def true_runs(rows: NDArray[Any], t: Floats, least: float = 0.0) -> list[tuple[float, float]]:
    """Find the runs of true rows.

    Args:
        rows: (N,) mask.
        t: (N,) times, s.
        least: Shortest duration of a run, s.

    Returns:
        First and last time of each run, s.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8)))
    pairs = [(float(t[a]), float(t[b - 1])) for a, b in edges.reshape(-1, 2)]
    return [(first, last) for first, last in pairs if last - first >= least]


def _low_gain_rows(log: Log) -> Bools:
    """Rows (N,) in windows whose gain from position error to torque is far below its usual value."""
    log = _without_offsets(log)
    steps = np.diff(((log.t - log.t[0]) / BIN_S).astype(np.intp), prepend=0)
    # At a gap the numbers of the bins jump by a whole window, so that no window bridges it.
    bins = np.cumsum(np.minimum(steps, WINDOW_BINS))
    some = np.flatnonzero(bins % max(1, len(bins) // MAX_LAG_ROWS) == 0)
    lag = max(LAGS_S, key=lambda lag: _explained_share(_binned_sums(log, bins, some, lag)))
    sums = _binned_sums(log, bins, np.arange(len(bins)), lag)
    # Least squares for tau = kp e + kd d in each window, d = -dq, from the normal equations
    #   [ee ed] [kp]   [et]
    #   [ed dd] [kd] = [dt];  if they are nearly singular, kp = et / ee alone.
    count, ee, ed, dd, et, dt, _ = (np.convolve(row, np.ones(WINDOW_BINS), "same") for row in sums)
    determinant = ee * dd - ed**2
    with np.errstate(divide="ignore", invalid="ignore"):
        alone, joint = et / ee, (et * dd - dt * ed) / determinant
        gain = np.where(determinant > 1e-3 * ee * dd, joint, alone)
        size = ee / count
    there = np.isfinite(gain) & np.isfinite(size) & (count > 0)
    if not there.any():
        return np.zeros(len(log.t), bool)
    informative = there & (size > 0.1 * np.median(size[there]))
    usual = float(np.percentile(gain[informative], 75))
    if usual <= 0.0:
        return np.zeros(len(log.t), bool)
    # Windows with a small error give no reliable gain; use that of the window before.
    last = np.maximum.accumulate(np.where(informative, np.arange(len(gain)), -1))
    lost = ((last >= 0) & (gain[last] < LOST_GAIN_SHARE * usual))[bins]
    left = _relative_error(log, lost) if lost.any() else None
    for first, stop in true_runs(lost, log.t, MIN_OUTAGE_S):
        there = (log.t >= first) & (log.t <= stop)
        explained = left is not None and np.mean(left[there]) < MAX_ERROR_RATIO
        if explained or _differential_gain(log, there, lag) >= LOST_GAIN_SHARE * usual:
            lost &= ~there
    return _with_margin(lost, log.t)


def _without_offsets(log: Log) -> Log:
    """The log without the constant offset of each joint's torque, which no position error explains."""
    assert log.tau is not None
    offsets, rows = np.zeros(len(log.joints)), np.arange(len(log.t))
    rows = rows[:: max(1, len(rows) // MAX_LAG_ROWS)]
    for j, (use, e, d, tau) in enumerate(_joint_signals(log, rows, 0.0)):
        # tau = kp e + kd d + c tanh(d / w) + offset, with the last regressor and without it
        law = np.column_stack([e, use[:, None] * motion_regressors(d)])
        without, found = (np.linalg.lstsq(x, tau, rcond=1e-9)[0] for x in (law[:, :-1], law))
        error, other = np.sum((tau - law @ found) ** 2), np.sum((tau - law[:, :-1] @ without) ** 2)
        if error < MAX_OFFSET_ERROR_RATIO * other:
            offsets[j] = found[-1]
    return attrs.evolve(log, tau=log.tau - offsets) if offsets.any() else log


def _differential_gain(log: Log, rows: Bools, lag: float) -> float:
    """Gain from changes of the position error to changes of the torque within `rows`.

    A constant load, such as a spring in part of the range, lowers the torque without switching
    the drive off. Differences from the mean do not see it.
    """
    # Normal equations of tau - mean = kp (e - mean) + kd (d - mean), d = -dq, summed over the joints.
    squares, products = np.zeros((2, 2)), np.zeros(2)
    for use, e, d, tau in _joint_signals(log, np.flatnonzero(rows), lag):
        level = use / max(float(use.sum()), 1.0)
        x = np.stack([e, d])
        x = (x - (x @ level)[:, None]) * use
        squares += x @ x.T
        products += x @ (tau - tau @ level)
    found: Floats = np.linalg.lstsq(squares, products, rcond=1e-3)[0]
    return float(found[0])


def _relative_error(log: Log, lost: Bools) -> Floats | None:
    """Squared error (N,) of a PD law of each joint, over its mean outside `lost`.

    None if the rows outside are too few. If the law holds within `lost` as well, the drives were
    under PD control there: friction, or a load with the sign opposite to that of a small position
    error, looks like a gain of 0.
    """
    fitted = np.flatnonzero(~lost)
    fitted = fitted[:: max(1, len(fitted) // MAX_FIT_ROWS)]
    if len(fitted) < MIN_FIT_ROWS:
        return None
    lags = [(lag, state_lag) for lag in LAGS_S for state_lag in sorted({0.0, float(lag)})]
    left = [
        min((_squared_error(log, j, fitted, *both) for both in lags), key=lambda x: float(x[fitted].mean()))
        for j in range(len(log.joints))
    ]
    return np.asarray(np.mean([one / (one[fitted].mean() + 1e-12) for one in left], axis=0))


def _squared_error(log: Log, j: int, fitted: Indices, lag: float, state_lag: float) -> Floats:
    """Squared error (N,) of one joint's PD law, commands and states delayed by s; 0 in invalid rows."""
    assert log.tau is not None
    row = np.maximum(np.searchsorted(log.t, log.t - state_lag + TIME_TOLERANCE_S, side="right") - 1, 0)
    command = log.command_rows(log.t - lag)
    kp, kd = (1.0 if gain is None else np.asarray(gain)[command, j] for gain in (log.kp, log.kd))
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    # A drive may feed the slope of q_des forward although dq_des is not logged.
    q_des = np.asarray(log.q_des[:, j], dtype=float)
    speed = np.gradient(q_des, log.t_cmd) if log.dq_des is None else log.dq_des[:, j]
    signals = (
        kp * (q_des[command] - q),
        kd * -dq,
        q - q.mean(),
        *motion_regressors(dq).T,
        speed[command],
    )
    law, tau = np.stack(signals, axis=1), np.asarray(log.tau[:, j], dtype=float)
    use = fitted[log.valid[fitted, j]]
    weights = np.linalg.lstsq(law[use], tau[use], rcond=1e-9)[0]
    return np.asarray(log.valid[:, j] * (tau - law @ weights) ** 2)


def _joint_signals(log: Log, rows: Indices, lag: float) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
    """Yield for each joint: validity, kp times error, -dq, torque; error and dq `lag` s earlier."""
    row = np.maximum(np.searchsorted(log.t, log.t[rows] - lag, side="right") - 1, 0)
    command = log.command_rows(log.t[row])
    assert log.tau is not None
    for j in range(len(log.joints)):
        use = log.valid[rows, j].astype(float)
        stiffness = 1.0 if log.kp is None else np.asarray(log.kp)[command, j]
        e = use * stiffness * (log.q_des[command, j] - log.q[row, j])
        yield use, e, -use * log.dq[row, j], use * log.tau[rows, j]


def _binned_sums(log: Log, bins: Indices, rows: Indices, lag: float) -> Floats:
    """Sums over joints and rows of each bin: 1, e^2, e d, d^2, e tau, d tau, tau^2 with d = -dq."""
    total = np.zeros((7, bins[-1] + 1))
    for use, e, d, tau in _joint_signals(log, rows, lag):
        for k, product in enumerate((use, e * e, e * d, d * d, e * tau, d * tau, tau * tau)):
            total[k] += np.bincount(bins[rows], product, len(total[k]))
    return total


def _explained_share(sums: Floats) -> float:
    """Median over the bins of the squared correlation of position error and torque."""
    _, ee, _, _, et, _, tt = sums
    there = (ee > 0.0) & (tt > 0.0)
    return float(np.median(et[there] ** 2 / (ee * tt)[there])) if there.any() else 0.0


def _drifting_rows(log: Log) -> Bools:
    """Rows (N,), for logs without torque: the command rests and the joints drift unusually far off."""
    row = log.command_rows(log.t)
    changed = np.concatenate([[True], (np.diff(log.q_des, axis=0) != 0.0).any(axis=1)])
    changes = np.maximum.accumulate(np.where(changed, np.arange(len(changed)), 0))
    since = log.t - log.t_cmd[changes[row]]
    error = np.sqrt(np.mean((log.q_des[row] - log.q) ** 2, axis=1))
    resting = since > 0.5
    if resting.all() or not resting.any():
        return np.zeros(len(log.t), bool)
    off = resting & (error > 2.0 * np.percentile(error[~resting], 95))
    drifted = np.unique(changes[row][off])
    return _with_margin(np.isin(changes[row], drifted) & (since > 2.0 * OUTAGE_MARGIN_S), log.t)


def _with_margin(rows: Bools, t: Floats) -> Bools:
    """Keep runs of at least `MIN_OUTAGE_S` and extend them by `OUTAGE_MARGIN_S` on both sides."""
    wide = np.zeros(len(t), bool)
    for first, last in true_runs(rows, t, MIN_OUTAGE_S):
        wide |= (t >= first - OUTAGE_MARGIN_S) & (t <= last + OUTAGE_MARGIN_S)
    return wide


def format_spans(spans: list[tuple[float, float]], t: Floats, most: int = 4) -> str:
    """Describe time spans in words.

    Args:
        spans: First and last times, s.
        t: (N,) times of the log, s.
        most: Number of spans that are spelled out.

    Returns:
        A text such as `1.20 to 3.45 s, 9.70 s to the end`.
    """
    texts = [
        f"{first:.2f} s to the end" if last >= t[-1] else f"{first:.2f} to {last:.2f} s"
        for first, last in spans
    ]
    return format_names(texts, most)

"""Checks of the measured torque alone with its command: single rows far off all others, and torque without its sign."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from numpy.typing import NDArray

from .channels import TURN, names, rows_of
from .findings import Finding, some
from .log import Array, Bools, Log
from .response import CLEAR, ROUNDING, motion

Numbers = NDArray[np.float64]

LAGS = (0.0, 0.005, 0.01, 0.02, 0.04)
"""s between a command and its torque that are tried."""
BULK = 0.8
"""Share of the rows whose largest deviation gives its scale: up to a tenth of the rows may be spikes, as many at rest."""
FAR = 8.0
"""Standard deviations: normal noise exceeds them in none of 10^14 rows."""
LARGE = 2.0
"""Standard deviations of the torque itself that a spike has at least: what friction and a coarse speed do in one row is less."""
FEWEST = 3
"""Rows of a joint: one or two that stand far off may be a foot that strikes between two samples of a slow log."""
FITTED = 4000
"""Rows that a law is fitted to."""
ROUNDS = 4
"""Of fits without the rows that the one before left far off."""
BOTH_WAYS = 0.05
"""Share of the rows in which a signed quantity has the rarer of its signs, where it goes both ways."""
DOWN_TO_ZERO = 0.1
"""Of its usual largest size: what a quantity comes below in one row of twenty where it comes down to 0."""
CLEARLY = 0.9
"""Of the squared error with which a sum of signals explains a quantity: what the size of such a sum has to leave at most."""


def spikes(log: Log) -> Iterator[Finding | Log]:
    """Single rows of the torque that stand far off the rows around and off what command and motion explain."""
    if log.tau is None:
        return
    tau = np.asarray(log.tau, dtype=float)
    level, hit = tau.copy(), np.zeros(tau.shape, bool)
    for j in range(len(log.joints)):
        level[:, j], hit[:, j] = _without_spikes(log, j)
    if hit.any():
        joints, size = names(log, np.asarray(hit.any(axis=0))), float(np.abs(tau - level).max())
        text = (
            f"tau: spikes in up to {100 * hit.mean(axis=0).max():.2g} % of the rows of {some(joints)}: single rows up to "
            f"{size:.3g} N m off the rows around and off what command and motion explain; left out"
        )
        yield Finding("warning", "tau", joints, text)
        yield attrs.evolve(log, tau=level, valid=log.valid & ~hit)


def _without_spikes(log: Log, j: int) -> tuple[Numbers, Bools]:
    """The torque of a joint with its spikes replaced by the rows around (N,), and which rows these are."""
    assert log.tau is not None
    tau = np.asarray(log.tau[:, j], dtype=float)
    level, hit = tau.copy(), np.zeros(len(tau), bool)
    sides = np.sign(np.pad(log.dq[:, j], 1, mode="edge"))
    turns = sides[:-2] != sides[2:]  # friction turns its sign there, which may stand in one row alone
    for _ in range(ROUNDS):
        around, alone = _around(level)
        alone = np.where(turns, 0.0, alone)
        found = np.abs(alone) > FAR * _scale(level - around)
        if found.any():
            found &= np.abs(alone) > LARGE * _scale(tau - np.median(tau))
        if found.any():
            laws = [_asked(log, np.arange(len(tau)), j, lag) for lag in LAGS]
            left = min((level - _explained(law, level, ~found) for law in laws), key=_scale)
            found &= np.abs(left) > FAR * _scale(left)
        if not found.any():
            break
        level, hit = np.where(found, around, level), hit | found
    return (level, hit) if hit.sum() >= FEWEST else (tau, np.zeros(len(tau), bool))


def _asked(log: Log, row: NDArray[np.intp], j: int, lag: float) -> Numbers:
    """What a PD law makes torque of, (R, 5 or more): error, angle, speed, direction, 1; speed and torque fed forward."""
    sent = log.command_rows(log.t[row] - lag + ROUNDING)
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    fed = [x[sent, j] for x in (log.dq_des, log.tau_ff) if x is not None]
    return np.stack([log.q_des[sent, j] - q, q - q.mean(), *motion(dq).T, *fed], axis=1).astype(float)


def _around(x: Numbers) -> tuple[Numbers, Numbers]:
    """The median of the two rows before and the two after, and how far a row is beyond all of these but one, (N,).

    0 where that is less than half of what these four differ by: the peak of a fast motion is no spike.
    """
    padded = np.pad(x, 2, mode="edge")
    sides = np.sort([padded[k : k + len(x)] for k in (0, 1, 3, 4)], axis=0)
    alone = np.maximum(x - sides[2], 0.0) - np.maximum(sides[1] - x, 0.0)
    alone[np.abs(alone) < 0.5 * (sides[3] - sides[0])] = 0.0
    alone[[0, 1, -2, -1]] = 0.0
    return np.asarray(np.median(sides, axis=0)), alone


def _scale(deviation: Numbers) -> float:
    """The standard deviation of the normal distribution that has the bulk of the deviations."""
    return float(np.quantile(np.abs(deviation), BULK)) / 1.28 + 1e-9


def _explained(law: Numbers, tau: Numbers, use: Bools) -> Numbers:
    """The torque (N,) that `law` gives, fitted to rows in `use`, in the end without those that it leaves furthest off."""
    rows = np.flatnonzero(use)
    rows = rows[:: max(1, len(rows) // FITTED)]
    x, y = law[rows], tau[rows]
    keep = np.ones(len(rows), bool)
    for _ in range(ROUNDS):
        weights = np.linalg.lstsq(x[keep], y[keep], rcond=1e-9)[0]
        left = np.abs(y - x @ weights)
        keep = left <= FAR * _scale(left)
    return np.asarray(law @ weights)


def sign(log: Log) -> Iterator[Finding]:
    """Torque without its sign: never negative, and the size of what a PD law asks for, not that itself with an offset."""
    if log.tau is None:
        return
    row = rows_of(log)
    row = row[:: max(1, len(row) // FITTED)]
    tau = np.asarray(log.tau[row], dtype=float)
    error = np.stack([_asked(log, row, j, 0.0)[:, 0] for j in range(len(log.joints))], axis=1)
    error -= np.median(error, axis=0) * (np.abs(np.median(error, axis=0)) > TURN)
    hit = unsigned(tau, error)
    for j in np.flatnonzero(hit):
        hit[j] = any(is_size(tau[:, j], _asked(log, row, int(j), lag)) for lag in LAGS)
    if hit.any():
        joints = names(log, hit)
        text = (
            f"tau: has no sign on {some(joints)}: it never changes its sign, and the size of what a PD law asks for "
            "explains it better than that with an offset; expected a torque with its sign (leave it out if only its magnitude is "
            "measured)"
        )
        yield Finding("refusal", "tau", joints, text)


def unsigned(values: Array, twin: Array) -> Bools:
    """Joints (J,) whose `values` never change their sign although they come down to 0 and their `twin` has both signs."""
    size = np.abs(values)
    one_way = ((values >= 0.0).all(axis=0) | (values <= 0.0).all(axis=0)) & (np.ptp(values, axis=0) > 0.0)
    touches = np.percentile(size, 5, axis=0) < DOWN_TO_ZERO * np.percentile(size, 95, axis=0)
    scale = 0.1 * np.sqrt(np.mean(twin**2, axis=0))
    both = np.minimum((twin > scale).mean(axis=0), (twin < -scale).mean(axis=0)) > BOTH_WAYS
    return np.asarray(one_way & touches & both)


def is_size(values: Numbers, signals: Numbers) -> bool:
    """Are `values` (N,) the size of a sum of `signals` (N, K), rather than such a sum that happens to have one sign?

    The square of that size is linear in the products of the signals; the first eigenvector of their weights gives the signs.
    """
    signed = _left(signals, values)
    if signed < CLEAR * len(values) * np.var(values):
        return False
    signals = signals / (np.sqrt(np.mean(signals**2, axis=0)) + 1e-12)
    a, b = np.triu_indices(signals.shape[1])
    weights = np.zeros((signals.shape[1],) * 2)
    weights[a, b] = np.linalg.lstsq(signals[:, a] * signals[:, b], values**2, rcond=1e-6)[0]
    sizes, vectors = np.linalg.eigh(weights + weights.T)
    total, least = signals @ vectors[:, np.argmax(sizes)], np.inf
    for _ in range(ROUNDS):
        signs = np.where(total < 0.0, -1.0, 1.0)
        total = signals @ np.linalg.lstsq(signals, signs * np.abs(values), rcond=1e-9)[0]
        least = min(least, float(np.sum((np.abs(values) - np.abs(total)) ** 2)))
    return least < CLEARLY * signed


def _left(signals: Numbers, values: Numbers) -> float:
    """Squared error of the best sum of `signals`."""
    return float(np.sum((values - signals @ np.linalg.lstsq(signals, values, rcond=1e-9)[0]) ** 2))

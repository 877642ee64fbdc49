"""Checks of the measured torque against its command: isolated spikes, and torque without a sign."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.arrays import Bools, Floats, Indices

from ..findings import Finding, format_names
from ..log import Log
from .channels import TURN_RAD, sample_rows
from .response import EXPLAINED_ERROR_SHARE, TIME_ROUNDING_S, least_squares_residual, motion_regressors

LAGS_S = (0.0, 0.005, 0.01, 0.02, 0.04)
"""s; lags from a command to its torque that are tried."""
BULK_QUANTILE = 0.8
"""Quantile of the deviations that gives their scale: a tenth of the rows may be spikes, another
tenth at rest.
"""
SPIKE_SIGMAS = 8.0
"""Standard deviations from which a row is a spike: normal noise exceeds them once in 10^14 rows."""
MIN_SPIKE_SIGMAS = 2.0
"""Standard deviations of the torque itself that a spike reaches at least; friction and a coarse
speed change less in one row.
"""
MIN_SPIKES = 3
"""Fewest spikes of a joint; one or two may be a foot that strikes between two samples of a slow log."""
MAX_FIT_ROWS = 4000
"""Rows that a PD law is fitted to, at most."""
FIT_ROUNDS = 4
"""Rounds of fits; each one leaves out the outliers of the round before."""
MIN_SIGN_SHARE = 0.05
"""Share of the rows with the rarer sign, from which a quantity takes both signs."""
NEAR_ZERO_SHARE = 0.1
"""A quantity reaches 0 if its 5th percentile is below this share of its 95th percentile."""
MAGNITUDE_ERROR_RATIO = 0.9
"""The magnitude of a sum must leave less than this share of the squared error that the sum itself
leaves.
"""


def spikes(log: Log) -> Iterator[Finding | Log]:
    """Single rows of the torque far off the rows around and off what command and motion explain.

    Args:
        log: The log to check.

    Yields:
        A warning, and the log with the spikes replaced and left out of `valid`.
    """
    if log.tau is None:
        return
    tau = np.asarray(log.tau, dtype=float)
    level, hit = tau.copy(), np.zeros(tau.shape, bool)
    for j in range(len(log.joints)):
        level[:, j], hit[:, j] = _without_spikes(log, j)
    if hit.any():
        joints, size = log.joints_where(np.asarray(hit.any(axis=0))), float(np.abs(tau - level).max())
        text = (
            f"tau: spikes in up to {100 * hit.mean(axis=0).max():.2g} % of the rows of {format_names(joints)}: single rows up to "
            f"{size:.3g} N m off the rows around and off what command and motion explain; left out"
        )
        yield Finding("warning", "tau", joints, text)
        yield attrs.evolve(log, tau=level, valid=log.valid & ~hit)


def _without_spikes(log: Log, j: int) -> tuple[Floats, Bools]:
    """Replace the spikes of a joint by the median around them; return torque and mask, (N,)."""
    assert log.tau is not None
    tau = np.asarray(log.tau[:, j], dtype=float)
    level, hit = tau.copy(), np.zeros(len(tau), bool)
    sides = np.sign(np.pad(log.dq[:, j], 1, mode="edge"))
    turns = sides[:-2] != sides[2:]  # friction changes its sign there, perhaps in a single row
    for _ in range(FIT_ROUNDS):
        around, alone = _local_median(level)
        alone = np.where(turns, 0.0, alone)
        found = np.abs(alone) > SPIKE_SIGMAS * _robust_std(level - around)
        if found.any():
            found &= np.abs(alone) > MIN_SPIKE_SIGMAS * _robust_std(tau - np.median(tau))
        if found.any():
            laws = [_pd_regressors(log, np.arange(len(tau)), j, lag) for lag in LAGS_S]
            left = min((level - _fitted_torque(law, level, ~found) for law in laws), key=_robust_std)
            found &= np.abs(left) > SPIKE_SIGMAS * _robust_std(left)
        if not found.any():
            break
        level, hit = np.where(found, around, level), hit | found
    return (level, hit) if hit.sum() >= MIN_SPIKES else (tau, np.zeros(len(tau), bool))


def _pd_regressors(log: Log, row: Indices, j: int, lag: float) -> Floats:
    """Regressors of a PD law, (R, 5 or more): error, angle, speed, friction, 1, feed-forward terms."""
    sent = log.command_rows(log.t[row] - lag + TIME_ROUNDING_S)
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    fed = [x[sent, j] for x in (log.dq_des, log.tau_ff) if x is not None]
    return np.stack([log.q_des[sent, j] - q, q - q.mean(), *motion_regressors(dq).T, *fed], axis=1).astype(
        float
    )


def _local_median(x: Floats) -> tuple[Floats, Floats]:
    """Median (N,) of the four rows around each row, and how far the row exceeds all but one.

    The excess is 0 if it is less than half the range of these four: the peak of a fast motion is
    no spike.
    """
    padded = np.pad(x, 2, mode="edge")
    sides = np.sort([padded[k : k + len(x)] for k in (0, 1, 3, 4)], axis=0)
    alone = np.maximum(x - sides[2], 0.0) - np.maximum(sides[1] - x, 0.0)
    alone[np.abs(alone) < 0.5 * (sides[3] - sides[0])] = 0.0
    alone[[0, 1, -2, -1]] = 0.0
    return np.asarray(np.median(sides, axis=0)), alone


def _robust_std(deviation: Floats) -> float:
    """Standard deviation of the normal distribution that has the bulk of the deviations."""
    return float(np.quantile(np.abs(deviation), BULK_QUANTILE)) / 1.28 + 1e-9


def _fitted_torque(law: Floats, tau: Floats, use: Bools) -> Floats:
    """Torque (N,) of the law fitted to the rows in `use`, with outliers removed round by round."""
    rows = np.flatnonzero(use)
    rows = rows[:: max(1, len(rows) // MAX_FIT_ROWS)]
    x, y = law[rows], tau[rows]
    keep = np.ones(len(rows), bool)
    for _ in range(FIT_ROUNDS):
        weights = np.linalg.lstsq(x[keep], y[keep], rcond=1e-9)[0]
        left = np.abs(y - x @ weights)
        keep = left <= SPIKE_SIGMAS * _robust_std(left)
    return np.asarray(law @ weights)


def unsigned_torque(log: Log) -> Iterator[Finding]:
    """Torque without its sign: never negative, and explained by the magnitude of a PD law.

    Args:
        log: The log to check.

    Yields:
        A refusal.
    """
    if log.tau is None:
        return
    row = sample_rows(log)
    row = row[:: max(1, len(row) // MAX_FIT_ROWS)]
    tau = np.asarray(log.tau[row], dtype=float)
    error = np.stack([_pd_regressors(log, row, j, 0.0)[:, 0] for j in range(len(log.joints))], axis=1)
    error -= np.median(error, axis=0) * (np.abs(np.median(error, axis=0)) > TURN_RAD)
    hit = lacks_sign(tau, error)
    for j in np.flatnonzero(hit):
        hit[j] = any(is_magnitude(tau[:, j], _pd_regressors(log, row, int(j), lag)) for lag in LAGS_S)
    if hit.any():
        joints = log.joints_where(hit)
        text = (
            f"tau: has no sign on {format_names(joints)}: it never changes its sign, and the size of what a PD law asks for "
            "explains it better than that with an offset; expected a torque with its sign (leave it out if only its magnitude is "
            "measured)"
        )
        yield Finding("refusal", "tau", joints, text)


def lacks_sign(values: Floats, twin: Floats) -> Bools:
    """Find joints whose values keep one sign although a related signal changes its sign.

    Args:
        values: (N, J) values under test.
        twin: (N, J) signal that should share their sign.

    Returns:
        (J,) mask.
    """
    size = np.abs(values)
    one_way = ((values >= 0.0).all(axis=0) | (values <= 0.0).all(axis=0)) & (np.ptp(values, axis=0) > 0.0)
    touches = np.percentile(size, 5, axis=0) < NEAR_ZERO_SHARE * np.percentile(size, 95, axis=0)
    scale = 0.1 * np.sqrt(np.mean(twin**2, axis=0))
    both = np.minimum((twin > scale).mean(axis=0), (twin < -scale).mean(axis=0)) > MIN_SIGN_SHARE
    return np.asarray(one_way & touches & both)


def is_magnitude(values: Floats, signals: Floats) -> bool:
    """Decide whether values are the magnitude of a linear combination of signals.

    If y = |x w|, then y^2 = sum_ab W_ab x_a x_b with W = w w^T. A linear fit gives W; the signs
    of its first eigenvector's combination start an alternation between signs and weights.

    Args:
        values: (N,) values y.
        signals: (N, K) regressors x.

    Returns:
        True if the magnitude fits clearly better.
    """
    signed = float(np.sum(least_squares_residual(signals, values) ** 2))
    if signed < EXPLAINED_ERROR_SHARE * len(values) * np.var(values):
        return False
    signals = signals / (np.sqrt(np.mean(signals**2, axis=0)) + 1e-12)
    a, b = np.triu_indices(signals.shape[1])
    # y^2 = sum_{a <= b} W_ab x_a x_b; the first eigenvector of W + W^T gives the combination.
    weights = np.zeros((signals.shape[1],) * 2)
    weights[a, b] = np.linalg.lstsq(signals[:, a] * signals[:, b], values**2, rcond=1e-6)[0]
    sizes, vectors = np.linalg.eigh(weights + weights.T)
    total, least = signals @ vectors[:, np.argmax(sizes)], np.inf
    for _ in range(FIT_ROUNDS):
        signs = np.where(total < 0.0, -1.0, 1.0)
        total = signals @ np.linalg.lstsq(signals, signs * np.abs(values), rcond=1e-9)[0]
        least = min(least, float(np.sum((np.abs(values) - np.abs(total)) ** 2)))
    return least < MAGNITUDE_ERROR_RATIO * signed

"""Checks of the measured torque against its command: isolated spikes, and torque without a sign.

`table` runs all checks in order. `response` finds which command a torque follows, and its unit.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_description.arrays import Bools, Floats, Indices
from quadvel_description.name_list import format_names

from ..findings import Finding
from ..log import Log
from .channels import TURN_RAD, sample_rows
from .response import EXPLAINED_ERROR_SHARE, TIME_ROUNDING_S, least_squares_residual, motion_regressors

LAGS_S = (0.0, 0.005, 0.01, 0.02, 0.04)
"""s; lags from a command to its torque that are tried."""
BULK_QUANTILE = 0.8
"""Quantile of the deviations that gives their scale: a tenth of spikes, or of rows at rest, changes it
little.
"""
BULK_SIGMAS = 1.28
"""The same quantile of the magnitude of a standard normal variable."""
SPIKE_SIGMAS = 8.0
"""Standard deviations from which a row is a spike: normal noise exceeds them once in 10^14 rows."""
MIN_SPIKE_SIGMAS = 2.0
"""Standard deviations of the torque itself that a spike reaches at least: friction, or a coarsely
measured speed, can change the torque by less than this in one row.
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
"""A torque has no sign if the magnitude of a PD law fits it with less than this share of the squared
error of the PD law itself.
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
    cleaned, is_spike = tau.copy(), np.zeros(tau.shape, bool)
    for j in range(len(log.joints)):
        cleaned[:, j], is_spike[:, j] = _without_spikes(log, j)
    if is_spike.any():
        joints, size = log.joints_where(np.asarray(is_spike.any(axis=0))), float(np.abs(tau - cleaned).max())
        text = (
            f"tau: spikes in up to {100 * is_spike.mean(axis=0).max():.2g} % of the rows of "
            f"{format_names(joints)}: single rows up to {size:.3g} N m off the rows around and off what "
            "command and motion explain; left out"
        )
        yield Finding("warning", "tau", joints, text)
        yield attrs.evolve(log, tau=cleaned, valid=log.valid & ~is_spike)


def _without_spikes(log: Log, j: int) -> tuple[Floats, Bools]:
    """Replace the spikes of a joint by the median around them; return torque and mask, (N,)."""
    assert log.tau is not None
    tau = np.asarray(log.tau[:, j], dtype=float)
    cleaned, is_spike = tau.copy(), np.zeros(len(tau), bool)
    direction = np.sign(np.pad(log.dq[:, j], 1, mode="edge"))
    reverses = direction[:-2] != direction[2:]  # friction changes its sign there, perhaps in a single row
    for _ in range(FIT_ROUNDS):
        around, excess = _local_median(cleaned)
        excess = np.where(reverses, 0.0, excess)
        found = np.abs(excess) > SPIKE_SIGMAS * _robust_std(cleaned - around)
        if found.any():
            found &= np.abs(excess) > MIN_SPIKE_SIGMAS * _robust_std(tau - np.median(tau))
        if found.any():
            regressors = [_pd_regressors(log, np.arange(len(tau)), j, lag) for lag in LAGS_S]
            residual = min(
                (cleaned - _fitted_torque(x, cleaned, ~found) for x in regressors), key=_robust_std
            )
            found &= np.abs(residual) > SPIKE_SIGMAS * _robust_std(residual)
        if not found.any():
            break
        cleaned, is_spike = np.where(found, around, cleaned), is_spike | found
    return (cleaned, is_spike) if is_spike.sum() >= MIN_SPIKES else (tau, np.zeros(len(tau), bool))


def _pd_regressors(log: Log, row: Indices, j: int, lag: float) -> Floats:
    """Regressors of a PD law, (R, 5 or more): error, angle, speed, friction, 1, feed-forward terms."""
    # Commands have rows and a clock of their own: (M, J) at `t_cmd`.
    command = log.command_rows(log.t[row] - lag + TIME_ROUNDING_S)
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    feed_forward = [x[command, j] for x in (log.dq_des, log.tau_ff) if x is not None]
    return np.stack(
        [log.q_des[command, j] - q, q - q.mean(), *motion_regressors(dq).T, *feed_forward], axis=1
    ).astype(float)


def _local_median(x: Floats) -> tuple[Floats, Floats]:
    """Median (N,) of the four rows around each row, and the excess of the row over these.

    The excess is how far the row lies above the second largest of the four, or below (negative) the
    second smallest. It is 0 if that is less than half the range of the four, as at the peak of a fast
    motion.
    """
    padded = np.pad(x, 2, mode="edge")
    neighbours = np.sort([padded[k : k + len(x)] for k in (0, 1, 3, 4)], axis=0)
    excess = np.maximum(x - neighbours[2], 0.0) - np.maximum(neighbours[1] - x, 0.0)
    excess[np.abs(excess) < 0.5 * (neighbours[3] - neighbours[0])] = 0.0
    excess[[0, 1, -2, -1]] = 0.0
    return np.asarray(np.median(neighbours, axis=0)), excess


def _robust_std(deviation: Floats) -> float:
    """Standard deviation of the normal distribution with the same `BULK_QUANTILE`; never 0."""
    return float(np.quantile(np.abs(deviation), BULK_QUANTILE)) / BULK_SIGMAS + 1e-9


def _fitted_torque(regressors: Floats, tau: Floats, use: Bools) -> Floats:
    """Torque (N,) of a PD law fitted to the rows in `use`, with outliers removed round by round."""
    rows = np.flatnonzero(use)
    rows = rows[:: max(1, len(rows) // MAX_FIT_ROWS)]
    x, y = regressors[rows], tau[rows]
    keep = np.ones(len(rows), bool)
    for _ in range(FIT_ROUNDS):
        weights = np.linalg.lstsq(x[keep], y[keep], rcond=1e-9)[0]
        residual = np.abs(y - x @ weights)
        keep = residual <= SPIKE_SIGMAS * _robust_std(residual)
    return np.asarray(regressors @ weights)


def unsigned_torque(log: Log) -> Iterator[Finding]:
    """Torque without its sign: of one sign only, and explained by the magnitude of a PD law.

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
    # An offset of more than one turn comes from a counter of turns, and is removed.
    error -= np.median(error, axis=0) * (np.abs(np.median(error, axis=0)) > TURN_RAD)
    hit = lacks_sign(tau, error)
    for j in np.flatnonzero(hit):
        hit[j] = any(is_magnitude(tau[:, j], _pd_regressors(log, row, int(j), lag)) for lag in LAGS_S)
    if hit.any():
        joints = log.joints_where(hit)
        text = (
            f"tau: has no sign on {format_names(joints)}: it never changes its sign, and the absolute value of a PD law "
            "fits it better than a PD law with an offset; expected a torque with its sign (leave it out if only its magnitude is "
            "measured)"
        )
        yield Finding("refusal", "tau", joints, text)


def lacks_sign(values: Floats, related: Floats) -> Bools:
    """Find joints whose values keep one sign although a related signal changes its sign.

    Args:
        values: (N, J) values under test.
        related: (N, J) signal that should share their sign.

    Returns:
        (J,) mask.
    """
    size = np.abs(values)
    one_way = ((values >= 0.0).all(axis=0) | (values <= 0.0).all(axis=0)) & (np.ptp(values, axis=0) > 0.0)
    touches = np.percentile(size, 5, axis=0) < NEAR_ZERO_SHARE * np.percentile(size, 95, axis=0)
    scale = 0.1 * np.sqrt(np.mean(related**2, axis=0))
    both = np.minimum((related > scale).mean(axis=0), (related < -scale).mean(axis=0)) > MIN_SIGN_SHARE
    return np.asarray(one_way & touches & both)


def is_magnitude(values: Floats, signals: Floats) -> bool:
    """Decide whether values are the magnitude of a linear combination of signals.

    If y = |x w|, then y^2 = sum_ab W_ab x_a x_b with W = w w^T. A linear fit gives W, and its
    first eigenvector the first signs; then weights and signs are fitted in turn.

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

"""Baselines without an actuator model, which a named model has to beat.

They are a PD law of each joint and a linear filter of its signals. Both are fitted to the rows
that a model is fitted to, and evaluated on the same held-out rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from quadvel_description.arrays import Array, Bools

from ..data.signals import Samples
from ..logs.log import Log

FILTER_SPAN_S = 0.016
"""s of the past that the filter uses."""
LAG_STEP_S = 0.001
"""s between the filter's taps, at least one row of the log, and between the delays of the PD law."""
MAX_DELAY_S = 0.02
"""s; longest delay of the PD law."""
RIDGE_PENALTY = 1e-4
"""Ridge penalty on the weights of signals of unit variance, times the number of rows."""


def baseline_errors(samples: Samples, fitted: Bools, heldout: Bools) -> dict[str, dict[str, float | None]]:
    """Compute the held-out errors of the baselines.

    Args:
        samples: Rows of all logs.
        fitted: (N, J) rows that are fitted.
        heldout: (N, J) rows that are held out.

    Returns:
        For `joint_pd` and `ridge`: `heldout_mse` (N^2 m^2), and `heldout_explained`, the share of
        the torque's variance.
    """
    torque, count = _torque(samples), max(int(heldout.sum()), 1)
    variance = torque_variance(samples.tau, heldout)
    found: dict[str, dict[str, float | None]] = {}
    for name, predicted in baseline_predictions(samples, fitted).items():
        mse = float(np.sum((torque - predicted) ** 2, where=heldout)) / count
        found[name] = {"heldout_mse": mse, "heldout_explained": explained_share(mse, variance)}
    return found


def baseline_predictions(samples: Samples, fitted: Bools) -> dict[str, Array]:
    """Predict the torque of all rows with the baselines.

    Args:
        samples: Rows of all logs.
        fitted: (N, J) rows that are fitted.

    Returns:
        For `joint_pd` and `ridge`: torque without the feed-forward torque, (N, J), N m.
    """
    torque = _torque(samples)
    found = {"joint_pd": np.empty_like(torque), "ridge": np.empty_like(torque)}
    step = max(LAG_STEP_S, float(np.median([log.period for log in samples.logs])))
    past = tuple(step * np.arange(max(1, round(FILTER_SPAN_S / step)) + 1))
    for j in range(fitted.shape[1]):
        tau, fit = torque[:, j], fitted[:, j]
        laws = [
            _regressors(samples, j, (delay,), (0.0,))
            for delay in np.arange(0.0, MAX_DELAY_S + LAG_STEP_S / 2, LAG_STEP_S)
        ]
        residuals = (_residual(law, tau, fit, 0.0) for law in laws)
        best = min(residuals, key=lambda one: float(np.mean(one[fit] ** 2)))
        found["joint_pd"][:, j] = tau - best
        found["ridge"][:, j] = tau - _residual(_regressors(samples, j, past, past), tau, fit, RIDGE_PENALTY)
    return found


def _torque(samples: Samples) -> Array:
    """Measured torque without the feed-forward torque, (N, J), N m."""
    return np.concatenate([np.asarray(log.without_feed_forward().tau, dtype=float) for log in samples.logs])


def torque_variance(torque: Array, rows: Bools) -> float:
    """Compute the variance of the torque about each joint's mean.

    Args:
        torque: (N, J) torque, N m.
        rows: (N, J) rows that count.

    Returns:
        The variance over all joints, N^2 m^2.
    """
    count = np.maximum(rows.sum(axis=0), 1)
    centred = torque - np.sum(torque, axis=0, where=rows) / count
    return float(np.sum(centred**2, where=rows) / count.sum())


def explained_share(mse: float, variance: float) -> float | None:
    """Compute the share of the torque's variance that a model explains.

    Args:
        mse: Mean squared error of the model, N^2 m^2.
        variance: Variance of the torque, N^2 m^2.

    Returns:
        1 - mse / variance, negative if the error is larger; None for a constant torque.
    """
    return 1.0 - mse / variance if variance > 0.0 else None


def _regressors(samples: Samples, j: int, commands: Sequence[float], states: Sequence[float]) -> Array:
    """Regressors (N, K) of joint `j`: commands, angles and speeds at the given delays (s), and 1."""
    return np.concatenate(
        [np.stack([*_log_regressors(log, j, commands, states)], axis=1) for log in samples.logs]
    )


def _log_regressors(log: Log, j: int, commands: Sequence[float], states: Sequence[float]) -> Iterator[Array]:
    """Yield the regressors of one log."""
    for late in commands:
        yield np.asarray(log.q_des[log.command_rows(log.t - late), j], dtype=float)
    for values in (log.q, log.dq):
        for late in states:
            yield np.interp(log.t - late, log.t, values[:, j])
    yield np.ones(len(log.t))


def _residual(signals: Array, tau: Array, rows: Bools, penalty: float) -> Array:
    """Residual (N,) of a ridge regression fitted to `rows`; the offset has no penalty."""
    # Ridge regression on standardised signals: (X^T X + penalty N I) w = X^T (tau - mean).
    x = signals[rows, :-1]
    centre, size = x.mean(axis=0), x.std(axis=0) + 1e-12
    x = (x - centre) / size
    level = tau[rows].mean()
    gram = x.T @ x + (penalty + 1e-12) * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ (tau[rows] - level))
    left: Array = tau - level - (signals[:, :-1] - centre) / size @ weights
    return left

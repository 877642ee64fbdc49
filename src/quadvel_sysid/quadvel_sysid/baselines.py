"""What needs no actuator model: a PD law of each joint, and a linear filter of its signals. A named model has to beat both.

Both are fitted to the rows that a model is fitted to, and judged on the rows that it is judged on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .logs.log import Array, Bools, Log

FILTER_SPAN_S = 0.016
"""s of the past that the filter sees"""
LAG_STEP_S = 0.001
"""s between the instants that it sees, a row of the log at least; and between the delays of the PD law"""
MAX_DELAY_S = 0.02
"""s, delay of the PD law"""
RIDGE_PENALTY = 1e-4
"""Penalty on the weights of signals of unit variance, in times the number of rows"""


def baseline_errors(logs: Sequence[Log], fitted: Bools, judged: Bools) -> dict[str, dict[str, float | None]]:
    """Held-out mean squared errors (N^2 m^2) of a PD law of each joint, and of a ridge regression over SPAN.

    `fitted` and `judged` (N, J) are the rows of all logs, one after the other, as wide as their joints.
    """
    squares = {"joint_pd": 0.0, "ridge": 0.0}
    torques = [np.asarray(log.without_feed_forward().tau, dtype=float) for log in logs]
    for j in range(fitted.shape[1]):
        tau = np.concatenate([torque[:, j] for torque in torques])
        fit, judge = fitted[:, j], judged[:, j]
        laws = [
            _regressors(logs, j, (delay,), (0.0,))
            for delay in np.arange(0.0, MAX_DELAY_S + LAG_STEP_S / 2, LAG_STEP_S)
        ]
        best = min(
            (_residual(law, tau, fit, 0.0) for law in laws), key=lambda one: float(np.mean(one[fit] ** 2))
        )
        squares["joint_pd"] += float(np.sum(best[judge] ** 2))
        step = max(LAG_STEP_S, float(np.median([log.period for log in logs])))
        past = tuple(step * np.arange(max(1, round(FILTER_SPAN_S / step)) + 1))
        miss = _residual(_regressors(logs, j, past, past), tau, fit, RIDGE_PENALTY)
        squares["ridge"] += float(np.sum(miss[judge] ** 2))
    count = max(int(judged.sum()), 1)
    variance = torque_variance(measured_torque(logs), judged)
    return {
        name: {"heldout_mse": total / count, "heldout_explained": explained_share(total / count, variance)}
        for name, total in squares.items()
    }


def measured_torque(logs: Sequence[Log]) -> Array:
    """Measured torque of all logs (N, J), N m, one after the other."""
    return np.concatenate([np.asarray(log.tau, dtype=float) for log in logs])


def torque_variance(torque: Array, rows: Bools) -> float:
    """Variance (N^2 m^2) of the `torque` (N, J) about each joint's mean, over the `rows` (N, J)."""
    count = np.maximum(rows.sum(axis=0), 1)
    centred = torque - np.sum(torque, axis=0, where=rows) / count
    return float(np.sum(centred**2, where=rows) / count.sum())


def explained_share(mse: float, variance: float) -> float | None:
    """Share of the torque's `variance` that a mean squared error of `mse` leaves nothing of, below 0 where it is larger.

    None of a torque that does not vary.
    """
    return 1.0 - mse / variance if variance > 0.0 else None


def _regressors(logs: Sequence[Log], j: int, commands: Sequence[float], states: Sequence[float]) -> Array:
    """Commands, angles and speeds of joint `j`, so many seconds ago, and 1, (N, K)."""
    return np.concatenate([np.stack([*_log_regressors(log, j, commands, states)], axis=1) for log in logs])


def _log_regressors(log: Log, j: int, commands: Sequence[float], states: Sequence[float]) -> Iterator[Array]:
    for late in commands:
        yield np.asarray(log.q_des[log.command_rows(log.t - late), j], dtype=float)
    for values in (log.q, log.dq):
        for late in states:
            yield np.interp(log.t - late, log.t, values[:, j])
    yield np.ones(len(log.t))


def _residual(signals: Array, tau: Array, rows: Bools, penalty: float) -> Array:
    """What is left of the torque (N,) with weights fitted to `rows`, the last one, of 1, without a penalty."""
    x = signals[rows, :-1]
    centre, size = x.mean(axis=0), x.std(axis=0) + 1e-12
    x = (x - centre) / size
    level = tau[rows].mean()
    gram = x.T @ x + (penalty + 1e-12) * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ (tau[rows] - level))
    left: Array = tau - level - (signals[:, :-1] - centre) / size @ weights
    return left

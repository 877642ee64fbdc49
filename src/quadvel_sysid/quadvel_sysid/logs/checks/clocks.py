"""Check that states and commands share one clock, by the lag that explains the torque best.

At each lag l the torque of a joint is regressed on the terms of a PD law at that lag,

    tau(t) = a q_des(t - l) + b dq_des(t - l) + c tau_ff(t - l) + d q(t) + e dq(t) + f sign(dq(t)) + g.

If dq_des is not logged, the slope of q_des replaces it, as a drive may feed it forward. The sums
of products over the overlapping rows are cross-correlations, so Fourier transforms give them for
all lags at once. Without torque, the acceleration replaces it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from scipy import fft

from quadvel_description.arrays import Array, Indices

from ..findings import Finding
from ..log import Log
from .response import (
    EXPLAINED_ERROR_SHARE,
    MAX_DRIVE_DELAY_S,
    MAX_LAG_S,
    PREFERRED_ERROR_RATIO,
    TIME_ROUNDING_S,
    motion_regressors,
)

LAG_STEP_S = 0.002
"""s between two lags, at least one row of the log."""
MAX_CLOCK_LAG_S = 10.0
"""s; largest lag to either side, at most half of the log."""
MAX_ROWS = 30_000
"""Rows used, from the middle of a long log: one minute at `LAG_STEP_S`."""
MAX_SPEED_LEAD_S = 0.2
"""s; largest kd / kp of a drive that feeds the commanded speed forward."""
MIN_STANDARD_ERRORS = 4.0
"""Standard errors by which another lag must explain more; in a healthy log chance does that once in
30,000.
"""
PIECE_S = 0.1
"""s of motion that count as one independent piece of evidence."""
MAX_MOTION_LAG_S = 0.25
"""s; lag of an acceleration to its command, to either side: springs and friction are not known."""
SLOPE_HALF_WIDTH_S = 0.01
"""s to either side over which the slope of dq is computed."""


@attrs.frozen(eq=False)
class _JointSignals:
    """Signals of one joint at N evenly spaced instants.

    Attributes:
        torque: (N,) torque, N m, or acceleration.
        fixed: (N, K) regressors at the torque's instant: angle, speed, direction, 1.
        moving: (N, C) regressors that are shifted by the lag: q_des, its speed, and tau_ff if
            logged.
        use: (N,) 1 in valid rows, else 0.
        sent: (N,) 1 after the first command, else 0.
    """

    torque: Array
    fixed: Array
    moving: Array
    use: Array
    sent: Array

    def error_share(self, most: int) -> Array:
        """Share of the torque's variance that the regression leaves at each lag.

        Args:
            most: Largest lag, rows.

        Returns:
            (2 most + 1,) shares, for lags from -most to most rows.
        """
        # Residual variance of the regression over that of the torque, at all lags. The commanded
        # speed is a regressor only at lags where its weight is plausible for a drive.
        products = self._products(most)
        one, command, speed = self.fixed.shape[1] - 1, self.fixed.shape[1], self.fixed.shape[1] + 1
        variance = products[:, -1, -1] - products[:, -1, one] ** 2 / (products[:, one, one] + 1e-12)
        every = np.arange(products.shape[1] - 1)
        plain, _ = _regress(products, np.delete(every, speed))
        fed, weights = _regress(products, every)
        causal = _causal(weights[:, command], weights[:, speed])
        return np.asarray(np.where(causal, np.minimum(plain, fed), plain) / (variance + 1e-12))

    def _products(self, most: int) -> Array:
        """Products (L, P, P) of `fixed`, `moving` and `torque`, summed over overlapping rows."""
        # With weights w and v, each product is a cross-correlation over the overlapping rows,
        #   sum_t w(t) a(t) b(t) v(t - l) c(t - l) d(t - l),
        # where a, b are columns of the torque's instant and c, d those of the command's (1 if absent).
        # It is the inverse transform of FFT(w a b) conj(FFT(v c d)).
        rows, still, sent = len(self.torque), self.fixed.shape[1], self.moving.shape[1]
        here = np.column_stack([self.fixed, np.ones((rows, sent)), self.torque])
        there = np.column_stack([np.ones((rows, still)), self.moving, np.ones(rows)])
        a, b = np.triu_indices(here.shape[1])
        length = fft.next_fast_len(rows + most + 1, real=True)
        spectra = (
            fft.rfft((weight[:, None] * columns[:, a] * columns[:, b]).T, length)
            for weight, columns in ((self.use, here), (self.sent, there))
        )
        first, second = spectra
        sums = fft.irfft(first * np.conj(second), length)
        found = np.empty((2 * most + 1, here.shape[1], here.shape[1]))
        found[:, a, b] = found[:, b, a] = np.concatenate([sums[:, -most:], sums[:, : most + 1]], axis=1).T
        return found

    def squared_errors(self, late: int) -> Array:
        """Squared error of the regression at one lag, over the torque's variance.

        Args:
            late: The lag, rows.

        Returns:
            (N,) errors; 0 in rows without a known command.
        """
        row = np.arange(len(self.torque)) - late
        known = (row >= 0) & (row < len(row))
        row = np.clip(row, 0, len(row) - 1)
        weight = self.use * self.sent[row] * known
        signals = np.column_stack([self.fixed, self.moving[row]]) * weight[:, None]
        torque, command = self.torque * weight, self.fixed.shape[1]
        weights = np.linalg.lstsq(signals, torque, rcond=1e-9)[0]
        if not _causal(weights[command], weights[command + 1]):
            signals[:, command + 1] = 0.0
            weights = np.linalg.lstsq(signals, torque, rcond=1e-9)[0]
        variance = float(np.var(self.torque[weight > 0.0])) + 1e-12
        return np.asarray((torque - signals @ weights) ** 2 / variance)


def _causal(of_command: Any, of_speed: Any) -> Any:
    """Whether a drive that feeds the speed forward can have these weights: a lead of 0 to 0.2 s."""
    return (of_command * of_speed >= 0.0) & (np.abs(of_speed) <= MAX_SPEED_LEAD_S * np.abs(of_command))


def _regress(products: Array, columns: Indices) -> tuple[Array, Array]:
    """Regress the last column on `columns`: residual sums of squares (L,), weights (L, P - 1)."""
    # Normal equations X^T X w = X^T y at every lag, scaled to a unit diagonal; then
    # the residual is y^T y - w^T X^T y.
    inner, outer = products[:, columns[:, None], columns], products[:, columns, -1]
    size = np.sqrt(np.maximum(np.einsum("lkk->lk", inner), 1e-12))
    inner = inner / size[:, :, None] / size[:, None, :] + 1e-9 * np.eye(len(columns))
    weights = np.zeros((len(products), products.shape[1] - 1))
    weights[:, columns] = np.linalg.solve(inner, (outer / size)[..., None])[..., 0] / size
    left = products[:, -1, -1] - np.sum(weights[:, columns] * outer, axis=1)
    return np.maximum(left, 0.0), weights


@attrs.frozen(eq=False)
class LagProfile:
    """Error of the regression at each lag, for all joints that move.

    Attributes:
        step: Time between lags, s.
        max_steps: Number of lags to either side.
        joints: Signals of each joint.
    """

    step: float
    max_steps: int
    joints: tuple[_JointSignals, ...]

    @cached_property
    def lags(self) -> Array:
        """Lags (L,) from a command to its torque, s."""
        return np.asarray(self.step * np.arange(-self.max_steps, self.max_steps + 1), dtype=np.float64)

    @cached_property
    def error_share(self) -> Array:
        """Share (L, J) of each joint's torque variance that is left."""
        return np.stack([one.error_share(self.max_steps) for one in self.joints], axis=1)

    @cached_property
    def mean_error_share(self) -> Array:
        """Geometric mean (L,) of `error_share` over the joints."""
        return np.asarray(np.exp(np.mean(np.log(self.error_share + 1e-6), axis=1)), dtype=np.float64)

    def standard_errors(self, lag: int, other: int) -> float:
        """Certainty that one lag explains more than another.

        Args:
            lag: Index of the first lag.
            other: Index of the second lag.

        Returns:
            Difference of their errors in standard errors, estimated from pieces of `PIECE_S`.
        """
        gains = [
            one.squared_errors(other - self.max_steps) - one.squared_errors(lag - self.max_steps)
            for one in self.joints
        ]
        gain = np.sum(gains, axis=0)
        pieces = np.add.reduceat(gain, np.arange(0, len(gain), max(1, round(PIECE_S / self.step))))
        return float(pieces.sum() / np.sqrt(np.sum((pieces - pieces.mean()) ** 2) + 1e-12))


def lag_profile(log: Log) -> LagProfile | None:
    """Compute the error of the regression at each lag.

    Args:
        log: The log.

    Returns:
        The profile; None with fewer than 50 valid instants or without a changing command.
    """
    step = max(LAG_STEP_S, log.period)
    t = np.arange(log.t[0], log.t[-1], step)
    t = t[max(0, len(t) - MAX_ROWS) // 2 :][:MAX_ROWS]
    row, command = np.searchsorted(log.t, t + TIME_ROUNDING_S, side="right") - 1, log.command_rows(t)
    moving = np.flatnonzero(log.valid[row].any(axis=0) & (np.ptp(log.q_des[command], axis=0) > 0.0))
    if log.valid[row].any(axis=1).sum() < 50 or not len(moving):
        return None
    sent = np.asarray(t >= log.t_cmd[0], dtype=float)
    joints = tuple(_joint_signals(log, int(j), row, command, sent, step) for j in moving)
    return LagProfile(step, int(min(MAX_CLOCK_LAG_S, step * len(t) / 2) / step), joints)


def _joint_signals(
    log: Log, j: int, row: Indices, command: Indices, sent: Array, step: float
) -> _JointSignals:
    """Signals of joint `j` at evenly spaced instants, means removed."""
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    q_des = np.asarray(log.q_des[command, j], dtype=float) - q.mean()
    reach = max(1, round(SLOPE_HALF_WIDTH_S / step))
    torque = _slope(dq, reach, step) if log.tau is None else np.asarray(log.tau[row, j], dtype=float)
    speed = np.gradient(q_des, step) if log.dq_des is None else log.dq_des[command, j]
    asked = [q_des, speed, *([] if log.tau_ff is None else [log.tau_ff[command, j]])]
    return _JointSignals(
        torque - torque.mean(),
        np.column_stack([q - q.mean(), motion_regressors(dq)]),
        np.column_stack(asked).astype(float),
        log.valid[row, j].astype(float),
        sent,
    )


def _slope(x: Array, reach: int, step: float) -> Array:
    """Central difference of `x` (N,) over `reach` rows to either side."""
    first, last = np.maximum(np.arange(len(x)) - reach, 0), np.minimum(np.arange(len(x)) + reach, len(x) - 1)
    return np.asarray((x[last] - x[first]) / ((last - first) * step))


def clock_offset(log: Log) -> Iterator[Finding]:
    """Torque (or motion) that follows the commands with a lag that no drive has: two clocks.

    Args:
        log: The log to check.

    Yields:
        A refusal.
    """
    found = lag_profile(log)
    if found is None:
        return
    earliest, latest = (
        (0.0, MAX_DRIVE_DELAY_S) if log.tau is not None else (-MAX_MOTION_LAG_S, MAX_MOTION_LAG_S)
    )
    of_a_drive = (found.lags > earliest - LAG_STEP_S / 2) & (found.lags < latest + LAG_STEP_S / 2)
    best = int(np.argmin(found.mean_error_share))
    usual = int(np.argmin(np.where(of_a_drive, found.mean_error_share, np.inf)))
    lag, left, other = (
        float(found.lags[best]),
        float(found.mean_error_share[best]),
        float(found.mean_error_share[usual]),
    )
    ratio = EXPLAINED_ERROR_SHARE if latest < lag <= MAX_MOTION_LAG_S else PREFERRED_ERROR_RATIO
    if of_a_drive[best] or left > min(ratio * other, EXPLAINED_ERROR_SHARE):
        return
    if found.standard_errors(best, usual) < MIN_STANDARD_ERRORS:
        return
    what = "torque" if log.tau is not None else "motion"
    shares = (
        f"that leaves {100 * left:.2g} % of the {what}, a delay that a drive can have {100 * other:.2g} %"
    )
    if -MAX_LAG_S <= lag < 0.0:
        text = (
            f"t_cmd: the {what} comes {-1e3 * lag:.0f} ms before its command ({shares}); expected each command at the time it "
            "was sent: is it logged a step late?"
        )
    else:
        way = (
            f"{lag:.2f} s after they were sent, more than a drive can be late"
            if lag > 0.0
            else f"{-lag:.2f} s before they were sent"
        )
        text = f"t_cmd: the {what} answers commands {way} ({shares}): t and t_cmd are not of one clock; expected one for both"
    yield Finding("refusal", "t_cmd", (), text)

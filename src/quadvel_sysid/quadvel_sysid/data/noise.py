"""Variance of the noise of torques and encoders, from differences of consecutive rows."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from quadvel_description.arrays import Array, Bools

from .signals import Samples

_DIFFERENCE_ORDERS = (2, 3, 4, 5)
_INNER_FRACTION = 0.9
_INNER_VARIANCE = 0.5607
"""Fraction of a normal variable's variance that lies within its inner nine tenths."""


def noise_variance(samples: Samples, rows: Bools, residual: Array) -> Array:
    """Estimate the variance of the torque noise from differences of consecutive rows.

    A smooth torque hardly contributes to differences of order 2 to 5. Step commands do, so that the
    residual of a model is differenced as well and the smaller estimate counts. The quantisation
    noise D^2 / 12 of a torque with the resolution D is a lower bound. A joint with a constant
    torque gets the mean of the other joints.

    Args:
        samples: Rows of all logs.
        rows: Samples to use, (N, J) bool.
        residual: Residual of a model, (N, J), N m.

    Returns:
        Variance, (J,), N^2 m^2.
    """
    from_torque = _difference_variance(samples.tau, samples, rows)
    from_residual = _difference_variance(residual, samples, rows)
    found = np.minimum(from_torque, from_residual)
    # Rounding to multiples of D is an error with uniform distribution over D, of variance D^2 / 12.
    ticks = np.array([_quantisation_step(one[keep]) for one, keep in zip(samples.tau.T, rows.T, strict=True)])
    found = np.maximum(found, ticks**2 / 12.0)
    is_known = found > 0.0
    return np.where(is_known, found, found[is_known].mean() if is_known.any() else 1.0)


def _quantisation_step(x: Array) -> float:
    """Smallest difference of two distinct values, apart from round-off; 0 for a constant."""
    span = float(np.ptp(x))
    return span * float(np.diff(np.unique(np.round(x / span, 9))).min()) if span > 0.0 else 0.0


def encoder_variance(samples: Samples, rows: Bools, kp: float, kd: float) -> Array:
    """Estimate the torque variance that encoder noise causes through the PD gains.

        var = kp^2 var(q) + kd^2 var(dq)

    Args:
        samples: Rows of all logs.
        rows: Samples to use, (N, J) bool.
        kp: Position gain, N m/rad.
        kd: Velocity gain, N m s/rad.

    Returns:
        Variance, (J,), N^2 m^2.
    """
    q, dq = (np.concatenate([one.states[name] for one in samples.sources.series]) for name in ("q", "dq"))
    return kp**2 * _difference_variance(q, samples, rows) + kd**2 * _difference_variance(dq, samples, rows)


def _difference_variance(values: Array, samples: Samples, rows: Bools) -> Array:
    """Smallest noise variance (J,) over difference orders 2 to 5."""
    # White noise of variance s^2 has differences of order k with the variance s^2 binom(2k, k).
    # The smallest estimate over k counts, as the signal itself adds to each of them.
    found = []
    for order in _DIFFERENCE_ORDERS:
        differences = np.diff(values, order, axis=0)
        whole = rows[order:].copy()
        for back in range(1, order + 1):
            new = samples.start[order - back + 1 : len(rows) - back + 1, None]
            whole &= rows[order - back : -back] & ~new
        spread: Sequence[float] = [
            _robust_variance(differences[whole[:, j], j]) for j in range(rows.shape[1])
        ]
        found.append(np.array(spread) / comb(2 * order, order))
    least: Array = np.min(found, axis=0)
    return least


def _robust_variance(x: Array) -> float:
    """Variance of the inner nine tenths, scaled to that of a normal distribution."""
    if len(x) < 20:
        return float("inf")
    inner = np.abs(x) <= np.quantile(np.abs(x), _INNER_FRACTION)
    return float(np.sum(x[inner] ** 2) / len(x) / _INNER_VARIANCE)

"""The noise floor of a measured torque, without a model: what local differences cannot be but noise.

High differences of consecutive samples hold the noise but next to nothing of a smooth torque. Commands that step
between samples are no noise: the differences are also taken of what the EAM leaves, and the lesser counts.
"""

from __future__ import annotations

from math import comb

import numpy as np

from .signals import Array, Bools, Samples

ORDERS = (2, 3, 4, 5)


def noise_floor(samples: Samples, rows: Bools, residual: Array) -> Array:
    """Variance of the noise of each joint, (J,), N^2 m^2."""
    return np.minimum(_local(samples.tau, samples, rows), _local(residual, samples, rows))


def encoder_noise(samples: Samples, rows: Bools, kp: float, kd: float) -> Array:
    """Variance of what the noise of the measured q and dq makes of the torque asked for at these gains, (J,), N^2 m^2."""
    q, dq = (np.concatenate([one.states[name] for one in samples.logs]) for name in ("q", "dq"))
    return kp**2 * _local(q, samples, rows) + kd**2 * _local(dq, samples, rows)


def _local(values: Array, samples: Samples, rows: Bools) -> Array:
    """The least of the variances that differences of several orders show, each without its largest tenth."""
    found = []
    for order in ORDERS:
        differences = np.diff(values, order, axis=0)
        whole = rows[order:].copy()
        for back in range(1, order + 1):
            whole &= (
                rows[order - back : -back] & ~samples.start[order - back + 1 : len(rows) - back + 1, None]
            )
        found.append(
            [_spread(differences[whole[:, j], j]) / comb(2 * order, order) for j in range(rows.shape[1])]
        )
    least: Array = np.min(found, axis=0)
    return least


_KEPT = 0.9
_KEPT_SHARE = 0.5607  # of a normal variable's variance lies within its inner nine tenths


def _spread(x: Array) -> float:
    """Variance of the inner nine tenths, scaled to that of normal numbers."""
    if len(x) < 20:
        return float("inf")
    inner = np.abs(x) <= np.quantile(np.abs(x), _KEPT)
    return float(np.sum(x[inner] ** 2) / len(x) / _KEPT_SHARE)

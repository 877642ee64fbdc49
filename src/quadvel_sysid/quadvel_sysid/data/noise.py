"""Variance of the torque noise, from differences of consecutive rows."""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array, Bools

from .differences import difference_variance
from .signals import Samples


def noise_variance(samples: Samples, rows: Bools, residual: Array) -> Array:
    """Estimate the variance of the torque noise from differences of consecutive rows.

    A smooth torque adds little to differences of order 2 to 5, but steps of the command add much. A
    model explains most of these steps. Its residual is therefore differenced too, and the smaller
    estimate counts. The quantisation noise D^2 / 12 of a torque with the resolution D is a lower
    bound. A joint with a constant torque gets the mean of the other joints.

    Args:
        samples: Rows of all logs.
        rows: Samples to use, (N, J) bool.
        residual: Residual of a model, (N, J), N m.

    Returns:
        Variance, (J,), N^2 m^2.
    """
    from_torque = difference_variance(samples.tau, rows, samples.start)
    from_residual = difference_variance(residual, rows, samples.start)
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

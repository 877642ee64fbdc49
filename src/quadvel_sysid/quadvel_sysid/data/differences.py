"""Variance of white noise, from differences of consecutive rows."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from quadvel_description.arrays import Array, Bools

_DIFFERENCE_ORDERS = (2, 3, 4, 5)
_INNER_FRACTION = 0.9
_INNER_VARIANCE = 0.5607
"""Fraction of a normal variable's variance that lies within its inner nine tenths."""


def difference_variance(values: Array, rows: Bools, start: Bools) -> Array:
    """Estimate the variance of the white noise in smooth series.

    Args:
        values: Series, (N, J).
        rows: Samples to use, (N, J) bool.
        start: Rows at which a contiguous stretch begins, (N,) bool.

    Returns:
        Smallest variance over the difference orders 2 to 5, (J,), in squared units of `values`.
    """
    # White noise of variance s^2 has differences of order k with the variance s^2 binom(2k, k).
    # The smallest estimate over k counts, as the signal itself adds to each of them.
    found = []
    for order in _DIFFERENCE_ORDERS:
        differences = np.diff(values, order, axis=0)
        whole = rows[order:].copy()
        for back in range(1, order + 1):
            new = start[order - back + 1 : len(rows) - back + 1, None]
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

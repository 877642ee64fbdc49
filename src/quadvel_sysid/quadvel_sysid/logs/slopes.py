"""Speeds out of positions: the slope of a cubic through the rows around, as many as foretell a row left out best.

This is Savitzky and Golay's filter, its width chosen by leave-one-out cross-validation: an encoder that counts coarse
steps needs many rows, a fine one few, and neither has to be known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs, savgol_filter

from .log import Array

WIDTHS = (5, 7, 9, 13, 17, 21, 25, 33, 45, 65)
"""Rows that are looked at together."""
ORDER = 3
"""Of the polynomial: its slope at the middle row is free of the second and the fourth derivative."""
GAP = 3.5
"""Times the usual spacing, beyond which rows are no neighbours."""


def smoothed(t: Array, q: Array) -> tuple[Array, Array, float]:
    """Positions and speeds (N, J) of the angles `q` at the times `t` (N,), and the span that they are taken over, s.

    A slope is that over the row's number, divided by that of the time over it, so that stamps may be uneven.
    """
    t, q = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    steps = np.diff(t)
    usual = float(np.median(steps))
    pieces = np.split(np.arange(len(t)), 1 + np.flatnonzero(steps > GAP * usual))
    longest = max(pieces, key=len)
    width = min((w for w in WIDTHS if w <= len(longest)), key=lambda w: _left_out(q[longest], w), default=0)
    level, speed = q.copy(), np.zeros_like(q)
    for piece in pieces:
        of_it = max((w for w in WIDTHS if w <= min(width, len(piece))), default=0)
        if of_it:
            rate = savgol_filter(t[piece], of_it, ORDER, deriv=1)[:, None]
            level[piece] = savgol_filter(q[piece], of_it, ORDER, axis=0)
            speed[piece] = savgol_filter(q[piece], of_it, ORDER, deriv=1, axis=0) / rate
        elif len(piece) > 1:
            speed[piece] = np.gradient(q[piece], t[piece], axis=0)
    return level, speed, (width - 1) * usual


def _left_out(q: Array, width: int) -> float:
    """Mean squared error with which the rows around foretell a row: its residual over 1 less its own weight."""
    own = float(savgol_coeffs(width, ORDER)[width // 2])
    inner = slice(width // 2, len(q) - width // 2)
    residual = (q - savgol_filter(q, width, ORDER, axis=0))[inner]
    size: NDArray[np.float64] = np.sqrt(np.var(q, axis=0)) + 1e-12
    return float(np.mean((residual / size / (1.0 - own)) ** 2))


def tick(q: Array) -> Array:
    """The step (J,) that the encoder of each joint counts in, rad; 0 where its values are not of one coarse grid."""
    found = np.zeros(q.shape[1])
    for j, column in enumerate(np.asarray(q, dtype=float).T):
        values = np.unique(column)
        if not 3 <= len(values) <= len(column) // 2:
            continue
        steps = np.diff(values)
        step = float(np.percentile(steps[steps > 1e-6 * np.ptp(values)], 10))
        of_grid = (values - values[0]) / step
        if np.mean(np.abs(of_grid - np.round(of_grid)) < 0.1) > 0.95:
            found[j] = step
    return found

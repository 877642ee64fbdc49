"""Speeds out of positions: the slope of a cubic through the rows around, as many as foretell a row left out best.

This is Savitzky and Golay's filter, its width chosen by leave-one-out cross-validation: an encoder that counts coarse
steps needs many rows, a fine one few, and neither has to be known. Where torque was measured, what it makes of the motion,
its second integral times the mobility that fits best, is taken out before and put back after: commands make the torque
jump, and a slope over many rows would smear that.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import savgol_coeffs, savgol_filter

from .log import GAP, Array

WIDTHS = (5, 7, 9, 13, 17, 21, 25, 33, 45, 65, 91)
"""Rows that are looked at together."""
ORDER = 3
"""Of the polynomial: its slope at the middle row is free of the second and the fourth derivative."""
ENOUGH = 20_000
"""Rows in a row, of which the width is read."""


@attrs.frozen(eq=False)
class Smooth:
    """Angles `q` (N, J), their speeds `dq`, and the `span` of time that they are taken over, s."""

    q: Array
    dq: Array
    span: float


def smoothed(t: Array, q: Array, tau: Array | None = None) -> Smooth:
    """The angles `q` (N, J) at the times `t` (N,), and their slopes; `tau` (N, J) N m is what drives them, where it is known.

    A slope is that over the row's number, divided by that of the time over it, so that stamps may be uneven.
    """
    t, q = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    steps = np.diff(t)
    usual = float(np.median(steps))
    pieces = np.split(np.arange(len(t)), 1 + np.flatnonzero(steps > GAP * usual))
    pushed = np.zeros((2, *q.shape))  # integrals of the torque: as a speed, as an angle
    if tau is not None:
        for piece in pieces:
            one = np.asarray(tau[piece], dtype=float)
            for k in range(2):
                one = cumulative_trapezoid(one - one.mean(axis=0), t[piece], axis=0, initial=0.0)
                pushed[k, piece] = one = one - one.mean(axis=0)
    longest = max(pieces, key=len)
    longest = longest[max(0, len(longest) - ENOUGH) // 2 :][:ENOUGH]
    tries = [_left_out(q[longest], pushed[1, longest], w) for w in WIDTHS if w <= len(longest)]
    _, width, mobility = min(tries, key=lambda one: one[0], default=(0.0, 0, np.zeros((q.shape[1],) * 2)))
    level, slope = q.copy(), np.zeros_like(q)
    for piece in pieces:
        of_it = max((w for w in WIDTHS if w <= min(width, len(piece))), default=0)
        for j in range(q.shape[1]) if len(piece) > 1 else ():  # one by one: a log may be long
            speed, angle = (x[piece] @ mobility[:, j] for x in pushed)
            rest = q[piece, j] - angle
            if of_it:
                rate = savgol_filter(t[piece], of_it, ORDER, deriv=1)
                level[piece, j] = savgol_filter(rest, of_it, ORDER) + angle
                slope[piece, j] = savgol_filter(rest, of_it, ORDER, deriv=1) / rate + speed
            else:
                slope[piece, j] = np.gradient(q[piece, j], t[piece])
    return Smooth(level, slope, max(width - 1, 2) * usual)


def _left_out(q: Array, pushed: Array, width: int) -> tuple[float, int, Array]:
    """Mean squared error with which the rows around foretell a row, `width` of them; and the mobility (J, J) with which they do.

    The error of a row left out is its residual over 1 less its own weight.
    """
    own = float(savgol_coeffs(width, ORDER)[width // 2])
    inner = slice(width // 2, len(q) - width // 2)
    miss, driven = ((x - savgol_filter(x, width, ORDER, axis=0))[inner] / (1.0 - own) for x in (q, pushed))
    mobility: Array = np.linalg.lstsq(driven, miss, rcond=1e-8)[0]
    return float(np.mean((miss - driven @ mobility) ** 2)), width, mobility


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

"""Joint speeds from joint angles: a Savitzky-Golay filter whose width is chosen by cross-validation.

The slope of a cubic through the rows around is the speed. The number of rows is the one that
predicts a left-out row best (leave-one-out cross-validation): a coarse encoder needs many rows, a
fine one few, and the resolution need not be known. Commands make the torque jump, and a slope
over many rows would smear that. If the torque is known, its second integral, times the mobility
that fits best, is subtracted before the filter and added afterwards.

Reference: A. Savitzky and M. Golay, Smoothing and differentiation of data by simplified least
squares procedures, 1964.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import savgol_coeffs, savgol_filter

from quadvel_description.arrays import Bools, Floats

from ..log import GAP_FACTOR

WINDOW_ROWS = (5, 7, 9, 13, 17, 21, 25, 33, 45, 65, 91)
"""Candidate widths of the filter, rows."""
POLYNOMIAL_ORDER = 3
"""A cubic: its slope at the middle row has no error from the second and the fourth derivative."""
MAX_SELECTION_ROWS = 20_000
"""Consecutive rows on which the width is chosen, at most."""
RESTING_SPEED_RAD_S = 0.1
"""Speed below which a coarse encoder rests: friction depends on the sign of the speed, which a pause on
one count hides.
"""


@attrs.frozen(eq=False)
class SmoothedMotion:
    """Filtered angles and their slopes.

    Attributes:
        q: (N, J) filtered angles, rad.
        dq: (N, J) speeds, rad/s.
        window_s: Duration of the filter's window, s.
    """

    q: Floats
    dq: Floats
    window_s: float


def smooth_motion(t: Floats, q: Floats, tau: Floats | None = None) -> SmoothedMotion:
    """Compute joint speeds from joint angles.

    Both q and t are filtered over the row number, and dq = (dq/dn) / (dt/dn), so times may be
    spaced unevenly. Gaps separate the log into pieces, which are filtered one by one.

    Args:
        t: (N,) times, s.
        q: (N, J) measured angles, rad.
        tau: (N, J) joint torques, N m, or None if not known.

    Returns:
        Filtered angles, speeds, and the width that was chosen.
    """
    t, q = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    steps = np.diff(t)
    usual = float(np.median(steps))
    pieces = np.split(np.arange(len(t)), 1 + np.flatnonzero(steps > GAP_FACTOR * usual))
    # First and second integral of the torque, without their means: as a speed and as an angle. With
    # the mobility B the motion is q = B pushed[1] + rest, and only the rest is filtered.
    pushed = np.zeros((2, *q.shape))
    if tau is not None:
        for piece in pieces:
            one = np.asarray(tau[piece], dtype=float)
            for k in range(2):
                one = cumulative_trapezoid(one - one.mean(axis=0), t[piece], axis=0, initial=0.0)
                pushed[k, piece] = one = one - one.mean(axis=0)
    longest = max(pieces, key=len)
    longest = longest[max(0, len(longest) - MAX_SELECTION_ROWS) // 2 :][:MAX_SELECTION_ROWS]
    tries = [
        _leave_one_out_error(q[longest], pushed[1, longest], w) for w in WINDOW_ROWS if w <= len(longest)
    ]
    _, width, mobility = min(tries, key=lambda one: one[0], default=(0.0, 0, np.zeros((q.shape[1],) * 2)))
    level, slope = q.copy(), np.zeros_like(q)
    for piece in pieces:
        width_here = max((w for w in WINDOW_ROWS if w <= min(width, len(piece))), default=0)
        for j in range(q.shape[1]) if len(piece) > 1 else ():  # joint by joint, to bound memory
            speed, angle = (x[piece] @ mobility[:, j] for x in pushed)
            rest = q[piece, j] - angle
            if width_here:
                rate = savgol_filter(t[piece], width_here, POLYNOMIAL_ORDER, deriv=1)
                level[piece, j] = savgol_filter(rest, width_here, POLYNOMIAL_ORDER) + angle
                slope[piece, j] = savgol_filter(rest, width_here, POLYNOMIAL_ORDER, deriv=1) / rate + speed
            else:
                slope[piece, j] = np.gradient(q[piece, j], t[piece])
    return SmoothedMotion(level, slope, max(width - 1, 2) * usual)


def _leave_one_out_error(q: Floats, pushed: Floats, width: int) -> tuple[float, int, Floats]:
    """Mean squared error of predicting a left-out row, the width, and the fitted mobility (J, J).

    A linear filter with weight h of a row on itself has the left-out residual e / (1 - h).
    """
    own = float(savgol_coeffs(width, POLYNOMIAL_ORDER)[width // 2])
    inner = slice(width // 2, len(q) - width // 2)
    # Left-out residuals of q and of the torque's second integral; the mobility B minimises their
    # difference |miss - driven B|.
    miss, driven = (
        (x - savgol_filter(x, width, POLYNOMIAL_ORDER, axis=0))[inner] / (1.0 - own) for x in (q, pushed)
    )
    mobility: Floats = np.linalg.lstsq(driven, miss, rcond=1e-8)[0]
    return float(np.mean((miss - driven @ mobility) ** 2)), width, mobility


def encoder_step(q: Floats) -> Floats:
    """Find the step in which each joint's encoder counts.

    Args:
        q: (N, J) measured angles, rad.

    Returns:
        (J,) step, rad; 0 where the values are not on one coarse grid.
    """
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


def resting_rows(t: Floats, q: Floats, step: Floats) -> Bools:
    """Find the rows in which a coarse encoder stays on one count for long.

    Args:
        t: (N,) times, s.
        q: (N, J) measured angles, rad.
        step: (J,) step of each encoder, rad; 0 for a fine one.

    Returns:
        (N, J) whether q keeps its value for longer than `step` at `RESTING_SPEED_RAD_S`.
    """
    found = np.zeros(q.shape, dtype=bool)
    for j in np.flatnonzero(step > 0.0):
        first = np.concatenate([[0], 1 + np.flatnonzero(np.diff(q[:, j]) != 0.0)])  # row of each pause
        end = np.append(t[first[1:]], t[-1])
        pause = np.repeat(end - t[first], np.diff(first, append=len(t)))
        found[:, j] = pause > step[j] / RESTING_SPEED_RAD_S
    return found

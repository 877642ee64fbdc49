"""Accelerations of joints from noisy speeds, sharp where a command arrives.

A slope of dq over some milliseconds blurs the steps that a command causes in the torque, and so
in ddq. The size of these steps follows from the speeds themselves. Let s be the integral of q_des
as it acts, D the slope over a window of rows, and B the response (rad/s^2 of each joint for 1 rad
of each command) that maps changes of slope of s to changes of slope of dq, apart from what angles and
speeds change. Then

    ddq = D dq + B (q_des - D s).
"""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array

HALF_WIDTHS_S = {"ddq": 0.002, "ddq_sharp": 0.002, "ddq_smooth": 0.008}
"""s to either side over which the slope is computed, by signal; `ddq` stays blurred, for torques
that rise slowly.
"""

_BEND_S = 0.002
"""s before and after a row; the difference of the two slopes is the change of slope."""


def local_lines(t: Array, values: Array, half_width: float) -> tuple[Array, Array]:
    """Fit a weighted line to the rows around each row.

    Args:
        t: (N,) times, s.
        values: (N, J) signal.
        half_width: Half width of the window, s, at least one row; weights fall to 0 as 1 - x^2.

    Returns:
        (N, J) value and (N, J) slope of the line at each row.
    """
    n, period = len(t), float(np.median(np.diff(t)))
    wide = max(half_width, period)
    # Weighted least squares on x = t_k - t_n, y = v_k - v_n with moments S_p = sum w x^p:
    #   [S_0 S_1] [level]   [sum w y  ]
    #   [S_1 S_2] [slope] = [sum w x y].
    moments = np.zeros((3, n))
    sums = np.zeros((2, *values.shape))
    for k in range(-round(wide / period), round(wide / period) + 1):
        here, there = slice(max(0, -k), n - max(0, k)), slice(max(0, k), n - max(0, -k))
        late = t[there] - t[here]
        weight = np.maximum(1.0 - (late / (wide + period)) ** 2, 0.0)
        change = values[there] - values[here]
        for power, total in enumerate(moments):
            total[here] += weight * late**power
        sums[0, here] += weight[:, None] * change
        sums[1, here] += (weight * late)[:, None] * change
    spread = moments[0] * moments[2] - moments[1] ** 2
    one, late, square = moments[:, :, None] / np.where(spread > 0.0, spread, np.inf)[:, None]
    return values + square * sums[0] - late * sums[1], one * sums[1] - late * sums[0]


def local_slope(t: Array, values: Array, half_width: float) -> Array:
    """Compute the slope of `local_lines`.

    Args:
        t: (N,) times, s.
        values: (N, J) signal.
        half_width: Half width of the window, s.

    Returns:
        (N, J) slope, units of `values` per second.
    """
    return local_lines(t, values, half_width)[1]


def _slope_change(t: Array, values: Array) -> Array:
    """Slope of `values` (N, J) after each row minus the slope before, (N - 2 reach, J)."""
    reach = max(1, round(_BEND_S / float(np.median(np.diff(t)))))
    steps: Array = (values[reach:] - values[:-reach]) / (t[reach:] - t[:-reach])[:, None]
    bend: Array = steps[reach:] - steps[:-reach]
    return bend


def split_acceleration(
    name: str, t: Array, states: tuple[Array, Array], slope_of_dq: Array, acting: Array
) -> tuple[Array, Array]:
    """Split an acceleration into a smooth part and the response to commands.

    Args:
        name: `ddq_sharp` or `ddq_smooth`; selects the half width.
        t: (N,) times, s.
        states: (N, J) angles q, rad, and (N, J) speeds dq, rad/s.
        slope_of_dq: (N, J) slope D dq, rad/s^2.
        acting: (N, J) integral s of q_des as it acts, rad s.

    Returns:
        D dq - B D s (N, J), rad/s^2, and B transposed (J, J), 1/s^2.
    """
    # Joints under a PD law accelerate by ddq = B q_des + P q + V dq + a slow part. The change of
    # slope M x = (D_after - D_before) x of the integral of both sides is, in least squares,
    #     M dq = B M s + P M (integral of q) + V M q.
    # Without P and V, B would make up for the motion between the rows of a slow log.
    q, dq = states
    q_integral = np.zeros(q.shape)
    q_integral[1:] = np.cumsum(0.5 * np.diff(t)[:, None] * (q[1:] + q[:-1]), axis=0)
    cause = _slope_change(t, np.concatenate([acting, q_integral, q], axis=1))
    scale = np.sqrt(np.mean(cause**2, axis=0)) + 1e-12  # the units of the causes differ
    cause, outcome = cause / scale, _slope_change(t, dq)
    solved = np.linalg.lstsq(cause.T @ cause, cause.T @ outcome, rcond=1e-6)[0]
    response: Array = np.asarray(solved / scale[:, None], dtype=float)[: q.shape[1]]
    return slope_of_dq - local_slope(t, acting, HALF_WIDTHS_S[name]) @ response, response

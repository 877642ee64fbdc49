"""The acceleration of joints whose speeds are noisy, sharp where a command comes in.

A slope of dq over some milliseconds smears what a command makes jump: at once the torque, and with it ddq. How far it jumps
the speeds tell themselves. With `come` the integral of q_des as it acts, D a slope over rows and B the answer (rad/s^2 of each
joint for 1 rad of each command) that makes bends of dq out of bends of `come`,

    ddq = D dq + B (q_des - D come).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF_WIDTHS_S = {"ddq": 0.002, "ddq_sharp": 0.002, "ddq_smooth": 0.008}
"""By signal: the slope is taken over so long to either side, s; `ddq` is left smeared, for torques that rise slowly"""

_BEND_S = 0.002
"""Bends are differences of slopes over so long before and after, s"""


def local_lines(t: Array, values: Array, half_width: float) -> tuple[Array, Array]:
    """Level at and slope of the line through `values` (N, J) at most `half_width` s off, near ones counting more; by rows."""
    n, period = len(t), float(np.median(np.diff(t)))
    wide = max(half_width, period)
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
    """The slope of `lines`."""
    return local_lines(t, values, half_width)[1]


def _slope_change(t: Array, values: Array) -> Array:
    """Slope of `values` (N, J) after each row less the one before; (N - 2 reach, J)."""
    reach = max(1, round(_BEND_S / float(np.median(np.diff(t)))))
    steps: Array = (values[reach:] - values[:-reach]) / (t[reach:] - t[:-reach])[:, None]
    bend: Array = steps[reach:] - steps[:-reach]
    return bend


def split_acceleration(
    name: str, t: Array, dq: Array, slope_of_dq: Array, come: Array
) -> tuple[Array, Array]:
    """Of ddq (N, J), as `name` says, what is left without B q_des, D dq - B D come, and B (J, J), transposed."""
    half_width, cause, outcome = HALF_WIDTHS_S[name], _slope_change(t, come), _slope_change(t, dq)
    answer: Array = np.asarray(
        np.linalg.lstsq(cause.T @ cause, cause.T @ outcome, rcond=1e-6)[0], dtype=float
    )
    return slope_of_dq - local_slope(t, come, half_width) @ answer, answer

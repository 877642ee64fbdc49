"""Compiled interpolation of time series; one identification needs thousands of interpolations.

`log_signals` is the only user; it decides which series to read and at what times.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from quadvel_description.arrays import Array, Indices

MAX_CURVED_ERROR = 0.1
"""Largest error of parabolas at rows that are left out, over that of lines: 0.75 for noise of dq alone, 0.04
for slopes that jump. Near a row the noise of q counts more than at a row that is left out.
"""
_MAX_LEFT_OUT = 1.5
"""Longest distance between the rows before and after one that is left out, over the median."""
_MAX_LINEAR_STEPS = 16
"""Steps of linear search before binary search."""


def rows_at(times: Array, at: Array) -> Indices:
    """Find the last row at or before each time.

    Args:
        times: (K,) times of the rows, s.
        at: (N,) times, s.

    Returns:
        (N,) row indices; 0 if no row is before.
    """
    found = np.empty(len(at), dtype=np.intp)
    _compiled()["rows_at"](times, at, found)
    return found


def locate(times: Array, at: Array) -> tuple[Indices, Array]:
    """Find the interval of rows that holds each time.

    Args:
        times: (K,) times of the rows, s.
        at: (N,) times, s.

    Returns:
        (N,) first row of the interval, and (N,) position in it, from 0 to 1.
    """
    found, share = np.empty(len(at), dtype=np.intp), np.empty(len(at))
    _compiled()["between"](times, at, found, share)
    return found, share


def bend(times: Array, slopes: Array) -> Array:
    """Compute how far a series with known slopes bends between rows.

    A parabola whose slope changes by D over an interval of length h lies s (1 - s) h D / 2 below the
    straight line, at the position s from 0 to 1.

    Args:
        times: (K,) times of the rows, s.
        slopes: (K, J) slopes of the series at the rows, in its units per second.

    Returns:
        (K, J) h D / 2 of the interval after each row, 0 for the last one.
    """
    found = np.zeros(slopes.shape)
    found[:-1] = 0.5 * np.diff(times)[:, None] * np.diff(slopes, axis=0)
    return found


def speed_bend(times: Array, angles: Array, speeds: Array) -> Array:
    """Compute how far speeds bend between rows, as the angles show it.

    A parabola of the speed through both rows, whose integral is the change of the angle D, lies
    3 s (1 - s) (2 D / h - v_0 - v_1) above the straight line at the position s. On slow logs this shows
    what a command did between two rows; on fast ones it shows noise of the angles.

    Args:
        times: (K,) times of the rows, s.
        angles: (K, J), rad.
        speeds: (K, J), rad/s.

    Returns:
        (K, J) bends as `interpolate` takes them, rad/s.
    """
    bends = np.zeros(speeds.shape)
    bends[:-1] = _speed_bend(np.diff(times)[:, None], np.diff(angles, axis=0), speeds[:-1], speeds[1:])
    return bends


def left_out_errors(times: Array, angles: Array, speeds: Array) -> tuple[Array, Array]:
    """Predict the speeds of each row from those of the rows before and after.

    Args:
        times: (K,) times of the rows, s.
        angles: (K, J), rad.
        speeds: (K, J), rad/s.

    Returns:
        Mean squared errors (J,), rad^2/s^2, of a straight line and of the parabola of `speed_bend`.
    """
    h = times[2:] - times[:-2]
    near = h <= _MAX_LEFT_OUT * np.median(h)
    h = h[:, None]
    s = (times[1:-1] - times[:-2])[:, None] / h
    bends = _speed_bend(h, angles[2:] - angles[:-2], speeds[:-2], speeds[2:])
    straight = speeds[1:-1] - speeds[:-2] - s * (speeds[2:] - speeds[:-2])
    curved = straight + s * (1.0 - s) * bends
    return np.mean(straight[near] ** 2, axis=0), np.mean(curved[near] ** 2, axis=0)


def _speed_bend(h: Array, turned: Array, before: Array, after: Array) -> Array:
    """Bends of speeds over intervals of length h in which the angles change by `turned`."""
    bends: Array = -3.0 * (2.0 * turned / h - before - after)
    return bends


def interpolate(values: Array, row: Indices, share: Array, bends: Array | None = None) -> Array:
    """Interpolate between rows, by straight lines or by parabolas.

    Args:
        values: (K, J) values of the rows.
        row: (N,) rows, from `locate`.
        share: (N,) positions, from `locate`.
        bends: (K, J), from `bend`; None for straight lines.

    Returns:
        (N, J) values.
    """
    found = np.empty((len(row), values.shape[1]))
    _compiled()["read"](values, _or_straight(bends, values), row, share, found)
    return found


def _or_straight(bends: Array | None, values: Array) -> Array:
    """The bends, or 0 for each of the values."""
    return np.broadcast_to(0.0, values.shape) if bends is None else bends


def interpolate_shifted(
    values: Array, times: Array, at: Array, late: Array, bends: Array | None = None
) -> Array:
    """Interpolate at times that differ between joints, by straight lines or by parabolas.

    Args:
        values: (K, J) values of the rows.
        times: (K,) times of the rows, s.
        at: (N,) times, s.
        late: (..., J) delay of each joint, s: it is read at `at` - `late`.
        bends: (K, J), from `bend`; None for straight lines.

    Returns:
        (..., N, J) values.
    """
    each = late.reshape(-1, values.shape[1])
    found = np.empty((len(each), len(at), values.shape[1]))
    _compiled()["read_late"](values, _or_straight(bends, values), times, at, each, found)
    return found.reshape(*late.shape[:-1], *found.shape[1:])


def hold_integral(values: Array, sums: Array, times: Array, at: Array) -> Array:
    """Integrate piecewise constant values from the first row to given times.

    Args:
        values: (K, J) values, each in force from its time to the next.
        sums: (K + 1, J) integral at the time of each row, and far after the last one.
        times: (K,) times of the rows, s.
        at: (N,) times, s.

    Returns:
        (N, J) integral.
    """
    found = np.empty((len(at), values.shape[1]))
    _compiled()["integral"](values, sums, times, at, found)
    return found


def _last_row(times: Any, at: float, row: int) -> Any:
    """The last row at or before `at`, searched from `row` on; -1 if there is none."""
    for _ in range(_MAX_LINEAR_STEPS):
        if row >= 0 and times[row] > at:
            row -= 1
        elif row + 1 < len(times) and times[row + 1] <= at:
            row += 1
        else:
            return row
    return np.searchsorted(times, at, side="right") - 1


@cache
def _compiled() -> dict[str, Callable[..., None]]:
    """Compile the loops; the first call after an installation takes seconds and is cached on disk."""
    import numba
    from numba.extending import register_jitable

    register_jitable(_last_row)

    def rows_at(times: Any, at: Any, found: Any) -> None:
        row = 0
        for n in range(len(at)):
            row = _last_row(times, at[n], row)
            found[n] = max(row, 0)

    def between(times: Any, at: Any, found: Any, share: Any) -> None:
        row = 0
        for n in range(len(at)):
            row = _last_row(times, at[n], row)
            here = min(max(row, 0), len(times) - 2)
            found[n] = here
            share[n] = min(max((at[n] - times[here]) / (times[here + 1] - times[here]), 0.0), 1.0)

    def read(values: Any, bends: Any, row: Any, share: Any, found: Any) -> None:
        for n in range(len(row)):
            for j in range(values.shape[1]):
                early = values[row[n], j]
                rise = values[row[n] + 1, j] - early - (1.0 - share[n]) * bends[row[n], j]
                found[n, j] = early + share[n] * rise

    def read_late(values: Any, bends: Any, times: Any, at: Any, late: Any, found: Any) -> None:
        for b, j in np.ndindex(late.shape):
            row = 0
            for n in range(len(at)):
                when = at[n] - late[b, j]
                row = _last_row(times, when, row)
                here = min(max(row, 0), len(times) - 2)
                share = min(max((when - times[here]) / (times[here + 1] - times[here]), 0.0), 1.0)
                early = values[here, j]
                rise = values[here + 1, j] - early - (1.0 - share) * bends[here, j]
                found[b, n, j] = early + share * rise

    def integral(values: Any, sums: Any, times: Any, at: Any, found: Any) -> None:
        row = 0
        for n in range(len(at)):
            row = _last_row(times, at[n], row)
            here = max(row, 0)
            for j in range(values.shape[1]):
                found[n, j] = sums[here, j] + values[here, j] * (at[n] - times[here])

    one, two = (numba.types.Array(numba.float64, d, "A", readonly=True) for d in (1, 2))
    rows, out = numba.types.Array(numba.intp, 1, "A", readonly=True), numba.float64[:, ::1]
    kinds: dict[Callable[..., None], tuple[Any, ...]] = {
        rows_at: (one, one, numba.intp[::1]),
        between: (one, one, numba.intp[::1], numba.float64[::1]),
        read: (two, two, rows, one, out),
        read_late: (two, two, one, one, two, numba.float64[:, :, ::1]),
        integral: (two, two, one, one, out),
    }
    compiled: Any = numba.njit
    return {loop.__name__: compiled(numba.void(*types), cache=True)(loop) for loop, types in kinds.items()}

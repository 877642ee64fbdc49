"""Recurrences along the rows of a series: lag, backlash, Bouc-Wen hysteresis and rate limit.

Each step is written once, for numbers and arrays. A running model takes one step at a time. Series
of rows run as compiled loops: one Python step per row would take most of the time of an
identification.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np


def backlash_step(follows: Any, seen: Any, gap: Any) -> Any:
    """Advance the output of a gap.

        y = clip(y_before, x - gap, x + gap)

    Args:
        follows: output y of the step before.
        seen: input x.
        gap: half width of the gap, in the unit of the input.

    Returns:
        The output y.
    """
    return np.minimum(np.maximum(follows, seen - gap), seen + gap)


def bouc_wen_step(z: Any, way: Any, beta: Any) -> Any:
    """Advance the state of a Bouc-Wen hysteresis.

        dz = w (1 - (beta + (1 - beta) sign(z w)) |z|)

    Args:
        z: state, -1 to 1.
        way: displacement w over the step, in units of the reach.
        beta: shape, 0 to 1.

    Returns:
        The new state, -1 to 1.
    """
    # beta + (1 - beta) sign(z w) is 1 while loading, and 1 - 2 (1 - beta) while unloading
    back = z * way < 0.0
    z = z + way * (1.0 - (1.0 - 2.0 * (1.0 - beta) * back) * np.abs(z))
    return np.minimum(np.maximum(z, -1.0), 1.0)


def rate_limit_step(given: Any, before: Any, slope: Any, now: Any, age: Any, dt: Any, rate: Any) -> Any:
    """Advance a rate limiter that follows a torque.

    Args:
        given: N m, output of the step before.
        before: N m, input of the step before.
        slope: N m/s, slope of the input in the step before.
        now: N m, input.
        age: s, time since the command in force arrived; until then the input kept its slope.
        dt: s, duration of the step.
        rate: N m/s, limit.

    Returns:
        The output, and the slope of the input.
    """
    # Two parts: dt - new with the earlier slope, then `new` that ends at `now`. Without a new
    # command
    # within the step, the input is a ramp from `before` to `now`.
    new = np.minimum(age, dt)
    midway = new < dt
    slope = midway * slope + (1 - midway) * ((now - before) / dt)
    given = _chase_target(given, before, slope, dt - new, rate)
    return _chase_target(given, now - slope * new, slope, new, rate), slope


def _chase_target(given: Any, target: Any, slope: Any, time: Any, rate: Any) -> Any:
    """Follow a target that moves with `slope` for `time`, at `rate` at most."""
    # The gap |given - target| closes at rate + side slope. Once it is closed, the output moves with
    # the target, as far as the limit allows.
    ahead = given - target
    side = np.sign(ahead)
    nearing = np.maximum(rate + side * slope, 1e-12)
    chased = np.minimum(np.abs(ahead) / nearing, time)
    return given - side * rate * chased + np.minimum(np.maximum(slope, -rate), rate) * (time - chased)


def lag_series(x: Any, start: Any, gone: Any) -> Any:
    """Apply a first-order lag along the rows of a series.

        y = y_before - gone (x - y_before)

    Args:
        x: input, constant over each step, (..., N, J).
        start: where a stretch starts at rest, broadcast to (..., N, J).
        gone: exp(-dt / T) - 1 of each step, broadcast to (..., N, J).

    Returns:
        Output, (..., N, J).
    """
    return _run_loop(_compiled_loops()["lag_loop"], (x, start, gone), ())


def backlash_series(seen: Any, start: Any, gap: Any) -> Any:
    """Apply `backlash_step` along the rows of a series.

    Args:
        seen: input, (..., N, J).
        start: where a stretch starts at rest, broadcast to (..., N, J).
        gap: half width of the gap, (J,) or (..., 1, J).

    Returns:
        Output, (..., N, J).
    """
    return _run_loop(_compiled_loops()["backlash_loop"], (seen, start), (gap,))


def bouc_wen_series(q: Any, start: Any, reach: Any, beta: Any) -> Any:
    """Apply `bouc_wen_step` along the rows of a series.

    Args:
        q: rad, positions, (..., N, J).
        start: where a stretch starts at rest.
        reach: rad, (J,) or (..., 1, J).
        beta: shape, (J,) or (..., 1, J).

    Returns:
        State z, (..., N, J).
    """
    return _run_loop(_compiled_loops()["bouc_wen_loop"], (q, start), (reach, beta))


def rate_limit_series(torque: Any, age: Any, dt: Any, start: Any, rate: Any) -> Any:
    """Apply `rate_limit_step` along the rows of a series.

    Args:
        torque: N m, input, (..., N, J).
        age: s, time since the command in force arrived.
        dt: s, duration of each step.
        start: where a stretch starts at rest.
        rate: N m/s, limit, (J,) or (..., 1, J).

    Returns:
        N m, output, (..., N, J).
    """
    return _run_loop(_compiled_loops()["rate_limit_loop"], (torque, age, dt, start), (rate,))


def _run_loop(loop: Callable[..., Any], rows: tuple[Any, ...], numbers: tuple[Any, ...]) -> Any:
    """Broadcast rows and parameters, flatten leading axes, and run a loop over the rows."""
    numbers = tuple(map(np.atleast_2d, numbers))
    shape = np.broadcast_shapes(*map(np.shape, (*rows, *numbers)))
    out = np.empty(shape)
    series = [np.broadcast_to(one, shape).reshape(-1, *shape[-2:]) for one in rows]
    flat = [np.broadcast_to(one, (*shape[:-2], 1, shape[-1])).reshape(-1, shape[-1]) for one in numbers]
    loop(*series, *flat, out.reshape(-1, *shape[-2:]))
    return out


@cache
def _compiled_loops() -> dict[str, Callable[..., Any]]:
    """Compile the loops; Numba caches them on disk.

    The first call after an installation takes seconds. They are no universal functions: Numba keeps
    those in two files, which several compiling processes corrupt.
    """
    import numba  # takes time and memory that a running model need not spend
    from numba.extending import register_jitable

    for step in (backlash_step, bouc_wen_step, _chase_target, rate_limit_step):
        register_jitable(step)

    def lag_loop(x: Any, start: Any, gone: Any, out: Any) -> None:
        for b in range(x.shape[0]):
            out[b, 0] = x[b, 0]
            for n in range(1, x.shape[1]):
                for j in range(x.shape[2]):
                    before = x[b, n, j] if start[b, n, j] else out[b, n - 1, j]
                    out[b, n, j] = before - gone[b, n, j] * (x[b, n, j] - before)

    def backlash_loop(seen: Any, start: Any, gap: Any, out: Any) -> None:
        for b, j in np.ndindex(gap.shape):
            follows = seen[b, 0, j]
            for n in range(seen.shape[1]):
                follows = (
                    seen[b, n, j] if start[b, n, j] else backlash_step(follows, seen[b, n, j], gap[b, j])
                )
                out[b, n, j] = follows

    def bouc_wen_loop(q: Any, start: Any, reach: Any, beta: Any, out: Any) -> None:
        for b, j in np.ndindex(reach.shape):
            z = 0.0
            for n in range(q.shape[1]):
                fresh = n == 0 or start[b, n, j]
                z = (
                    0.0
                    if fresh
                    else bouc_wen_step(z, (q[b, n, j] - q[b, n - 1, j]) / reach[b, j], beta[b, j])
                )
                out[b, n, j] = z

    def rate_limit_loop(torque: Any, age: Any, dt: Any, start: Any, rate: Any, out: Any) -> None:
        for b, j in np.ndindex(rate.shape):
            given, slope = torque[b, 0, j], 0.0
            for n in range(torque.shape[1]):
                now = torque[b, n, j]
                if n == 0 or start[b, n, j]:
                    given, slope = now, 0.0
                else:
                    before = torque[b, n - 1, j]
                    given, slope = rate_limit_step(
                        given, before, slope, now, age[b, n, j], dt[b, n, j], rate[b, j]
                    )
                out[b, n, j] = given

    rows, on = (numba.types.Array(kind, 3, "A", readonly=True) for kind in (numba.float64, numba.boolean))
    number, out = numba.types.Array(numba.float64, 2, "A", readonly=True), numba.float64[:, :, ::1]
    kinds = {
        lag_loop: (rows, on, rows, out),
        backlash_loop: (rows, on, number, out),
        bouc_wen_loop: (rows, on, number, number, out),
        rate_limit_loop: (rows, rows, rows, on, number, out),
    }
    compiled: Any = numba.njit
    return {loop.__name__: compiled(numba.void(*types), cache=True)(loop) for loop, types in kinds.items()}

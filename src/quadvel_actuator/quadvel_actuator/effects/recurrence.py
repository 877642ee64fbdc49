"""The steps of laws whose next value hangs on the one before in no way that linear algebra solves: play, bristles, chase.

A step is written once, of numbers or of arrays. A running model takes one at a time; whole series of rows take them all
as compiled loops, since as many steps of Python as there are rows are most of an identification's time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np


def backlash_step(follows: Any, seen: Any, gap: Any) -> Any:
    """What follows `seen` through a gap of +-`gap`."""
    return np.minimum(np.maximum(follows, seen - gap), seen + gap)


def bouc_wen_step(z: Any, way: Any, beta: Any) -> Any:
    """The bristles' bending (-1 to 1) after a `way` in units of their reach, by Bouc-Wen's law."""
    back = z * way < 0.0
    z = z + way * (1.0 - (1.0 - 2.0 * (1.0 - beta) * back) * np.abs(z))
    return np.minimum(np.maximum(z, -1.0), 1.0)


def rate_limit_step(given: Any, before: Any, slope: Any, now: Any, age: Any, dt: Any, rate: Any) -> Any:
    """What chases a torque at `rate` at most over `dt`, and that torque's slope; it went from `before` to `now`.

    Until a new command came, `age` ago, the torque went on with the slope that it had.
    """
    new = np.minimum(age, dt)
    midway = new < dt
    slope = midway * slope + (1 - midway) * ((now - before) / dt)
    given = _nearer(given, before, slope, dt - new, rate)
    return _nearer(given, now - slope * new, slope, new, rate), slope


def _nearer(given: Any, target: Any, slope: Any, time: Any, rate: Any) -> Any:
    """Where `given` comes in `time` at `rate` at most after a target that moves evenly, by `slope`."""
    ahead = given - target
    side = np.sign(ahead)
    nearing = np.maximum(rate + side * slope, 1e-12)
    chased = np.minimum(np.abs(ahead) / nearing, time)
    return given - side * rate * chased + np.minimum(np.maximum(slope, -rate), rate) * (time - chased)


def backlash_series(seen: Any, start: Any, gap: Any) -> Any:
    """`play` along the rows of `seen` (..., N, J), from rest where a stretch starts; `gap` (..., 1, J) or less."""
    return _along(_compiled()["played"], (seen, start), (gap,))


def bouc_wen_series(q: Any, start: Any, reach: Any, beta: Any) -> Any:
    """`bend` along the rows of `q` (..., N, J) rad."""
    return _along(_compiled()["bent"], (q, start), (reach, beta))


def rate_limit_series(torque: Any, age: Any, dt: Any, start: Any, rate: Any) -> Any:
    """`chase` along the rows of `torque` (..., N, J)."""
    return _along(_compiled()["chased"], (torque, age, dt, start), (rate,))


def _along(loop: Callable[..., Any], rows: tuple[Any, ...], numbers: tuple[Any, ...]) -> Any:
    """A loop over the last axis but one of `rows`; `numbers` have one row, or none of their own."""
    numbers = tuple(map(np.atleast_2d, numbers))
    shape = np.broadcast_shapes(*map(np.shape, (*rows, *numbers)))
    out = np.empty(shape)
    series = [np.broadcast_to(one, shape).reshape(-1, *shape[-2:]) for one in rows]
    flat = [np.broadcast_to(one, (*shape[:-2], 1, shape[-1])).reshape(-1, shape[-1]) for one in numbers]
    loop(*series, *flat, out.reshape(-1, *shape[-2:]))
    return out


@cache
def _compiled() -> dict[str, Callable[..., Any]]:
    """The loops, by name; compiled at the first call after an installation, which takes some seconds, and kept on disk.

    Not as universal functions, which Numba keeps in two files that break each other where several processes compile at once.
    """
    import numba  # takes time and memory that a running model need not spend
    from numba.extending import register_jitable

    for step in (backlash_step, bouc_wen_step, _nearer, rate_limit_step):
        register_jitable(step)

    def played(seen: Any, start: Any, gap: Any, out: Any) -> None:
        for b, j in np.ndindex(gap.shape):
            follows = seen[b, 0, j]
            for n in range(seen.shape[1]):
                follows = (
                    seen[b, n, j] if start[b, n, j] else backlash_step(follows, seen[b, n, j], gap[b, j])
                )
                out[b, n, j] = follows

    def bent(q: Any, start: Any, reach: Any, beta: Any, out: Any) -> None:
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

    def chased(torque: Any, age: Any, dt: Any, start: Any, rate: Any, out: Any) -> None:
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
        played: (rows, on, number, out),
        bent: (rows, on, number, number, out),
        chased: (rows, rows, rows, on, number, out),
    }
    compiled: Any = numba.njit
    return {loop.__name__: compiled(numba.void(*types), cache=True)(loop) for loop, types in kinds.items()}

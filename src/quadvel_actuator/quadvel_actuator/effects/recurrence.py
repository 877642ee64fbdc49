"""The steps of laws whose next value hangs on the one before in no way that linear algebra solves: play, bristles, chase.

A step is written once, of numbers or of arrays. A running model takes one at a time; whole series of rows take them all
as compiled loops, since as many steps of Python as there are rows are most of an identification's time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np


def play(follows: Any, seen: Any, gap: Any) -> Any:
    """What follows `seen` through a gap of +-`gap`."""
    return np.minimum(np.maximum(follows, seen - gap), seen + gap)


def bend(z: Any, way: Any, beta: Any) -> Any:
    """The bristles' bending (-1 to 1) after a `way` in units of their reach, by Bouc-Wen's law."""
    back = z * way < 0.0
    z = z + way * (1.0 - (1.0 - 2.0 * (1.0 - beta) * back) * np.abs(z))
    return np.minimum(np.maximum(z, -1.0), 1.0)


def chase(given: Any, before: Any, slope: Any, now: Any, age: Any, dt: Any, rate: Any) -> Any:
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


def played(seen: Any, start: Any, gap: Any) -> Any:
    """`play` along the rows of `seen` (..., N, J), from rest where a stretch starts; `gap` (..., 1, J) or less."""
    return _along(_compiled()["played"], (seen, start), (gap,))


def bent(q: Any, start: Any, reach: Any, beta: Any) -> Any:
    """`bend` along the rows of `q` (..., N, J) rad."""
    return _along(_compiled()["bent"], (q, start), (reach, beta))


def chased(torque: Any, age: Any, dt: Any, start: Any, rate: Any) -> Any:
    """`chase` along the rows of `torque` (..., N, J)."""
    return _along(_compiled()["chased"], (torque, age, dt, start), (rate,))


def _along(loop: Callable[..., Any], rows: tuple[Any, ...], numbers: tuple[Any, ...]) -> Any:
    """A loop over the last axis but one of `rows`; `numbers` have no rows of their own."""
    axes = [(-2,)] * len(rows) + [()] * len(numbers) + [(-2,)]
    flat = (one[..., 0, :] if np.ndim(one) > 1 else one for one in map(np.asarray, numbers))
    return loop(*rows, *flat, axes=axes)


@cache
def _compiled() -> dict[str, Callable[..., Any]]:
    """The loops, by name; compiled at the first call after an installation, which takes some seconds, and kept on disk."""
    import numba  # takes time and memory that a running model need not spend
    from numba.extending import register_jitable

    for step in (play, bend, _nearer, chase):
        register_jitable(step)

    def played(seen: Any, start: Any, gap: Any, out: Any) -> None:
        follows = seen[0]
        for n in range(len(seen)):
            follows = seen[n] if start[n] else play(follows, seen[n], gap)
            out[n] = follows

    def bent(q: Any, start: Any, reach: Any, beta: Any, out: Any) -> None:
        z = 0.0
        for n in range(len(q)):
            z = 0.0 if n == 0 or start[n] else bend(z, (q[n] - q[n - 1]) / reach, beta)
            out[n] = z

    def chased(torque: Any, age: Any, dt: Any, start: Any, rate: Any, out: Any) -> None:
        given, slope = torque[0], 0.0
        for n in range(len(torque)):
            if n == 0 or start[n]:
                given, slope = torque[n], 0.0
            else:
                given, slope = chase(given, torque[n - 1], slope, torque[n], age[n], dt[n], rate)
            out[n] = given

    rows, on, number = "f8[:]", "b1[:]", "f8"
    compiled: Any = numba.guvectorize
    kinds = {
        played: ((rows, on, number, rows), "(n),(n),()->(n)"),
        bent: ((rows, on, number, number, rows), "(n),(n),(),()->(n)"),
        chased: ((rows, rows, rows, on, number, rows), "(n),(n),(n),(n),()->(n)"),
    }
    return {
        loop.__name__: compiled([f"void({','.join(types)})"], shapes, nopython=True, cache=True)(loop)
        for loop, (types, shapes) in kinds.items()
    }

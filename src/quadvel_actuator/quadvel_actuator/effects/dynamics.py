"""Laws of time: lags and filters within the drive, inertia, stamps that are off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from scipy.linalg.blas import dtbsv

from .base import (
    DRIVE,
    JOINT,
    AddedLaw,
    Array,
    ErrorLaw,
    Errors,
    Memory,
    MemoryLaw,
    Parameter,
    Params,
    Stage,
    Start,
    View,
    one_of,
)

_FAST = "chirps up to 20 Hz and steps, small enough to stay below every bound"
_TIME = Parameter("T", "s", 0.0002, 0.1, 0.004)


def lag(before: Array, x: Array, dt: Any, time: Array) -> Array:
    """One step of a first-order lag: from `before` towards `x`, which is held for `dt`."""
    return before - np.expm1(-dt / time) * (x - before)


def _evenly(before: Array, x: Array, dt: Any, time: Array) -> Array:
    """What, held for `dt`, moves a first-order lag as far as a signal that goes evenly from `before` to `x`."""
    return x + (x - before) * (1.0 / np.expm1(dt / time) - time / dt)


def _row_before(x: Array, s: Any) -> Array:
    """Of the rows of `x` (..., N, J) each the one before it; the first of a stretch its own."""
    return np.where(s.start, x, np.concatenate([x[..., :1, :], x[..., :-1, :]], axis=-2))


def lagged(x: Array, s: Any, time: Array) -> Array:
    """First-order lag of the rows of `x` (..., N, J), each value held over its step, beginning at rest.

    y[k] = d[k] y[k-1] + (1 - d[k]) x[k], with d = 0 where a stretch begins, is a triangular system of two bands; all
    joints and the whole batch are solved as one.
    """
    gone = np.where(s.start, -1.0, np.expm1(-s.dt / time))  # d - 1
    gone[..., 0, :] = -1.0
    gone, x = (one.swapaxes(-1, -2) for one in np.broadcast_arrays(gone, x))  # (..., J, N)
    band = np.ones((2, gone.size), order="F")
    band[1, :-1] = -1.0 - gone.reshape(-1)[1:]
    given = (-gone * x).reshape(-1)
    out: Array = dtbsv(1, band, given, lower=1, diag=1, overwrite_x=1).reshape(gone.shape)
    return out.swapaxes(-1, -2)


class FirstOrderLag(MemoryLaw):
    """T dtau/dt = tau* - tau"""

    name = "first_order_lag"
    stage = Stage.DYNAMICS
    parameters = (_TIME,)
    signal = "tau@history"
    shifts = True
    motion = _FAST

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.007, 0.012, 0.025)]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (x,)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        given = lag(memory[0], x, dt, p["T"])
        return given, (given,)

    def series(self, x: Any, s: Any, p: Params) -> Any:
        """A new command may come in the middle of a step: until then the torque before is followed."""
        before = _row_before(x, s)
        late = -np.expm1(-np.minimum(s.age, s.dt) / p["T"]) / -np.expm1(-s.dt / p["T"])
        return lagged(before + late * (x - before), s, p["T"])


class VelocityFilter(MemoryLaw):
    """The drive damps a velocity that it filters: T d(dq_f)/dt = dq - dq_f"""

    name = "velocity_filter"
    stage = Stage.ERRORS
    parameters = (_TIME,)
    inputs = ("dq",)
    signal = "dq@history"
    shifts = True
    motion = _FAST

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.008, 0.015, 0.03)]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return u[0], u[0]

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        filtered, before = memory
        filtered = lag(filtered, _evenly(before, u[0], dt, p["T"]), dt, p["T"])
        return (x[0], x[1] + u[0] - filtered), (filtered, u[0])

    def series(self, x: Any, s: Any, p: Params) -> Any:
        even = _evenly(_row_before(s.dq, s), s.dq, s.dt, p["T"])
        return x[0], x[1] + s.dq - lagged(even, s, p["T"])


_SLOPES = "ddq", "ddq_sharp", "ddq_smooth"


@attrs.frozen(eq=False)
class Armature(AddedLaw):
    """-J ddq; `of` says how the acceleration is taken: a short slope of dq, sharp or not, or a smooth one where dq is noisy"""

    name = "armature"
    parameters = (Parameter("J", "kg m^2", 0.0, 1.0, 0.005),)
    linear = ("J",)
    of_drive = False
    signal = "ddq"
    shifts = True
    motion = _FAST
    of: str = attrs.field(default="ddq", validator=one_of(*_SLOPES))

    @classmethod
    def variants(cls, about: Any) -> Sequence[Armature]:
        return tuple(cls(of=of, at=at) for of in _SLOPES for at in (DRIVE, JOINT))

    @property
    def alternatives(self) -> tuple[Armature, ...]:
        every = (attrs.evolve(self, of=of, at=at) for of in _SLOPES for at in (DRIVE, JOINT))
        return tuple(one for one in every if (one.of, one.at) != (self.of, self.at))

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["J"] * getattr(s, self.of)


@attrs.frozen(eq=False)
class TimestampSkew(ErrorLaw):
    """The drive knew `channel`, q or dq, as its rows have it `late` s before; negative: as they have it only later

    A position stamped on some joints early is no velocity stamped late there: the command stays where it is. To the
    model that runs it is a signal that the drive knows late; one known early is a fault of the record alone.
    """

    name = "timestamp_skew"
    parameters = (Parameter("late", "s", -0.03, 0.03, 0.002),)
    shifts = True
    motion = _FAST
    channel: str = attrs.field(default="dq", validator=one_of("dq", "q"))

    @property
    def signal(self) -> str:  # type: ignore[override]
        return f"{self.channel}@history"

    @property
    def confounded_with_gain(self) -> bool:  # type: ignore[override]
        """A position that is off on all joints is two other delays."""
        return self.channel == "q"

    @classmethod
    def variants(cls, about: Any) -> Sequence[TimestampSkew]:
        return cls("dq"), cls("q")

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [
            {"late": late}
            for late in (-0.012, -0.008, -0.005, -0.003, -0.0015, 0.0015, 0.003, 0.005, 0.008, 0.012)
        ]

    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        shifted = s.shifted(self.channel, p["late"])
        return (e[0] + s.q - shifted, e[1]) if self.channel == "q" else (e[0], e[1] + s.dq - shifted)


LAWS = (FirstOrderLag, VelocityFilter, Armature, TimestampSkew)

"""Laws of time: lags and filters within the drive, inertia, stamps that are off."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import attrs
import numpy as np
from scipy.signal import lfilter

from .base import AddedLaw, Array, ErrorLaw, Errors, Memory, MemoryLaw, Parameter, Params, Stage, Start, View

_FAST = "chirps up to 20 Hz and steps, small enough to stay below every bound"
_REGULAR = 0.2  # a spacing within this share of the usual one counts as regular


def _lagged(x: Array, s: Any, time: Array) -> Array:
    """First-order lag of the rows of `x`, each value held over its step, beginning at rest."""
    dt = s.dt[:, 0]
    usual = float(np.median(dt))
    share = -np.expm1(-usual / time)
    x, share = (
        np.broadcast_arrays(x, share) if np.ndim(share) > 1 else (x, np.broadcast_to(share, x.shape[-1:]))
    )
    edges = [*np.flatnonzero(s.start[:, 0]).tolist(), len(dt)]
    out = np.empty(x.shape)
    lead = np.reshape(x, (-1, *x.shape[-2:]))
    shares = np.broadcast_to(share, x.shape).reshape(-1, *x.shape[-2:])[:, 0]
    flat = out.reshape(lead.shape)
    for first, last in pairwise(edges):
        for b in range(len(lead)):
            for j in range(lead.shape[-1]):
                a = shares[b, j]
                begin = lead[b, first, j]
                flat[b, first:last, j] = lfilter(
                    [a], [1.0, a - 1.0], lead[b, first:last, j], zi=[begin * (1.0 - a)]
                )[0]
    return out


def _is_regular(s: Any) -> bool:
    """Are the spacings even enough, but for a few, that one share of the way stands for every step?"""
    dt = s.dt[:, 0]
    return bool(np.quantile(np.abs(dt / np.median(dt) - 1.0), 0.95) < _REGULAR)


class FirstOrderLag(MemoryLaw):
    """T dtau/dt = tau* - tau"""

    name = "first_order_lag"
    stage = Stage.FLOW
    parameters = (Parameter("T", "s", 0.0002, 0.1, 0.004),)
    signal = "tau@history"
    shifts = True
    motion = _FAST

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.007, 0.012, 0.025)]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (x,)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        given = memory[0] - np.expm1(-dt / p["T"]) * (x - memory[0])
        return given, (given,)

    def series(self, x: Any, s: Any, p: Params) -> Any:
        return _lagged(x, s, p["T"]) if _is_regular(s) else super().series(x, s, p)


class VelocityFilter(MemoryLaw):
    """The drive damps a velocity that it filters: T d(dq_f)/dt = dq - dq_f"""

    name = "velocity_filter"
    stage = Stage.ERRORS
    parameters = (Parameter("T", "s", 0.0002, 0.1, 0.004),)
    inputs = ("dq",)
    signal = "dq@history"
    shifts = True
    motion = _FAST

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.008, 0.015, 0.03)]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (u[0],)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        filtered = memory[0] - np.expm1(-dt / p["T"]) * (u[0] - memory[0])
        return (x[0], x[1] + u[0] - filtered), (filtered,)

    def series(self, x: Any, s: Any, p: Params) -> Any:
        if not _is_regular(s):
            return super().series(x, s, p)
        return x[0], x[1] + s.dq - _lagged(s.dq, s, p["T"])


@attrs.frozen(eq=False)
class Armature(AddedLaw):
    """-J ddq; `of` says how the acceleration is taken: a short slope of dq, or a smooth one for noisy or sparse logs"""

    name = "armature"
    parameters = (Parameter("J", "kg m^2", 0.0, 1.0, 0.005),)
    linear = ("J",)
    signal = "ddq"
    shifts = True
    motion = _FAST
    of: str = "ddq"

    @classmethod
    def variants(cls, about: Any) -> Sequence[Armature]:
        return cls("ddq"), cls("ddq_smooth")

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["J"] * getattr(s, self.of)


class TimestampSkew(ErrorLaw):
    """The velocity was stamped `late` (s) after the position of the same row; negative: before it

    The same as a position stamped early, the delays being fitted. To the model that runs it is a velocity that the
    drive knows late; one known early is a fault of the record alone.
    """

    name = "timestamp_skew"
    parameters = (Parameter("late", "s", -0.03, 0.03, 0.002),)
    signal = "dq@history"
    shifts = True
    motion = _FAST

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [
            {"late": late}
            for late in (-0.012, -0.008, -0.005, -0.003, -0.0015, 0.0015, 0.003, 0.005, 0.008, 0.012)
        ]

    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        return e[0], e[1] + s.dq - s.shifted("dq", p["late"])


LAWS = (FirstOrderLag, VelocityFilter, Armature, TimestampSkew)

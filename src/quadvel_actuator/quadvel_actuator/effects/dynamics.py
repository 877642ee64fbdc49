"""Dynamic effects: lags and filters in the drive, rotor inertia, and time stamps that are off.

`base` defines the interface; in short: `s` holds signals (q in rad, dq in rad/s, dt in s), `p`
parameters. At stage ERRORS, `x` is the pair of errors of the PD law: q_des - q (rad) and
dq_des - dq (rad/s). At stage DYNAMICS it is the torque, N m. An `AddedEffect` returns the torque to
add, N m. A `MemoryEffect` reads the signals `u` that `inputs` names.

`recurrence` computes the filters step by step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from . import recurrence
from .base import (
    AddedEffect,
    ErrorEffect,
    Errors,
    Memory,
    MemoryEffect,
    Parameter,
    Params,
    Stage,
    View,
    one_of,
)

_TIME_CONSTANT = Parameter("T", "s", 0.0002, 0.1, 0.004)


def lag_step(before: Array, x: Array, dt: Any, time: Array) -> Array:
    """Advance a first-order lag T dy/dt = x - y by one step with x held.

        y(t + dt) = y + (1 - exp(-dt / T)) (x - y)

    Args:
        before: y at the start of the step.
        x: input, constant over the step.
        dt: s, duration of the step.
        time: s, time constant T.

    Returns:
        y at the end of the step.
    """
    return before - np.expm1(-dt / time) * (x - before)


def _ramp_equivalent_input(before: Array, x: Array, dt: Any, time: Array) -> Array:
    """Constant input that moves a first-order lag as far as a ramp from `before` to `x` does."""
    # Exact solution for u(t) = before + (x - before) t / dt:
    #     u_eq = x + (x - before) (1 / (exp(dt / T) - 1) - T / dt)
    return x + (x - before) * (1.0 / np.expm1(dt / time) - time / dt)


def _previous_row(x: Array, s: Any) -> Array:
    """Shift rows (..., N, J) by one; the first row of each stretch stays."""
    return np.where(s.start, x, np.concatenate([x[..., :1, :], x[..., :-1, :]], axis=-2))


def _decay(dt: Array, time: Array) -> Array:
    """Compute exp(-dt / T) - 1, (..., N, J) or (..., N, 1), once for equal time constants.

    Exponentials take long. Often all joints, or most members of a batch, share a time constant.
    """
    if np.ndim(time) and (time == time[..., :1]).all():
        time = time[..., :1]
    if np.ndim(time) < 3:
        return np.expm1(-dt / time)
    distinct, which = np.unique(time, axis=0, return_inverse=True)
    return np.expm1(-dt / distinct)[which.ravel()]


def lag_series(x: Array, s: Any, time: Array) -> Array:
    """Filter rows with a first-order lag, each value held over its step, from rest.

    Args:
        x: input, (..., N, J).
        s: signals with `dt` and `start`, (N, 1) each.
        time: s, time constant, (J,) or (..., 1, J).

    Returns:
        Filtered rows, (..., N, J).
    """
    filtered: Array = recurrence.lag_series(x, s.start, _decay(s.dt, time))
    return filtered


class FirstOrderLag(MemoryEffect):
    """First-order lag of the torque: T dtau/dt = tau* - tau."""

    name = "first_order_lag"
    stage = Stage.DYNAMICS
    parameters = (_TIME_CONSTANT,)

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (x,)

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        given = lag_step(memory[0], x, dt, p["T"])
        return given, (given,)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        """Apply the lag to a series, with commands that arrive within a step."""
        # A new command may arrive within a step, `age` (s) before its end. Until then the lag
        # follows the previous torque. Both parts together equal a constant input
        # before + w (x - before), with
        #     w = (1 - exp(-age / T)) / (1 - exp(-dt / T))
        before, gone = _previous_row(x, s), _decay(s.dt, p["T"])
        late = _decay(np.minimum(s.age, s.dt), p["T"]) / gone
        return recurrence.lag_series(before + late * (x - before), s.start, gone)


class VelocityFilter(MemoryEffect):
    """Low-pass filtered velocity in the damping term: T d(dq_f)/dt = dq - dq_f."""

    name = "velocity_filter"
    stage = Stage.ERRORS
    parameters = (_TIME_CONSTANT,)
    inputs = ("dq",)

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return u[0], u[0]

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        filtered, before = memory
        filtered = lag_step(filtered, _ramp_equivalent_input(before, u[0], dt, p["T"]), dt, p["T"])
        return (x[0], x[1] + u[0] - filtered), (filtered, u[0])

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        even = _ramp_equivalent_input(_previous_row(s.dq, s), s.dq, s.dt, p["T"])
        return x[0], x[1] + s.dq - lag_series(even, s, p["T"])


ACCELERATION_SIGNALS = "ddq", "ddq_sharp", "ddq_smooth"


@attrs.frozen(eq=False)
class Armature(AddedEffect):
    """Rotor inertia: -J ddq.

    `of` selects the acceleration: `ddq`, a short difference quotient of dq; `ddq_sharp`, a shorter
    one; `ddq_smooth`, a smooth one for noisy velocities.
    """

    name = "armature"
    parameters = (Parameter("J", "kg m^2", 0.0, 1.0, 0.005),)
    of: str = attrs.field(default="ddq", validator=one_of(*ACCELERATION_SIGNALS))

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["J"] * getattr(s, self.of)


@attrs.frozen(eq=False)
class TimestampSkew(ErrorEffect):
    """Time skew: `q` or `dq` reaches the drive `late` s later than its rows say.

    If `late` is negative, it arrives earlier. An early `q` on all joints equals a late `dq` with
    other delays. On some joints it does not, because the delays are common to all joints. In a
    running model, a late channel is a delay of the measurement. An early one is a fault of the log
    alone and is ignored.

    Attributes:
        channel: `dq` or `q`.
    """

    name = "timestamp_skew"
    parameters = (Parameter("late", "s", -0.03, 0.03, 0.002),)
    channel: str = attrs.field(default="dq", validator=one_of("dq", "q"))

    @override
    def errors(self, e: Errors, s: View, p: Params) -> Errors:
        shifted = s.shifted(self.channel, p["late"])
        return (e[0] + s.q - shifted, e[1]) if self.channel == "q" else (e[0], e[1] + s.dq - shifted)


EFFECTS = (FirstOrderLag, VelocityFilter, Armature, TimestampSkew)

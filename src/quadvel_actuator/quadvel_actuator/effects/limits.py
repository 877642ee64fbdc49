"""Limits on the torque and on its rate of change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from . import recurrence
from .base import EffectLaw, InitialGuess, Memory, MemoryLaw, Parameter, Params, Stage, TorqueLaw, View

_SATURATING_MOTION = "fast and large steps that ask for more torque than the drive gives"


class TorqueSaturation(TorqueLaw):
    """Constant torque limit: tau = clip(tau*, -limit, limit)."""

    name = "torque_saturation"
    stage = Stage.LIMIT
    parameters = (Parameter("limit", "N m", 0.1, 500.0, 10.0),)
    signal = "tau"
    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        shares = (0.75, 0.9, 0.96, 0.99, 0.997)
        seldom = [{"limit": share * np.abs(torque).max(axis=0)} for share in (0.8, 0.9, 0.97)]
        return [*({"limit": np.quantile(np.abs(torque), share, axis=0)} for share in shares), *seldom]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return np.clip(x, -p["limit"], p["limit"])


class TorqueSpeedLimit(TorqueLaw):
    """Speed-torque curve of a DC motor: the limit falls linearly with speed.

    |tau| <= stall (1 - v / no_load), within 0 and stall, v the speed along the torque
    """

    name = "torque_speed_limit"
    stage = Stage.LIMIT
    parameters = (
        Parameter("stall", "N m", 0.1, 500.0, 10.0),
        Parameter("no_load", "rad/s", 0.2, 300.0, 10.0),
    )
    signal = "dq"
    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        top = np.quantile(np.abs(s.dq), 0.98, axis=0)
        return [
            {"stall": np.quantile(np.abs(torque), share, axis=0) * over, "no_load": fast * top}
            for share, over in ((0.85, 1.0), (0.97, 1.0), (1.0, 1.0), (1.0, 1.4))
            for fast in (0.6, 0.9, 1.3, 2.0, 4.0)
        ]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]]:
        return TorqueSaturation(), {"limit": p["stall"]}

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        def bound(speed: Array) -> Array:
            return p["stall"] * np.clip(1.0 - speed / p["no_load"], 0.0, 1.0)

        return np.clip(x, -bound(-s.dq), bound(s.dq))


class SlewLimit(MemoryLaw):
    """Rate limit: |dtau/dt| <= rate.

    If a new command arrives within a step, the torque keeps its earlier slope until then.
    """

    name = "slew_limit"
    stage = Stage.DYNAMICS
    acts_between_rows = True
    inputs = ("age",)
    parameters = (Parameter("rate", "N m/s", 5.0, 50000.0, 300.0),)
    signal = "tau@history"
    shifts = True
    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        slope = np.abs(np.diff(torque, axis=0)) / s.dt[1:]
        # The last guess limits nothing, for joints without the effect.
        shares = (0.5, 0.7, 0.85, 0.94, 0.98, 0.992, 0.998, 1.0)
        return [{"rate": np.quantile(slope, share, axis=0) + 5.0} for share in shares]

    @override
    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return x, x, 0.0 * x

    @override
    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        given, before, slope = memory
        given, slope = recurrence.rate_limit_step(given, before, slope, x, u[0], dt, p["rate"])
        return given, (given, x, slope)

    @override
    def series(self, x: Any, s: Any, p: Params) -> Any:
        return recurrence.rate_limit_series(x, s.age, s.dt, s.start, p["rate"])


LAWS = (TorqueSaturation, TorqueSpeedLimit, SlewLimit)

"""Limits on the torque and on its rate of change.

`base` defines the interface; `recurrence` computes the rate limit step by step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from . import recurrence
from .base import Memory, MemoryEffect, Parameter, Params, Stage, TorqueEffect, View


class TorqueSaturation(TorqueEffect):
    """Constant torque limit: tau = clip(tau*, -limit, limit)."""

    name = "torque_saturation"
    stage = Stage.LIMIT
    parameters = (Parameter("limit", "N m", 0.1, 500.0, 10.0),)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return np.clip(x, -p["limit"], p["limit"])


class TorqueSpeedLimit(TorqueEffect):
    """Speed-torque curve of a DC motor: the limit falls linearly with speed.

    |tau| <= stall (1 - v / no_load), within 0 and stall, v the speed along the torque
    """

    name = "torque_speed_limit"
    stage = Stage.LIMIT
    parameters = (
        Parameter("stall", "N m", 0.1, 500.0, 10.0),
        Parameter("no_load", "rad/s", 0.2, 300.0, 10.0),
    )

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        def bound(speed: Array) -> Array:
            return p["stall"] * np.clip(1.0 - speed / p["no_load"], 0.0, 1.0)

        return np.clip(x, -bound(-s.dq), bound(s.dq))


class SlewLimit(MemoryEffect):
    """Rate limit: |dtau/dt| <= rate.

    If a new command arrives within a step, the input keeps the slope of the step before until then.
    """

    name = "slew_limit"
    stage = Stage.DYNAMICS
    inputs = ("age",)
    parameters = (Parameter("rate", "N m/s", 5.0, 50000.0, 300.0),)

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


EFFECTS = (TorqueSaturation, TorqueSpeedLimit, SlewLimit)

"""Bounds on the torque and on how fast it changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .base import Array, Memory, MemoryLaw, Parameter, Params, Stage, Start, TorqueLaw, View

_HARD = "fast and large steps that ask for more torque than the drive gives"


class TorqueSaturation(TorqueLaw):
    """tau* held to -limit..limit"""

    name = "torque_saturation"
    stage = Stage.LIMIT
    parameters = (Parameter("limit", "N m", 0.1, 500.0, 10.0),)
    signal = "tau"
    motion = _HARD

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"limit": np.quantile(np.abs(torque), share, axis=0)} for share in (0.75, 0.9, 0.96, 0.99)]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return np.clip(x, -p["limit"], p["limit"])


class TorqueSpeedLimit(TorqueLaw):
    """A bound `stall` that falls from the speed `v_c` in the direction of motion, to nothing at `v_c + fall`"""

    name = "torque_speed_limit"
    stage = Stage.LIMIT
    parameters = (
        Parameter("stall", "N m", 0.1, 500.0, 10.0),
        Parameter("v_c", "rad/s", 0.0, 60.0, 2.0),
        Parameter("fall", "rad/s", 0.1, 200.0, 10.0),
    )
    signal = "dq"
    motion = _HARD

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        top = np.quantile(np.abs(s.dq), 0.98, axis=0)
        return [
            {"stall": np.quantile(np.abs(torque), share, axis=0), "v_c": corner * top, "fall": fall * top}
            for share in (0.85, 0.97, 1.0)
            for corner in (0.0, 0.4)
            for fall in (0.5, 1.0, 2.0, 4.0)
        ]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        def bound(speed: Array) -> Array:
            share = 1.0 - np.maximum(speed - p["v_c"], 0.0) / p["fall"]
            return p["stall"] * np.maximum(share, 0.0)

        return np.clip(x, -bound(-s.dq), bound(s.dq))


class SlewLimit(MemoryLaw):
    """|dtau/dt| held to `rate`"""

    name = "slew_limit"
    stage = Stage.FLOW
    parameters = (Parameter("rate", "N m/s", 5.0, 50000.0, 300.0),)
    signal = "tau@history"
    shifts = True
    motion = _HARD

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        slope = np.abs(np.diff(torque, axis=0)) / s.dt[1:]
        return [{"rate": np.quantile(slope, share, axis=0) + 5.0} for share in (0.5, 0.7, 0.85, 0.94, 0.98)]

    def rest(self, x: Any, u: Sequence[Array], p: Params) -> Memory:
        return (x,)

    def advance(self, x: Any, u: Sequence[Array], dt: Any, p: Params, memory: Memory) -> tuple[Any, Memory]:
        reach = p["rate"] * dt
        given = memory[0] + np.minimum(np.maximum(x - memory[0], -reach), reach)
        return given, (given,)


LAWS = (TorqueSaturation, TorqueSpeedLimit, SlewLimit)

"""Candidates of limits on the torque and on its rate of change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import limits
from quadvel_description.arrays import Array

from ...data.signals import Signals
from ...model.effect_candidate import EffectCandidate, InitialGuess

_SATURATING_MOTION = "fast and large steps that ask for more torque than the drive gives"


class SaturationCandidate(EffectCandidate):
    """Constant torque limit."""

    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        shares = (0.75, 0.9, 0.96, 0.99, 0.997)
        seldom = [{"limit": share * np.abs(torque).max(axis=0)} for share in (0.8, 0.9, 0.97)]
        return [*({"limit": np.quantile(np.abs(torque), share, axis=0)} for share in shares), *seldom]


class SpeedLimitCandidate(EffectCandidate):
    """Speed-torque curve of a DC motor."""

    signal = "dq"
    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        top = np.quantile(np.abs(s.dq), 0.98, axis=0)
        return [
            {"stall": np.quantile(np.abs(torque), share, axis=0) * over, "no_load": fast * top}
            for share, over in ((0.85, 1.0), (0.97, 1.0), (1.0, 1.0), (1.0, 1.4))
            for fast in (0.6, 0.9, 1.3, 2.0, 4.0)
        ]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectCandidate, Mapping[str, Array]]:
        return SaturationCandidate(limits.TorqueSaturation()), {"limit": p["stall"]}


class SlewLimitCandidate(EffectCandidate):
    """Rate limit."""

    signal = "tau@history"
    shifts = True
    acts_between_rows = True
    motion = _SATURATING_MOTION

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        slope = np.abs(np.diff(torque, axis=0)) / s.dt[1:]
        # The last guess limits nothing, for joints without the effect.
        shares = (0.5, 0.7, 0.85, 0.94, 0.98, 0.992, 0.998, 1.0)
        return [{"rate": np.quantile(slope, share, axis=0) + 5.0} for share in shares]


CANDIDATES = {
    limits.TorqueSaturation: SaturationCandidate,
    limits.TorqueSpeedLimit: SpeedLimitCandidate,
    limits.SlewLimit: SlewLimitCandidate,
}

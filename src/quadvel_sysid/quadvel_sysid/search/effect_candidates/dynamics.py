"""Candidates of dynamic effects: lags, rotor inertia and time skew."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
from typing_extensions import override

from quadvel_actuator.effects import DRIVE, JOINT, EffectModel
from quadvel_actuator.effects.dynamics import (
    ACCELERATION_SIGNALS,
    Armature,
    FirstOrderLag,
    TimestampSkew,
    VelocityFilter,
)
from quadvel_description.arrays import Array

from ...data.signals import Signals
from ...model.effect_candidate import EffectCandidate, FormContext, InitialGuess

_FAST_MOTION = "chirps up to 20 Hz and steps, small enough to stay below every bound"


class LagCandidate(EffectCandidate):
    """First-order lag of the torque."""

    signal = "tau@history"
    shifts = True
    motion = _FAST_MOTION

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.007, 0.012, 0.025)]


class VelocityFilterCandidate(EffectCandidate):
    """Low-pass filtered velocity."""

    signal = "dq@history"
    shifts = True
    motion = _FAST_MOTION

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"T": time} for time in (0.001, 0.002, 0.004, 0.008, 0.015, 0.03)]


@attrs.frozen(eq=False)
class ArmatureCandidate(EffectCandidate):
    """Rotor inertia, with each of the accelerations."""

    effect: Armature
    linear = ("J",)
    signal = "ddq"
    shifts = True
    motion = _FAST_MOTION

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[ArmatureCandidate]:
        return tuple(cls(Armature(of=of, at=at)) for of in ACCELERATION_SIGNALS for at in (DRIVE, JOINT))

    @property
    @override
    def indistinguishable_forms(self) -> tuple[EffectCandidate, ...]:
        own = self.effect.of, self.effect.at
        every = ((of, at) for of in ACCELERATION_SIGNALS for at in (DRIVE, JOINT))
        return tuple(ArmatureCandidate(Armature(of=of, at=at)) for of, at in every if (of, at) != own)


@attrs.frozen(eq=False)
class TimestampSkewCandidate(EffectCandidate):
    """Time skew of velocities or positions."""

    effect: TimestampSkew
    shifts = True
    motion = _FAST_MOTION

    @property
    @override
    def signal(self) -> str:
        return f"{self.effect.channel}@history"

    @property
    @override
    def confounded_with_gain(self) -> bool:
        """Whether skew on all joints equals two other delays, which holds for positions."""
        return self.effect.channel == "q"

    @classmethod
    @override
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[TimestampSkewCandidate]:
        return cls(TimestampSkew("dq")), cls(TimestampSkew("q"))

    @override
    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [
            {"late": late}
            for late in (-0.012, -0.008, -0.005, -0.003, -0.0015, 0.0015, 0.003, 0.005, 0.008, 0.012)
        ]


CANDIDATES = {
    FirstOrderLag: LagCandidate,
    VelocityFilter: VelocityFilterCandidate,
    Armature: ArmatureCandidate,
    TimestampSkew: TimestampSkewCandidate,
}

"""Candidates of dynamic effects: lags, rotor inertia and time skew."""

from __future__ import annotations

import attrs
from typing_extensions import override

from quadvel_actuator.effects import dynamics

from ...model.effect_candidate import EffectCandidate

_FAST_MOTION = "chirps up to 20 Hz and steps, small enough to stay below every bound"


class LagCandidate(EffectCandidate):
    """First-order lag of the torque."""

    signal = "tau@history"
    shifts = True
    motion = _FAST_MOTION
    guesses = tuple({"T": time} for time in (0.001, 0.002, 0.004, 0.007, 0.012, 0.025))


class VelocityFilterCandidate(EffectCandidate):
    """Low-pass filtered velocity."""

    signal = "dq@history"
    shifts = True
    motion = _FAST_MOTION
    guesses = tuple({"T": time} for time in (0.001, 0.002, 0.004, 0.008, 0.015, 0.03))


@attrs.frozen(eq=False)
class ArmatureCandidate(EffectCandidate):
    """Rotor inertia, with each of the accelerations."""

    effect: dynamics.Armature
    linear = ("J",)
    signal = "ddq"
    shifts = True
    motion = _FAST_MOTION
    settings_to_try = tuple({"of": of} for of in dynamics.ACCELERATION_SIGNALS)

    @property
    @override
    def indistinguishable_forms(self) -> tuple[EffectCandidate, ...]:
        own = self.effect.of, self.at
        every = ((of, at) for of in dynamics.ACCELERATION_SIGNALS for at in self.places)
        return tuple(
            ArmatureCandidate(dynamics.Armature(of=of, at=at)) for of, at in every if (of, at) != own
        )


@attrs.frozen(eq=False)
class TimestampSkewCandidate(EffectCandidate):
    """Time skew of velocities or positions."""

    effect: dynamics.TimestampSkew
    shifts = True
    motion = _FAST_MOTION
    settings_to_try = {"channel": "dq"}, {"channel": "q"}
    guesses = tuple(
        {"late": late}
        for late in (-0.012, -0.008, -0.005, -0.003, -0.0015, 0.0015, 0.003, 0.005, 0.008, 0.012)
    )

    @property
    @override
    def signal(self) -> str:
        return f"{self.effect.channel}@history"

    @property
    @override
    def confounded_with_gain(self) -> bool:
        """Whether skew on all joints equals two other delays, which holds for positions."""
        return self.effect.channel == "q"


CANDIDATES = {
    dynamics.FirstOrderLag: LagCandidate,
    dynamics.VelocityFilter: VelocityFilterCandidate,
    dynamics.Armature: ArmatureCandidate,
    dynamics.TimestampSkew: TimestampSkewCandidate,
}

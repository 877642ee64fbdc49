"""Candidates of friction."""

from __future__ import annotations

from collections.abc import Mapping

import attrs
from typing_extensions import override

from quadvel_actuator.effects import friction
from quadvel_description.arrays import Array

from ...model.effect_candidate import EffectCandidate

_SLOW_REVERSALS = "slow reversals of every joint in the air, at speeds from 0.05 to 5 rad/s"


@attrs.frozen(eq=False)
class _SignFrictionCandidate(EffectCandidate):
    """A log hardly shows the shape of the sign function, but the amplitude depends on it."""

    effect: friction.SignFriction
    signal = "dq"
    motion = _SLOW_REVERSALS
    depends_on_commands = False
    guesses = tuple({"v_0": width} for width in (0.02, 0.06, 0.2))

    @property
    @override
    def indistinguishable_forms(self) -> tuple[EffectCandidate, ...]:
        return (attrs.evolve(self, effect=attrs.evolve(self.effect, turn="arctan")),)


class CoulombCandidate(_SignFrictionCandidate):
    """Coulomb friction."""

    linear = ("c",)


class ViscousCandidate(EffectCandidate):
    """Viscous friction, on some joints only: on all joints it equals a deviation of the gain kd."""

    linear = ("b",)
    signal = "dq"
    motion = _SLOW_REVERSALS
    depends_on_commands = False
    confounded_with_gain = True


class StribeckCandidate(_SignFrictionCandidate):
    """Stribeck friction."""

    linear = ("c", "c_s")
    guesses = tuple({"v_s": v_s, "v_0": v_0} for v_s in (0.15, 0.4, 1.0, 2.0) for v_0 in (0.02, 0.08))

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectCandidate, Mapping[str, Array]]:
        coulomb = friction.CoulombFriction(at=self.effect.at, turn=self.effect.turn)
        return CoulombCandidate(coulomb), {"c": p["c"], "v_0": p["v_0"]}


class QuadraticDragCandidate(EffectCandidate):
    """Quadratic drag."""

    linear = ("c",)
    signal = "dq"
    motion = "fast sweeps, up to the joint's top speed"
    depends_on_commands = False


class LoadDependentCandidate(_SignFrictionCandidate):
    """Friction proportional to the load."""

    linear = ("mu",)
    motion = "slow reversals under different loads: suspended in the air, standing, with a payload"
    depends_on_commands = True


CANDIDATES = {
    friction.CoulombFriction: CoulombCandidate,
    friction.ViscousFriction: ViscousCandidate,
    friction.StribeckFriction: StribeckCandidate,
    friction.QuadraticDrag: QuadraticDragCandidate,
    friction.LoadDependentFriction: LoadDependentCandidate,
}

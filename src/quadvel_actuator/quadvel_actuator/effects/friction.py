"""Friction: torques against the velocity.

s(dq) is a smooth sign function and v_0 the velocity at which it saturates. A log hardly shows the
shape of s, but the estimated amplitude depends on it, so each form has an alternative shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from .base import (
    AddedLaw,
    EffectLaw,
    InitialGuess,
    Parameter,
    Params,
    View,
    evaluate_distinct,
    one_of,
    smooth_sign,
)

_SIGN_WIDTH = Parameter("v_0", "rad/s", 0.003, 0.6, 0.05)
_SIGN_WIDTH_GUESSES = (0.02, 0.06, 0.2)
_SLOW_REVERSALS = "slow reversals of every joint in the air, at speeds from 0.05 to 5 rad/s"


@attrs.frozen(eq=False)
class _SignFriction(AddedLaw):
    """Friction with a smooth sign function: hyperbolic tangent, or the slower arctangent."""

    depends_on_drive_torque = False
    turn: str = attrs.field(default="tanh", kw_only=True, validator=one_of("tanh", "arctan"))

    @property
    @override
    def indistinguishable_forms(self) -> tuple[EffectLaw, ...]:
        return (attrs.evolve(self, turn="arctan"),)

    def sign(self, v: Array, width: Array) -> Array:
        """Smooth sign function: tanh(v / v_0), or (2 / pi) arctan(v / v_0).

        Args:
            v: rad/s, velocity.
            width: rad/s, v_0.

        Returns:
            Values from -1 to 1, 0 at rest.
        """
        if self.turn == "tanh":
            return smooth_sign(v, width)
        return evaluate_distinct(lambda each: np.arctan(v / each) * (2.0 / np.pi), width)


class CoulombFriction(_SignFriction):
    """Coulomb friction: -c s(dq)."""

    name = "coulomb_friction"
    parameters = (Parameter("c", "N m", 0.0, 20.0, 0.3), _SIGN_WIDTH)
    linear = ("c",)
    signal = "dq"
    motion = _SLOW_REVERSALS

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"v_0": width} for width in _SIGN_WIDTH_GUESSES]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * self.sign(s.dq, p["v_0"])


class ViscousFriction(AddedLaw):
    """Viscous friction: -b dq, on some joints only.

    On all joints it equals a deviation of the gain kd.
    """

    name = "viscous_friction"
    parameters = (Parameter("b", "N m s/rad", 0.0, 10.0, 0.05),)
    linear = ("b",)
    depends_on_drive_torque = False
    confounded_with_gain = True
    signal = "dq"
    motion = _SLOW_REVERSALS

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["b"] * s.dq


class StribeckFriction(_SignFriction):
    """Stribeck friction: -(c + (c_s - c) exp(-(dq / v_s)^2)) s(dq), with c_s > c.

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994).
    """

    name = "stribeck_friction"
    parameters = (
        Parameter("c", "N m", 0.0, 20.0, 0.3),
        Parameter("c_s", "N m", 0.0, 30.0, 0.5),
        Parameter("v_s", "rad/s", 0.02, 5.0, 0.3),
        _SIGN_WIDTH,
    )
    linear = ("c", "c_s")
    signal = "dq"
    motion = _SLOW_REVERSALS

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"v_s": v_s, "v_0": v_0} for v_s in (0.15, 0.4, 1.0, 2.0) for v_0 in (0.02, 0.08)]

    @override
    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]]:
        return CoulombFriction(at=self.at, turn=self.turn), {"c": p["c"], "v_0": p["v_0"]}

    @override
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"c_s": np.maximum(p["c_s"], p["c"])}

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        # share of the static part: exp(-(dq / v_s)^2)
        sticking = evaluate_distinct(lambda v_s: np.exp(-np.square(s.dq / v_s)), p["v_s"])
        return -(p["c"] + (p["c_s"] - p["c"]) * sticking) * self.sign(s.dq, p["v_0"])


class QuadraticDrag(AddedLaw):
    """Quadratic drag: -c dq |dq|."""

    name = "quadratic_drag"
    parameters = (Parameter("c", "N m s^2/rad^2", 0.0, 50.0, 0.02),)
    linear = ("c",)
    depends_on_drive_torque = False
    signal = "dq"
    motion = "fast sweeps, up to the joint's top speed"

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * s.dq * np.abs(s.dq)


class LoadDependentFriction(_SignFriction):
    """Friction proportional to the load, as in gears: -mu |tau*| s(dq)."""

    name = "load_dependent_friction"
    parameters = (Parameter("mu", "1", 0.0, 0.9, 0.05), _SIGN_WIDTH)
    linear = ("mu",)
    depends_on_drive_torque = True
    signal = "dq"
    motion = "slow reversals under different loads: hung in the air, standing, with a payload"

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{"v_0": width} for width in _SIGN_WIDTH_GUESSES]

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["mu"] * np.abs(x) * self.sign(s.dq, p["v_0"])


LAWS = (CoulombFriction, ViscousFriction, StribeckFriction, QuadraticDrag, LoadDependentFriction)

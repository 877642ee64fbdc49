"""Friction: torques against the velocity.

s(dq) is a smooth sign function and v_0 the velocity at which it saturates. A log hardly shows the
shape of s, but the estimated amplitude depends on it, so each form has an alternative shape.
"""

from __future__ import annotations

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array

from .base import (
    AddedEffect,
    Parameter,
    Params,
    View,
    one_of,
)
from .numerics import evaluate_distinct, smooth_sign

_SIGN_WIDTH = Parameter("v_0", "rad/s", 0.003, 0.6, 0.05)


@attrs.frozen(eq=False)
class SignFriction(AddedEffect):
    """Friction with a smooth sign function: hyperbolic tangent, or the slower arctangent."""

    turn: str = attrs.field(default="tanh", kw_only=True, validator=one_of("tanh", "arctan"))

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


class CoulombFriction(SignFriction):
    """Coulomb friction: -c s(dq)."""

    name = "coulomb_friction"
    parameters = (Parameter("c", "N m", 0.0, 20.0, 0.3), _SIGN_WIDTH)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * self.sign(s.dq, p["v_0"])


class ViscousFriction(AddedEffect):
    """Viscous friction: -b dq, on some joints only.

    On all joints it equals a deviation of the gain kd.
    """

    name = "viscous_friction"
    parameters = (Parameter("b", "N m s/rad", 0.0, 10.0, 0.05),)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["b"] * s.dq


class StribeckFriction(SignFriction):
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

    @override
    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"c_s": np.maximum(p["c_s"], p["c"])}

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        # share of the static part: exp(-(dq / v_s)^2)
        sticking = evaluate_distinct(lambda v_s: np.exp(-np.square(s.dq / v_s)), p["v_s"])
        return -(p["c"] + (p["c_s"] - p["c"]) * sticking) * self.sign(s.dq, p["v_0"])


class QuadraticDrag(AddedEffect):
    """Quadratic drag: -c dq |dq|."""

    name = "quadratic_drag"
    parameters = (Parameter("c", "N m s^2/rad^2", 0.0, 50.0, 0.02),)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * s.dq * np.abs(s.dq)


class LoadDependentFriction(SignFriction):
    """Friction proportional to the load, as in gears: -mu |tau*| s(dq)."""

    name = "load_dependent_friction"
    parameters = (Parameter("mu", "1", 0.0, 0.9, 0.05), _SIGN_WIDTH)

    @override
    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["mu"] * np.abs(x) * self.sign(s.dq, p["v_0"])


EFFECTS = (CoulombFriction, ViscousFriction, StribeckFriction, QuadraticDrag, LoadDependentFriction)

"""Friction: torques against the velocity. s is a smooth sign, v_0 the velocity at which it turns.

How a sign turns hardly shows in a log, but what it says about the amplitude of friction hangs on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import numpy as np

from .base import AddedLaw, Array, EffectLaw, Parameter, Params, Start, View, of_each, one_of, smooth_sign

_WIDTH = Parameter("v_0", "rad/s", 0.003, 0.6, 0.05)
_WIDTHS = (0.02, 0.06, 0.2)
_SLOW = "slow reversals of every joint in the air, at speeds from 0.05 to 5 rad/s"


@attrs.frozen(eq=False)
class _Rubbing(AddedLaw):
    """Friction with a sign that turns as the hyperbolic tangent does, or slower, as the arctangent."""

    of_drive = False
    turn: str = attrs.field(default="tanh", kw_only=True, validator=one_of("tanh", "arctan"))

    @property
    def alternatives(self) -> tuple[EffectLaw, ...]:
        return (attrs.evolve(self, turn="arctan"),)

    def sign(self, v: Array, width: Array) -> Array:
        """-1 to 1, through zero at rest."""
        if self.turn == "tanh":
            return smooth_sign(v, width)
        return of_each(lambda each: np.arctan(v / each) * (2.0 / np.pi), width)


class CoulombFriction(_Rubbing):
    """-c s(dq)"""

    name = "coulomb_friction"
    parameters = (Parameter("c", "N m", 0.0, 20.0, 0.3), _WIDTH)
    linear = ("c",)
    signal = "dq"
    motion = _SLOW

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"v_0": width} for width in _WIDTHS]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * self.sign(s.dq, p["v_0"])


class ViscousFriction(AddedLaw):
    """-b dq, on some joints only: shared by all it is a deviation of the gain kd"""

    name = "viscous_friction"
    parameters = (Parameter("b", "N m s/rad", 0.0, 10.0, 0.05),)
    linear = ("b",)
    of_drive = False
    confounded_with_gain = True
    signal = "dq"
    motion = _SLOW

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["b"] * s.dq


class StribeckFriction(_Rubbing):
    """-(c + (c_s - c) exp(-(dq / v_s)^2)) s(dq), where c_s > c"""

    name = "stribeck_friction"
    parameters = (
        Parameter("c", "N m", 0.0, 20.0, 0.3),
        Parameter("c_s", "N m", 0.0, 30.0, 0.5),
        Parameter("v_s", "rad/s", 0.02, 5.0, 0.3),
        _WIDTH,
    )
    linear = ("c", "c_s")
    signal = "dq"
    motion = _SLOW

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"v_s": v_s, "v_0": v_0} for v_s in (0.15, 0.4, 1.0, 2.0) for v_0 in (0.02, 0.08)]

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectLaw, Mapping[str, Array]]:
        return CoulombFriction(at=self.at, turn=self.turn), {"c": p["c"], "v_0": p["v_0"]}

    def canonical(self, p: dict[str, Array]) -> dict[str, Array]:
        return p | {"c_s": np.maximum(p["c_s"], p["c"])}

    def torque(self, x: Array, s: View, p: Params) -> Array:
        sticking = of_each(lambda v_s: np.exp(-np.square(s.dq / v_s)), p["v_s"])
        return -(p["c"] + (p["c_s"] - p["c"]) * sticking) * self.sign(s.dq, p["v_0"])


class QuadraticDrag(AddedLaw):
    """-c dq |dq|"""

    name = "quadratic_drag"
    parameters = (Parameter("c", "N m s^2/rad^2", 0.0, 50.0, 0.02),)
    linear = ("c",)
    of_drive = False
    signal = "dq"
    motion = "fast sweeps, up to the joint's top speed"

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["c"] * s.dq * np.abs(s.dq)


class LoadDependentFriction(_Rubbing):
    """-mu |tau*| s(dq)"""

    name = "load_dependent_friction"
    parameters = (Parameter("mu", "1", 0.0, 0.9, 0.05), _WIDTH)
    linear = ("mu",)
    of_drive = True
    signal = "dq"
    motion = "slow reversals under different loads: hung in the air, standing, with a payload"

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{"v_0": width} for width in _WIDTHS]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        return -p["mu"] * np.abs(x) * self.sign(s.dq, p["v_0"])


LAWS = (CoulombFriction, ViscousFriction, StribeckFriction, QuadraticDrag, LoadDependentFriction)

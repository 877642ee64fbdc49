"""Regressors of named signals, which explain what no effect of the registry does.

A regressor is an effect that is linear in its weights: a curve over a signal, a filter of its past,
a lag, a resonance, or a wave along it. It may be multiplied by the direction of motion, the speed or
the torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache, singledispatch
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import AddedEffect, Parameter
from quadvel_actuator.effects.base import Params
from quadvel_actuator.effects.basis_regressors import (
    LEARNED_RESIDUAL,
    BasisRegressor,
    multiplier,
    read_signal,
)
from quadvel_actuator.effects.shapes import Curve, Filter, Shape
from quadvel_actuator.running import ACCELERATION_WINDOW_S
from quadvel_description.arrays import Array, Bools

from ..data.signals import Signals
from ..model.effect_candidate import EffectCandidate

_CACHE_SIZE = 12
"""Number of cached sets of regressors."""
_LAW_SIGNALS = "q", "dq", "error"
"""Signals of the PD law."""
DRIVE_SIGNALS = "q_des", "error", "tau"
"""Signals of the drive, which follow the commands."""
_SIGNAL_COST = 5.0
"""Cost, in parameters, of each signal of a regressor. Its penalised weights cost nothing."""


@cache
def _weights(count: int) -> tuple[Parameter, ...]:
    """Parameters of `count` weights."""
    return tuple(Parameter(name, "N m", -1e6, 1e6, 1.0) for name in _names(count))


@cache
def _names(count: int) -> tuple[str, ...]:
    """Names of `count` weights."""
    return tuple(f"w{k}" for k in range(count))


@attrs.frozen(eq=False)
class SignalRegressor(AddedEffect):
    """Torque as a weighted sum of basis functions of a named signal, optionally times a factor.

        tau = multiplier(t) sum_k w_k phi_k(signal(t))

    Attributes:
        of: Name of the signal, `joint/signal` for that of another joint.
        times: Name of the factor: `direction`, `dq`, `tau`, or empty for 1.
        shape: Basis functions phi_k.
        joints: Names of all joints.
    """

    name = LEARNED_RESIDUAL
    of: str
    times: str
    shape: Shape
    joints: tuple[str, ...]

    @property
    @override
    def settings(self) -> dict[str, Any]:
        return {"of": self.of, "times": self.times, "shape": repr(self.shape), "at": self.at}

    @property
    @override
    def parameters(self) -> tuple[Parameter, ...]:
        return _weights(self.shape.count)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return _names(self.shape.count)

    @property
    @override
    def has_memory(self) -> bool:
        return self.shape.history

    @property
    def reads_torque(self) -> bool:
        """Whether the regressor reads the total torque of all other effects."""
        return "tau" in (self.of.rpartition("/")[2], self.times)

    @property
    def reads_acceleration(self) -> bool:
        """Whether the signal is an acceleration."""
        return self.of.endswith("ddq")

    def columns(self, x: Array, s: Signals) -> Array:
        """Compute the torque per unit weight; cached where it depends on signals alone.

        Args:
            x: Total torque of the other effects, (N, J), N m.
            s: Signals of the log.

        Returns:
            Columns, (K, N, J).
        """
        if self.reads_torque or self.reads_acceleration:
            return _columns(self, x, s)
        return _cached_columns(self.of, self.times, self.shape, self.joints, s)

    @override
    def torque(self, x: Array, s: Any, p: Params) -> Array:
        weight_list = [p[name] for name in self.names]
        if any(weight.ndim > 1 for weight in weight_list):
            weight_list = list(np.broadcast_arrays(*weight_list))
        if x.ndim > 2 and (len(x) == 1 or not self.reads_torque):
            x = x[0]
        if x.ndim == 2 and weight_list[0].ndim == 1 and not self.has_memory:
            u = read_values(self.of, x, s, self.joints)
            total, _ = self.shape.advance(u, 0.0, np.array(weight_list), ())
            return np.broadcast_to(total * multiplier(self.times, s, x), s.q.shape)
        weights = (
            np.stack(weight_list, axis=-2) if weight_list[0].ndim > 1 else np.array(weight_list)
        )  # (B, 1, K, J), or (K, J)
        columns = self.columns(x, s) if x.ndim == 2 else np.stack([self.columns(inputs, s) for inputs in x])
        if columns.ndim == 3 and weights.ndim == 2:
            return np.einsum("kj,knj->nj", weights, columns)
        batch: Array = np.einsum("...kj,...knj->...nj", weights.reshape(-1, *weights.shape[-2:]), columns)
        return batch


def _columns(regressor: SignalRegressor, x: Array, s: Signals) -> Array:
    """Torque per unit weight of a regressor, (K, N, J)."""
    u = read_values(regressor.of, x, s, regressor.joints)
    basis = regressor.shape.columns(u, s.start[:, 0], float(np.median(s.dt)))  # (N, K, C)
    found = np.moveaxis(basis, 1, 0) * multiplier(regressor.times, s, x)
    return np.broadcast_to(found, (len(found), *s.q.shape))


@lru_cache(maxsize=_CACHE_SIZE)
def _cached_columns(of: str, times: str, shape: Shape, joints: tuple[str, ...], s: Signals) -> Array:
    """Torque per unit weight of a regressor that reads no torque, for shapes and signals in use."""
    return _columns(SignalRegressor(of, times, shape, joints), np.zeros(s.q.shape), s)


def read_values(of: str, x: Array, s: Signals, joints: Sequence[str]) -> Array:
    """Read a named signal of a log, with the acceleration that a running model computes.

    Args:
        of: Name of the signal.
        x: Torque that `tau` stands for, (N, J), N m.
        s: Signals of the log.
        joints: Names of the J joints.

    Returns:
        Values, (N, C).
    """
    return read_signal(of, _causal_signals(s) if of.endswith("ddq") else s, x, joints)


def _causal_signals(s: Signals) -> Signals:
    """Signals with an acceleration from past samples only, as a running model computes it."""
    dt = float(np.median(s.dt))
    back = max(1, round(ACCELERATION_WINDOW_S / dt))
    # Backward difference over ACCELERATION_WINDOW_S, shorter at the start of a stretch.
    n = np.arange(len(s.dq))
    began = np.maximum.accumulate(np.where(s.start[:, 0], n, 0))
    slope = (s.dq - s.dq[np.maximum(n - back, began)]) / (back * dt)
    return attrs.evolve(s, slope=lambda name: slope)


@attrs.frozen(eq=False)
class RegressorCandidate(EffectCandidate):
    """Regressor of a named signal, as a candidate."""

    effect: SignalRegressor

    @property
    @override
    def key(self) -> tuple[str, ...]:
        return self.input_signals

    @property
    @override
    def linear(self) -> tuple[str, ...]:
        return self.names

    @property
    def input_signals(self) -> tuple[str, ...]:
        """Names of the signals that it depends on, as in the report: `@history` for the past."""
        of, times = self.effect.of, self.effect.times
        names: tuple[str, ...] = ("q_des", "q") if of == "error" else (of,)
        if self.has_memory:
            names = tuple(f"{name}@history" for name in names)
        factor = "dq" if times == "direction" else times
        return (*names, factor) if factor else names

    @property
    @override
    def signal(self) -> str:
        return self.input_signals[0]

    @property
    @override
    def reads_total_torque(self) -> bool:
        return self.effect.reads_torque

    @property
    @override
    def depends_on_commands(self) -> bool:
        return self.effect.reads_torque or self.effect.reads_acceleration or self.effect.of in DRIVE_SIGNALS

    @override
    def complexity(self, memory_cost: float) -> float:
        return _SIGNAL_COST * len(self.input_signals)

    @property
    @override
    def penalty(self) -> Array:
        return _penalty(self.effect.shape)

    @property
    @override
    def replaces_law(self) -> bool:
        return isinstance(self.effect.shape, Filter) and self.effect.of in _LAW_SIGNALS

    @override
    def allowed_joints(self, joints: Sequence[str]) -> Bools:
        """Return all joints except the one that owns the signal."""
        owner = self.effect.of.rpartition("/")[0]
        return np.array([name != owner for name in joints])

    @override
    def regressors(self, x: Array, s: Signals, values: Array) -> Array:
        return self.effect.columns(x, s)

    def basis_regressor(self, active: Bools, weights: Array, bound: Array) -> BasisRegressor:
        """Return the regressor as a running model evaluates it.

        Args:
            active: Joints that have it, (J,).
            weights: Weight of each basis function, (K, J).
            bound: Largest absolute torque, (J,), N m.

        Returns:
            The regressor with its weights.
        """
        effect = self.effect
        return BasisRegressor(effect.of, effect.times, effect.shape, active, weights, bound, effect.at)


@singledispatch
def _penalty(shape: Shape) -> Array:
    """Ridge penalty (K, K) that a fit adds to the second moments, in units of their mean."""
    return 1e-5 * np.eye(shape.count)


@_penalty.register
def _curve_penalty(shape: Curve) -> Array:
    """Penalty on the second difference of the weights (a P-spline), and slightly on their size."""
    bend = np.diff(np.eye(shape.count), 2, axis=0)
    penalty: Array = 100.0 * bend.T @ bend + 1e-3 * np.eye(shape.count)
    return penalty

"""Library of candidate effects: laws of the registry, and regressors of named signals.

A law has equations, parameters with bounds and units, and starting values. A `SignalTerm` is a law
that is linear in its weights: a curve over a signal, a filter of its past, a lag, a resonance, or a
wave along it. It may be multiplied by the direction of motion, the speed or the torque. It explains
what no law of the registry does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache, cached_property
from typing import Any

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator.effects import DRIVE, JOINT, AddedLaw, EffectLaw, Parameter, registry
from quadvel_actuator.effects.base import InitialGuess, Params, View
from quadvel_actuator.effects.terms import LEARNED_RESIDUAL as TERMS
from quadvel_actuator.effects.terms import (
    Curve,
    Filter,
    Lag,
    Resonance,
    Shape,
    Term,
    Wave,
    input_signals,
    multiplier,
    read_signal,
)
from quadvel_actuator.running import ACCELERATION_WINDOW_S
from quadvel_description.arrays import Array, Bools

from ..data.signals import Signals
from ..data.split import DataSplit
from ..model.torque_model import AppliedEffect, Model
from ..options import DEVICES, Devices
from .lost_commands import lost_commands

_CACHE_SIZE = 12
"""Number of cached sets of regressors."""
_regressor_cache: dict[tuple[Any, ...], tuple[Shape, Signals, Array]] = {}
"""Cached regressors, most recent last. Entries keep the objects alive whose `id` is in the key."""
_DRIVE_SIGNALS = "q_des", "error", "tau"
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
class SignalTerm(AddedLaw):
    """Torque as a weighted sum of basis functions of a named signal, optionally times a factor.

        tau = multiplier(t) sum_k w_k phi_k(signal(t))

    Attributes:
        of: Name of the signal, `joint/signal` for that of another joint.
        times: Name of the factor: `direction`, `dq`, `tau`, or empty for 1.
        shape: Basis functions phi_k.
        joints: Names of all joints.
    """

    name = TERMS
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
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        return _weights(self.shape.count)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return _names(self.shape.count)

    @property
    @override
    def linear(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.names

    @property
    def input_signals(self) -> tuple[str, ...]:
        """Names of the signals that the term depends on, as in the report."""
        return input_signals(self.of, self.times, self.shape)

    @property
    @override
    def signal(self) -> str:  # type: ignore[override]
        return self.input_signals[0]

    @property
    def reads_total(self) -> bool:
        """Whether the term reads the total torque of all laws."""
        return "tau" in (self.of.rpartition("/")[2], self.times)

    @property
    @override
    def depends_on_drive_torque(self) -> bool:  # type: ignore[override]
        return self.reads_total or self.of in _DRIVE_SIGNALS

    @property
    @override
    def has_memory(self) -> bool:  # type: ignore[override]
        return self.shape.history

    @property
    def penalty(self) -> Array:
        """Matrix of the quadratic smoothness penalty on the weights, (K, K)."""
        return self.shape.penalty

    @property
    def complexity(self) -> float:
        """Cost of the term, in parameters."""
        return _SIGNAL_COST * len(self.input_signals)

    @override
    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    def regressors(self, x: Array, s: Signals) -> Array:
        """Compute the torque per unit weight; cached where it depends on signals alone.

        Args:
            x: Input torque of the law, (N, J), N m.
            s: Signals of the log.

        Returns:
            Regressors, (K, N, J).
        """
        if self.reads_total or self.of.endswith("ddq"):
            return self._regressors(x, s)
        key = self.of, self.times, id(self.shape), id(s.q), id(s.dq), id(s.q_des)
        found = _regressor_cache.pop(key, None) or (self.shape, s, self._regressors(x, s))
        _regressor_cache[key] = found
        if len(_regressor_cache) > _CACHE_SIZE:
            del _regressor_cache[next(iter(_regressor_cache))]
        return found[2]

    def _regressors(self, x: Array, s: Signals) -> Array:
        """Torque per unit weight, (K, N, J), without the cache."""
        columns = self.shape.columns(self._read(x, s), s.start[:, 0], float(np.median(s.dt)))  # (N, K, C)
        found = np.moveaxis(columns, 1, 0) * multiplier(self.times, s, x)
        return np.broadcast_to(found, (len(found), *s.q.shape))

    def _read(self, x: Array, s: Signals) -> Array:
        """Values of the signal, (N, C)."""
        return read_signal(self.of, _causal_signals(s) if self.of.endswith("ddq") else s, x, self.joints)

    @override
    def torque(self, x: Array, s: Any, p: Params) -> Array:
        weight_list = [p[name] for name in self.names]
        if any(weight.ndim > 1 for weight in weight_list):
            weight_list = list(np.broadcast_arrays(*weight_list))
        if x.ndim > 2 and (len(x) == 1 or not self.reads_total):
            x = x[0]
        if x.ndim == 2 and weight_list[0].ndim == 1 and not self.has_memory:
            total, _ = self.shape.advance(self._read(x, s), 0.0, np.array(weight_list), ())
            return np.broadcast_to(total * multiplier(self.times, s, x), s.q.shape)
        weights = (
            np.stack(weight_list, axis=-2) if weight_list[0].ndim > 1 else np.array(weight_list)
        )  # (B, 1, K, J), or (K, J)
        columns = (
            self.regressors(x, s) if x.ndim == 2 else np.stack([self.regressors(inputs, s) for inputs in x])
        )
        if columns.ndim == 3 and weights.ndim == 2:
            return np.einsum("kj,knj->nj", weights, columns)
        batch: Array = np.einsum("...kj,...knj->...nj", weights.reshape(-1, *weights.shape[-2:]), columns)
        return batch

    def running_term(self, effect: AppliedEffect, bound: Array) -> Term:
        """Return the term as a running model evaluates it.

        Args:
            effect: The fitted effect with this law.
            bound: Largest absolute torque, (J,), N m.

        Returns:
            The term with its weights.
        """
        return Term(self.of, self.times, self.shape, effect.active, effect.values, bound, self.at)


def _causal_signals(s: Signals) -> Signals:
    """Signals with an acceleration from past samples only, as a running model computes it."""
    dt = float(np.median(s.dt))
    back = max(1, round(ACCELERATION_WINDOW_S / dt))
    # Backward difference over ACCELERATION_WINDOW_S, shorter at the start of a stretch.
    n = np.arange(len(s.dq))
    began = np.maximum.accumulate(np.where(s.start[:, 0], n, 0))
    slope = (s.dq - s.dq[np.maximum(n - back, began)]) / (back * dt)
    return attrs.evolve(s, slope=lambda name: slope)


def complexity(law: EffectLaw, memory_cost: float) -> float:
    """Return the cost of a law in the criterion.

    Args:
        law: The law.
        memory_cost: Further parameters that a law with memory, or one like a delay, counts as.

    Returns:
        Equivalent number of parameters per joint; laws with memory cost more.
    """
    past = memory_cost if law.shifts or law.has_memory else 0.0
    return float(getattr(law, "complexity", len(law.parameters) + past))


class Context:
    """Model and data from which a law derives its variants and starting values.

    Attributes:
        model: Model that the law would extend.
        parts: Data split.
        noise: Variance of the torque noise, (J,), N^2 m^2.
        devices: Devices of the search.
        samples: Rows of all logs.
        signals: Signals at the delays of the model.
        torque: Predicted torque, (N, J), N m.
        residual: Measured minus predicted torque on the fitted rows, 0 elsewhere, (N, J), N m.
    """

    def __init__(self, model: Model, parts: DataSplit, noise: Array, devices: Devices = DEVICES) -> None:
        """Evaluate the model.

        Args:
            model: Model that a law would extend.
            parts: Data split.
            noise: Variance of the torque noise, (J,), N^2 m^2.
            devices: Devices of the search.
        """
        self.model, self.parts, self.noise, self.devices = model, parts, noise, devices
        self.samples, self.signals = model.samples, model.signals
        self.torque = model.predict()
        self.residual = np.where(parts.fit, self.samples.tau - self.torque, 0.0)

    @cached_property
    def lost_commands(self) -> list[tuple[Array, Array]]:
        """Odds that commands were lost, from `lost_commands.lost_commands`."""
        return lost_commands(self.model, self.parts, self.noise, self.devices.lost_commands_at_random)

    def strongest_neighbours(self) -> tuple[str, ...]:
        """Find for each joint the signal of another joint that its residual correlates with most.

        The linear effect of the joint's own signals is projected out first (Frisch, Waugh and
        Lovell).

        Returns:
            Names `joint/signal` with q, dq or tau, one for each joint; empty for a single joint.
        """
        joints = self.samples.joints
        if len(joints) < 2:
            return ()
        s = self.signals
        names = [f"{joint}/{signal}" for signal in ("q", "dq", "tau") for joint in joints]
        others = np.concatenate([s.q, s.dq, self.torque], axis=1)
        found = []
        for j in range(len(joints)):
            # For a signal z, orthogonal to the joint's own ones, (z'r)^2 / z'z is the error
            # reduction.
            keep = self.parts.fit[:, j]
            own = np.column_stack([np.ones(keep.sum()), s.q[keep, j], s.dq[keep, j], s.q_des[keep, j]])
            basis, _ = np.linalg.qr(own)
            projected = others[keep] - basis @ (basis.T @ others[keep])
            score = (projected.T @ self.residual[keep, j]) ** 2
            score /= np.einsum("nk,nk->k", projected, projected) + 1e-12
            score[j :: len(joints)] = -1.0
            found.append(names[int(np.argmax(score))])
        return tuple(found)


def law_candidates(context: Context) -> Iterator[EffectLaw]:
    """Iterate over the laws of the registry that the model lacks.

    Args:
        context: Model and data.

    Yields:
        Each law in all its variants.
    """
    present = {one.law.name for one in context.model.effects}
    for name, law in registry().items():
        if name not in present:
            yield from law.variants(context)


_LAG_TIMES_S = np.geomspace(0.01, 1.0, 8)
_RESONANCE_FREQUENCIES_HZ = np.geomspace(3.0, 110.0, 26)
_DAMPING_RATIOS = 0.02, 0.07, 0.2
_HISTORY_S = 0.02
"""Span of filters over a signal's past, s."""
_WAVE_RATES = np.arange(3.0, 120.0, 0.5)
"""Phase of a wave per angle of the joint, rad/rad."""
_CURVE_PIECES = 6
"""Pieces of a curve."""
_FINE_PIECES, _MAX_PIECES = 25, 100
"""Pieces of a fine curve, and of the finest one after refinement."""


def term_candidates(context: Context) -> Iterator[SignalTerm]:
    """Iterate over the regressors of named signals to screen.

    Args:
        context: Model and data.

    Yields:
        Curves, filters, lags, resonances and waves of the joints' signals and of time.
    """
    make = _TermFactory(context)
    for name in ("q", "dq", "ddq", "q_des", "tau", "error", "t"):
        yield make.curve(name, "")
    for times, names in (("direction", ("q", "tau", "t")), ("tau", ("q", "dq", "t")), ("dq", ("q", "t"))):
        for name in names:
            yield make.curve(name, times)
    for name, times in (("q", ""), ("q", "direction"), ("dq", ""), ("t", ""), ("q", "tau")):
        yield make.curve(name, times, _FINE_PIECES)
    rows = max(round(_HISTORY_S / make.dt), 4)
    edges = tuple(make.dt * np.unique(np.round(np.geomspace(1, rows, 7))))
    long = tuple(make.dt * np.unique(np.round(np.linspace(1, 3 * rows, 12))))
    for name in ("tau", "q_des", "q", "dq"):
        yield make(name, "", Filter(edges), DRIVE)
    for name in ("tau", "q"):
        yield from (make(name, "", Lag(float(time))) for time in _LAG_TIMES_S)
        for frequency in _RESONANCE_FREQUENCIES_HZ[0.35 / make.dt > _RESONANCE_FREQUENCIES_HZ]:
            yield from (make(name, "", Resonance(float(frequency), damping)) for damping in _DAMPING_RATIOS)
    for joint in make.joints if len(make.joints) > 1 else ():
        for name in ("q", "dq", "tau"):
            for times in ("", "direction", "tau", "dq"):
                yield make.curve(f"{joint}/{name}", times, _CURVE_PIECES if not times else 3)
        yield make(f"{joint}/tau", "", Filter(long))
        yield make(f"{joint}/q", "", Filter(edges))
        yield from make.ripples(joint)
    yield from make.lines()


class _TermFactory:
    """Creates regressors of the signals of a model."""

    def __init__(self, context: Context) -> None:
        self._context, self._model = context, context.model
        self.joints = context.samples.joints
        self.dt = context.samples.period
        self._ranges: dict[str, Curve] = {}

    def __call__(self, of: str, times: str, shape: Shape, at: str = "") -> SignalTerm:
        """Create a regressor: in the drive for commanded signals, else at the joint."""
        if not at:
            at = DRIVE if of in _DRIVE_SIGNALS or times in _DRIVE_SIGNALS else JOINT
        return SignalTerm(of, times, shape, self.joints, at=at)

    def _read(self, of: str) -> Array:
        """Values of a signal, (N, C)."""
        s = self._context.signals
        return read_signal(
            of, _causal_signals(s) if of.endswith("ddq") else s, self._context.torque, self.joints
        )

    def curve(self, of: str, times: str, pieces: int = _CURVE_PIECES) -> SignalTerm:
        """Create a smooth curve over the observed range of a signal.

        Args:
            of: Name of the signal.
            times: Name of the factor.
            pieces: Number of pieces of the curve.

        Returns:
            The regressor.
        """
        if of not in self._ranges:
            self._ranges[of] = Curve.over(self._read(of), pieces)
        return self(of, times, attrs.evolve(self._ranges[of], pieces=pieces))

    def ripples(self, joint: str) -> Iterator[SignalTerm]:
        """Create a wave along another joint's angle, at the rate of most residual power.

        Args:
            joint: Name of the other joint.

        Yields:
            The regressor, if the angle spans 1.5 periods of some rate.
        """
        u = self._read(f"{joint}/q")
        rates = _WAVE_RATES[1.5 * 2.0 * np.pi / max(float(np.ptp(u)), 1e-3) < _WAVE_RATES]
        if rates.size:
            # Power |sum exp(-i n u) r|^2 of the residual r over the angle u, for each rate n.
            power = np.abs(np.exp(-1j * rates[:, None] * u[:, 0]) @ self._context.residual) ** 2
            yield self(f"{joint}/q", "", Wave(rates[np.argmax(power.max(axis=1))], 2))

    def lines(self) -> Iterator[SignalTerm]:
        """Create waves at the strongest spectral lines of the residual over time.

        Yields:
            For each of three frequencies a sine, and a sine with two overtones.
        """
        t, left = self._context.signals.t[:, 0], self._context.residual
        span = float(np.ptp(t))
        grid = np.arange(max(2.0, 3.0 / span), 0.45 / self.dt, 0.5 / span)
        # Periodogram of the residual on regular times, the largest of all joints. The resolution is
        # 1 / span, and the grid has half that step.
        even = np.arange(t.min(), t.max(), self.dt)
        order = np.argsort(t, kind="stable")
        power = np.zeros(len(grid))
        for one in left.T:
            spectrum = np.fft.rfft(np.interp(even, t[order], one[order]), 2 * len(even))
            found = np.interp(grid, np.fft.rfftfreq(2 * len(even), self.dt), np.abs(spectrum))
            power = np.maximum(power, found)
        for best in np.argsort(-power)[:3]:
            # Refine each line by |sum_t exp(-2 pi i f t) r(t)|^2 at the true times.
            near = grid[best] + np.linspace(-0.5 / span, 0.5 / span, 21)
            waves = np.exp(-2j * np.pi * np.outer(near, t)) @ left
            frequency = near[int(np.argmax((np.abs(waves) ** 2).sum(axis=1)))]
            yield from (self("t", "", Wave(2.0 * np.pi * frequency, count), JOINT) for count in (1, 3))


def refinements(term: SignalTerm) -> list[SignalTerm]:
    """List variations of a regressor near its present shape.

    Args:
        term: The regressor.

    Returns:
        Regressors with a finer curve, another time constant, frequency, damping, or place.
    """
    shape = term.shape
    near: list[Shape] = []
    if isinstance(shape, Curve) and shape.pieces < _MAX_PIECES:
        near = [attrs.evolve(shape, pieces=2 * shape.pieces)]
    elif isinstance(shape, Lag):
        near = [Lag(shape.time * by) for by in (0.7, 0.85, 1.18, 1.4)]
    elif isinstance(shape, Resonance):
        near = [Resonance(shape.frequency * by, shape.damping) for by in (0.93, 0.97, 1.03, 1.07)]
        near += [Resonance(shape.frequency, min(shape.damping * by, 0.9)) for by in (0.6, 1.6)]
    found = [attrs.evolve(term, shape=one) for one in near]
    if term.of not in ("q_des", "error", "t") and not isinstance(shape, Filter):
        found.append(attrs.evolve(term, at=DRIVE if term.at == JOINT else JOINT))
    return found


def allowed_joints(law: EffectLaw, joints: Sequence[str]) -> Bools:
    """Return the joints that a law may act on.

    Args:
        law: The law.
        joints: Names of the joints.

    Returns:
        Mask (J,); a signal of a joint may not act on that joint as a neighbour's signal.
    """
    owner = law.of.rpartition("/")[0] if isinstance(law, SignalTerm) else ""
    return np.array([name != owner for name in joints])

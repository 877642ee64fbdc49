"""The candidates: laws of the registry and terms of named signals, each one kind of thing.

A candidate is a law with equations, parameters with bounds and units, and starting values. A term is a law that is linear
in its weights: a curve over a signal, a filter of its past, a lag, a resonance that it excites, a wave along it, alone or
times the direction of motion, the speed or the torque. Terms stand for what no law of the registry explains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache, cached_property
from typing import Any

import attrs
import numpy as np

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

from .criterion import DataSplit
from .lost_commands import lost_commands
from .model import AppliedEffect, Model
from .signals import Array, Bools, Signals

_KEPT = 12
"""Sets of regressors of terms that are kept"""
_kept: dict[tuple[Any, ...], tuple[Shape, Signals, Array]] = {}
"""Such sets, the latest used last; what a key names by where it lies in memory is held beside them."""
_COMMANDED = "q_des", "error", "tau"
_PAST_COST = 0.5
"""Further cost, in parameters, of a law with a memory or that resembles a delay: decides between laws that explain the same"""
_SIGNAL_COST = 5.0
"""In parameters: what a signal that a term names costs; its weights, which a penalty keeps smooth, cost nothing"""


@cache
def _weights(count: int) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, "N m", -1e6, 1e6, 1.0) for name in _names(count))


@cache
def _names(count: int) -> tuple[str, ...]:
    return tuple(f"w{k}" for k in range(count))


@attrs.frozen(eq=False)
class SignalTerm(AddedLaw):
    """A shape of a signal, times something, as a law that is linear in its weights."""

    name = TERMS
    of: str
    times: str
    shape: Shape
    joints: tuple[str, ...]

    @property
    def settings(self) -> dict[str, Any]:
        return {"of": self.of, "times": self.times, "shape": repr(self.shape), "at": self.at}

    @property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        return _weights(self.shape.count)

    @property
    def names(self) -> tuple[str, ...]:
        return _names(self.shape.count)

    @property
    def linear(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.names

    @property
    def inputs(self) -> tuple[str, ...]:
        """The signals that it depends on, as reports name them."""
        return input_signals(self.of, self.times, self.shape)

    @property
    def signal(self) -> str:  # type: ignore[override]
        return self.inputs[0]

    @property
    def reads_total(self) -> bool:
        """Does it read the torque that all laws give?"""
        return "tau" in (self.of.rpartition("/")[2], self.times)

    @property
    def depends_on_drive_torque(self) -> bool:  # type: ignore[override]
        return self.reads_total or self.of in _COMMANDED

    @property
    def has_memory(self) -> bool:  # type: ignore[override]
        return self.shape.history

    @property
    def penalty(self) -> Array:
        """Of its weights, (K, K)."""
        return self.shape.penalty

    @property
    def complexity(self) -> float:
        """What it says, in parameters."""
        return _SIGNAL_COST * len(self.inputs)

    def initial_guesses(self, s: View, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        return [{}]

    def regressors(self, x: Array, s: Signals) -> Array:
        """What its weights are factors of, (K, N, J); the latest are kept where they hang on signals alone."""
        if self.reads_total or self.of.endswith("ddq"):
            return self._regressors(x, s)
        key = self.of, self.times, id(self.shape), id(s.q), id(s.dq), id(s.q_des)
        found = _kept.pop(key, None) or (self.shape, s, self._regressors(x, s))
        _kept[key] = found
        if len(_kept) > _KEPT:
            del _kept[next(iter(_kept))]
        return found[2]

    def _regressors(self, x: Array, s: Signals) -> Array:
        columns = self.shape.columns(self._read(x, s), s.start[:, 0], float(np.median(s.dt)))  # (N, K, C)
        found = np.moveaxis(columns, 1, 0) * multiplier(self.times, s, x)
        return np.broadcast_to(found, (len(found), *s.q.shape))

    def _read(self, x: Array, s: Signals) -> Array:
        """The signal that it is a shape of, (N, C)."""
        return read_signal(self.of, _past_only(s) if self.of.endswith("ddq") else s, x, self.joints)

    def torque(self, x: Array, s: Any, p: Params) -> Array:
        each = [p[name] for name in self.names]
        if any(one.ndim > 1 for one in each):
            each = list(np.broadcast_arrays(*each))
        if x.ndim > 2 and (len(x) == 1 or not self.reads_total):
            x = x[0]
        if x.ndim == 2 and each[0].ndim == 1 and not self.has_memory:
            total, _ = self.shape.advance(self._read(x, s), 0.0, np.array(each), ())
            return np.broadcast_to(total * multiplier(self.times, s, x), s.q.shape)
        weights = np.stack(each, axis=-2) if each[0].ndim > 1 else np.array(each)  # (B, 1, K, J), or (K, J)
        columns = self.regressors(x, s) if x.ndim == 2 else np.stack([self.regressors(one, s) for one in x])
        if columns.ndim == 3 and weights.ndim == 2:
            return np.einsum("kj,knj->nj", weights, columns)
        batch: Array = np.einsum("...kj,...knj->...nj", weights.reshape(-1, *weights.shape[-2:]), columns)
        return batch

    def term(self, one: AppliedEffect, bound: Array) -> Term:
        """As a running model has it; its torque stays within `bound` (J,), N m."""
        return Term(self.of, self.times, self.shape, one.active, one.values, bound, self.at)


def _past_only(s: Signals) -> Signals:
    """The signals with an acceleration that a running model can have, too."""
    dt = float(np.median(s.dt))
    back = max(1, round(ACCELERATION_WINDOW_S / dt))
    n = np.arange(len(s.dq))
    began = np.maximum.accumulate(np.where(s.start[:, 0], n, 0))
    slope = (s.dq - s.dq[np.maximum(n - back, began)]) / (back * dt)
    return attrs.evolve(s, slope=lambda name: slope)


def complexity(law: EffectLaw) -> float:
    """What a law says, in parameters a joint; one that reaches back in time says more than one of the moment."""
    past = _PAST_COST if law.shifts or law.has_memory else 0.0
    return float(getattr(law, "complexity", len(law.parameters) + past))


class Context:
    """What a law may ask of the model that it is to be added to, when it makes its variants and starting values."""

    def __init__(self, model: Model, parts: DataSplit, noise: Array) -> None:
        self.model, self.parts, self.noise = model, parts, noise
        self.samples, self.signals = model.samples, model.signals
        self.torque = model.predict()
        self.residual = np.where(parts.fit, self.samples.tau - self.torque, 0.0)

    @cached_property
    def lost_commands(self) -> list[tuple[Array, Array]]:
        """Odds of commands that are behind, as `lost_commands.lost_commands` finds them."""
        return lost_commands(self.model, self.parts, self.noise)

    def strongest_neighbours(self) -> tuple[str, ...]:
        """For each joint another joint's q, dq or tau that its residual goes with; none of one joint.

        What the joint's own signals explain linearly is taken out first (Frisch, Waugh and Lovell).
        """
        joints = self.samples.joints
        if len(joints) < 2:
            return ()
        s = self.signals
        names = [f"{joint}/{signal}" for signal in ("q", "dq", "tau") for joint in joints]
        others = np.concatenate([s.q, s.dq, self.torque], axis=1)
        found = []
        for j in range(len(joints)):
            keep = self.parts.fit[:, j]
            own = np.column_stack([np.ones(keep.sum()), s.q[keep, j], s.dq[keep, j], s.q_des[keep, j]])
            basis, _ = np.linalg.qr(own)
            left = others[keep] - basis @ (basis.T @ others[keep])
            score = (left.T @ self.residual[keep, j]) ** 2
            score /= np.einsum("nk,nk->k", left, left) + 1e-12
            score[j :: len(joints)] = -1.0
            found.append(names[int(np.argmax(score))])
        return tuple(found)


def laws(context: Context) -> Iterator[EffectLaw]:
    """Every law of the registry that is not on the model yet, in all its variants."""
    taken = {one.law.name for one in context.model.effects}
    for name, law in registry().items():
        if name not in taken:
            yield from law.variants(context)


_LAGS = np.geomspace(0.01, 1.0, 8)  # s
_FREQUENCIES, _DAMPING = np.geomspace(3.0, 110.0, 26), (0.02, 0.07, 0.2)  # Hz, of the critical one
_HISTORY = 0.02  # s
_RATES = np.arange(3.0, 120.0, 0.5)  # rad/rad
_PIECES = 6
_FINE, _FINEST = 25, 100


def terms(context: Context) -> Iterator[SignalTerm]:
    """Every term that is tried."""
    make = _Maker(context)
    for name in ("q", "dq", "ddq", "q_des", "tau", "error", "t"):
        yield make.curve(name, "")
    for times, names in (("direction", ("q", "tau", "t")), ("tau", ("q", "dq", "t")), ("dq", ("q", "t"))):
        for name in names:
            yield make.curve(name, times)
    for name, times in (("q", ""), ("q", "direction"), ("dq", ""), ("t", ""), ("q", "tau")):
        yield make.curve(name, times, _FINE)
    rows = max(round(_HISTORY / make.dt), 4)
    edges = tuple(make.dt * np.unique(np.round(np.geomspace(1, rows, 7))))
    long = tuple(make.dt * np.unique(np.round(np.linspace(1, 3 * rows, 12))))
    for name in ("tau", "q_des", "q", "dq"):
        yield make(name, "", Filter(edges), DRIVE)
    for name in ("tau", "q"):
        yield from (make(name, "", Lag(float(time))) for time in _LAGS)
        for frequency in _FREQUENCIES[0.35 / make.dt > _FREQUENCIES]:
            yield from (make(name, "", Resonance(float(frequency), damping)) for damping in _DAMPING)
    for joint in make.joints if len(make.joints) > 1 else ():
        for name in ("q", "dq", "tau"):
            for times in ("", "direction", "tau", "dq"):
                yield make.curve(f"{joint}/{name}", times, _PIECES if not times else 3)
        yield make(f"{joint}/tau", "", Filter(long))
        yield make(f"{joint}/q", "", Filter(edges))
        yield from make.ripples(joint)
    yield from make.lines()


class _Maker:
    """Makes terms of the signals of a model."""

    def __init__(self, context: Context) -> None:
        self._context, self._model = context, context.model
        self.joints = context.samples.joints
        self.dt = context.samples.period
        self._ranges: dict[str, Curve] = {}

    def __call__(self, of: str, times: str, shape: Shape, at: str = "") -> SignalTerm:
        """What commands make is looked for in the drive, all else at the joint."""
        if not at:
            at = DRIVE if of in _COMMANDED or times in _COMMANDED else JOINT
        return SignalTerm(of, times, shape, self.joints, at=at)

    def _read(self, of: str) -> Array:
        s = self._context.signals
        return read_signal(of, _past_only(s) if of.endswith("ddq") else s, self._context.torque, self.joints)

    def curve(self, of: str, times: str, pieces: int = _PIECES) -> SignalTerm:
        """A smooth curve over the range that the signal had."""
        if of not in self._ranges:
            self._ranges[of] = Curve.over(self._read(of), pieces)
        return self(of, times, attrs.evolve(self._ranges[of], pieces=pieces))

    def ripples(self, joint: str) -> Iterator[SignalTerm]:
        """A wave along the angle of another joint, at the rate with which most of what is left goes."""
        u = self._read(f"{joint}/q")
        rates = _RATES[1.5 * 2.0 * np.pi / max(float(np.ptp(u)), 1e-3) < _RATES]
        if rates.size:
            power = np.abs(np.exp(-1j * rates[:, None] * u[:, 0]) @ self._context.residual) ** 2
            yield self(f"{joint}/q", "", Wave(rates[np.argmax(power.max(axis=1))], 2))

    def lines(self) -> Iterator[SignalTerm]:
        """The strongest lines of the spectrum in time, each alone and with two overtones."""
        t, left = self._context.signals.t[:, 0], self._context.residual
        span = float(np.ptp(t))
        grid = np.arange(max(2.0, 3.0 / span), 0.45 / self.dt, 0.5 / span)
        even = np.arange(t.min(), t.max(), self.dt)
        order = np.argsort(t, kind="stable")
        power = np.zeros(len(grid))
        for one in left.T:
            spectrum = np.fft.rfft(np.interp(even, t[order], one[order]), 2 * len(even))
            found = np.interp(grid, np.fft.rfftfreq(2 * len(even), self.dt), np.abs(spectrum))
            power = np.maximum(power, found)
        for best in np.argsort(-power)[:3]:
            near = grid[best] + np.linspace(-0.5 / span, 0.5 / span, 21)
            waves = np.exp(-2j * np.pi * np.outer(near, t)) @ left
            frequency = near[int(np.argmax((np.abs(waves) ** 2).sum(axis=1)))]
            yield from (self("t", "", Wave(2.0 * np.pi * frequency, count), JOINT) for count in (1, 3))


def refined(term: SignalTerm) -> list[SignalTerm]:
    """The same term with a finer curve, its time constant, frequency or damping, or its place, a little otherwise."""
    shape = term.shape
    near: list[Shape] = []
    if isinstance(shape, Curve) and shape.pieces < _FINEST:
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


def may_act(law: EffectLaw, joints: Sequence[str]) -> Bools:
    """The joints (J,) that a law may act on: a signal of a joint does not count as a neighbour's on that joint itself."""
    owner = law.of.rpartition("/")[0] if isinstance(law, SignalTerm) else ""
    return np.array([name != owner for name in joints])

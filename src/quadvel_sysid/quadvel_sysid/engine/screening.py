"""Where to fit a law from: many guesses of its parameters at several pairs of delays, looked at cheaply.

An effect that the model lacks bends the delays and gains that were fitted without it. Each law is therefore looked at
over a grid of delays; between its points, and for the gains, slopes stand in, shared by the joints as the model has it.
Every joint takes the guess that suits it best.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.effects import AddedLaw, EffectLaw, Parameter
from quadvel_actuator.effects.base import Params, Start, View, smooth_sign

from .delays import LONGEST
from .eam import pd_torque
from .few import Few, remembers
from .model import Applied, Model
from .signals import Array, Bools

_BATCH = 8  # guesses evaluated at once
_GAIN_STEP = 0.01
_DELAY_STEP = 0.0003  # s
_OUTPUTS = (0.0005, 0.002, 0.0035, 0.005)  # s, output delays, the sum of both delays being kept
_PERIODS = (-0.005, 0.005)  # s, commands come in steps about so far apart: a delay may be off by one
_EXCHANGED = ((0.0, 0.0), (0.003, -0.003))
"""s, of input and output delay, for laws that have to be run row by row"""
_SHORTENED = ((0.0, -0.003), (-0.004, 0.0), (-0.007, 0.0))
"""besides, for those that look like a delay"""
_TOTALS = tuple(np.arange(0.0015, 0.026, 0.003))  # s, sums of both delays where nothing is known of them
_APART = 0.0015  # s, between sums of delays that are both to be looked at

_PROMISE = 0.015
"""Of the noise: a law that takes less off the fitted error of every joint is not tried further."""

_ROUNDS = 3
_FARTHEST = 0.002  # s, that slopes along the delays are followed


@attrs.frozen(eq=False)
class Started:
    """A law on a model at the best of its guesses, the rest of the model as the slopes have it."""

    law: EffectLaw
    model: Model
    promise: float
    """what it takes off the squared error of all fitted rows, each joint's in units of its noise, of joints where it does,
    by the share that it takes off few of them"""


class Ground:
    """The model that laws are looked at on, on few of its rows."""

    def __init__(self, model: Model, few: Few, left: Array) -> None:
        """left: squared error (J,) of all fitted rows, each joint's in units of its noise."""
        self.model, self.few, self.left = model, few, left
        self._bare: dict[bool, Array] = {}
        self._spots: dict[Any, list[_Spot]] = {}
        unbent = self._unbent()
        self.bases = (model,) if unbent is None else (model, unbent)
        """models with the gains and delays to start from: as fitted, and as a stand-in for any effect has them"""

    def _unbent(self) -> Model | None:
        """The model with gains and delays as they are beside `_Anything`; None where that is next to the same."""
        if remembers(self.model):
            return None
        model, rows = self.few.of(self.model)
        joints = rows.shape[1]
        law = _Anything()
        nothing = np.zeros((1, len(law.parameters), joints))
        at = model.plus(Applied(law, np.ones(joints, dtype=bool), nothing[0], np.arange(joints)))
        grid = [
            (np.full(joints, total - out), np.full(joints, out)) for total in _TOTALS for out in _OUTPUTS[::2]
        ]
        spots = [_Spot(one, rows) for one in _possible(model, grid)]
        tried = [_Screen(spot, at.applied[-1]).best(nothing) for spot in spots]
        best = min(tried, key=lambda one: float(one[1].sum()))[0]
        apart = best.input_delay + best.output_delay - model.input_delay - model.output_delay
        if np.abs(apart).max() < _APART:
            return None
        return attrs.evolve(best, samples=self.model.samples, applied=best.applied[:-1])

    def bare(self, law: EffectLaw) -> Array:
        """Squared error (J,) of the model without the law on the rows that suit it, at its best delays."""
        key = law.remembers
        if key not in self._bare:
            every = self.pairs(law, _EXCHANGED)
            tried = [_Screen(spot, None).best(np.zeros((1, 0, len(self.left))))[1] for spot in every]
            self._bare[key] = min(tried, key=lambda error: float(error.sum()))
        return self._bare[key]

    def pairs(self, law: EffectLaw, moves: tuple[tuple[float, float], ...]) -> list[_Spot]:
        """The pairs of delays at which `law` is tried: `moves` away, or a grid of output delays."""
        rowwise = law.remembers or remembers(self.model)
        key = moves if rowwise else None
        if key not in self._spots:
            rows = self.few.of(self.model, law)[1]
            self._spots[key] = [_Spot(at, rows) for base in self.bases for at in self._around(base, law, key)]
        return self._spots[key]

    def _around(
        self, base: Model, law: EffectLaw, moves: tuple[tuple[float, float], ...] | None
    ) -> Iterator[Model]:
        at = self.few.of(base, law)[0]
        if moves is None:
            return divided(at)
        return _possible(at, [(base.input_delay + a, base.output_delay + b) for a, b in moves])


def divided(model: Model) -> Iterator[Model]:
    """The model, and with its delays divided in other ways between input and output, and some commands off."""
    yield from split(model)
    yield from later(model, _PERIODS)


def split(model: Model) -> Iterator[Model]:
    """The model, and with its delays divided in other ways between input and output."""
    yield model
    i, o = model.input_delay, model.output_delay
    yield from _possible(model, [(i + o - at, np.full_like(o, at)) for at in _OUTPUTS])


def later(model: Model, by: Sequence[float]) -> Iterator[Model]:
    """The model with other input delays, `by` s more."""
    yield from _possible(model, [(model.input_delay + one, model.output_delay) for one in by])


def _possible(model: Model, delays: Sequence[tuple[Array, Array]]) -> Iterator[Model]:
    """The model at those of these delays, each (J,), that are within bounds."""
    for a, b in delays:
        if (a > -1e-9).all() and (b > -1e-9).all() and (a <= LONGEST[0]).all() and (b <= LONGEST[1]).all():
            yield model.with_delays(np.maximum(a, 0.0), np.maximum(b, 0.0))


class _Anything(AddedLaw):
    """A stand-in for what the model may lack: a constant, a spring, dry friction, drag, of any sign.

    No inertia: with it the motion alone would explain the torque, whatever the delays.
    """

    name = "anything"
    linear = ("constant", "spring", "dry", "drag")
    parameters = tuple(Parameter(name, "", -1e9, 1e9, 1.0) for name in linear)

    def starts(self, s: View, torque: Array, residual: Array) -> Sequence[Start]:
        return [{}]

    def torque(self, x: Array, s: View, p: Params) -> Array:
        dry = smooth_sign(s.dq, np.array(0.05))
        return p["constant"] + p["spring"] * s.q + p["dry"] * dry + p["drag"] * s.dq * np.abs(s.dq)


def start(ground: Ground, law: EffectLaw, starts: Sequence[Start]) -> Started | None:
    """The law at the best of `starts`, chosen for each joint; None where that takes nothing off the error."""
    if not starts:
        return None
    joints = len(ground.left)
    table = np.array(
        [[_within(one.get(p.name, p.scale), p, joints) for p in law.parameters] for one in starts]
    )
    groups = np.zeros(joints, dtype=np.intp) if law.common else np.arange(joints)
    empty = Applied(law, np.ones(joints, dtype=bool), table[0], groups)
    best: Model | None = None
    lowest = np.full(joints, np.inf)
    for spot in ground.pairs(law, (*_EXCHANGED, *(_SHORTENED if law.shifts else ()))):
        found, error = _Screen(spot, empty).best(table)
        if error.sum() < lowest.sum():
            lowest, best = error, found
    bare = ground.bare(law)
    promise = np.maximum(bare - lowest, 0.0) / (bare + 1e-300) * ground.left
    if best is None or not (promise > _PROMISE * ground.few.fitted_rows).any():
        return None
    return Started(law, attrs.evolve(best, samples=ground.model.samples), float(promise.sum()))


def _within(value: Array | float, parameter: Parameter, joints: int) -> Array:
    return np.broadcast_to(value, joints).clip(parameter.low, parameter.high)


class _Spot:
    """A model at one pair of delays, and what every law that is looked at there needs of it."""

    def __init__(self, model: Model, rows: Bools) -> None:
        """rows: those that are fitted, (N, J)."""
        self.model, self.rows = model, rows
        self.moved = np.repeat(model.gains[None], 3, axis=0)
        """gains as they are, and with either a little more"""
        self.moved[1, 0] += _GAIN_STEP
        self.moved[2, 1] += _GAIN_STEP

    @cached_property
    def slopes(self) -> list[Array]:
        """Change of the torque (N, J) with either delay."""
        model = self.model
        delays = np.stack([model.input_delay, model.output_delay])
        moves = np.array([[0.0, 0.0], [_DELAY_STEP, 0.0], [0.0, _DELAY_STEP]])[..., None]
        at, *later = (pd_torque(model.samples, model.gains, a, b, model.window) for a, b in delays + moves)
        return [(one - at) / _DELAY_STEP for one in later]

    @cached_property
    def torque(self) -> Array:
        """Torque (3, N, J) with the moved gains."""
        values = [np.repeat(one.values[None], 3, axis=0) for one in self.model.applied]
        return self.model.evaluate(self.moved, values)

    @cached_property
    def still(self) -> Array:
        """Columns (J, K + 2, N) that are the same whatever law is tried: of `freed`, and of the delays."""
        return self.wide([*self.columns, *(one[None] for one in self.slopes)])[0]

    @cached_property
    def plain(self) -> Array:
        """Columns (J, K + 5, N) without a law that is tried: of `freed`, of gains and delays, and the target."""
        *gains, left = self.wide(self.of(self.torque))[0].swapaxes(0, 1)
        own, delays = self.still[:, :-2], self.still[:, -2:]
        return np.concatenate([own, np.stack(gains, axis=1), delays, left[:, None]], axis=1)

    def of(self, torque: Array) -> list[Array]:
        """Of torques (3 B, N, J) with the moved gains: slopes along either gain, and what is left to explain, (B, N, J)."""
        base = torque[::3]
        step = np.inf if self.model.gains_held else _GAIN_STEP
        return [*((torque[k::3] - base) / step for k in (1, 2)), self.model.samples.tau - base]

    def wide(self, columns: Sequence[Array]) -> Array:
        """Columns (B or 1, N, J) each, on the rows that are fitted, as (B, J, M, N)."""
        count = max((len(one) for one in columns), default=1)
        rows, joints = self.rows.shape
        found = np.empty((count, joints, len(columns), rows))
        for k, one in enumerate(columns):
            np.multiply(one.swapaxes(-1, -2), self.rows.T, out=found[:, :, k])
        return found

    @cached_property
    def driven(self) -> Array:
        return self.model.driven()

    @cached_property
    def freed(self) -> list[tuple[int, int]]:
        """Linear parameters of the model's own laws, (law, parameter): a new law may need others of them.

        None where torque is what the motion implies: that is bent by the way it was derived, and a law already there,
        free beside one like it, would be bent along.
        """
        if self.model.implied:
            return []
        return [
            (k, one.law.names.index(name))
            for k, one in enumerate(self.model.applied)
            for name in getattr(one.law, "linear", ())
        ]

    @cached_property
    def columns(self) -> list[Array]:
        """What a unit of each of them adds, (1, N, J)."""
        return [
            _unit(self, self.model.applied[k], self.model.applied[k].values[None], p) for k, p in self.freed
        ]


def _gram(first: Array, last: Array) -> Array:
    """Products of all columns, first (B, J, L, N) and last (J, M, N), of which those of the last ones are all the same."""
    count, joints, mine = first.shape[:3]
    gram = np.empty((count, joints, mine + last.shape[1], mine + last.shape[1]))
    gram[..., :mine, :mine] = first @ first.swapaxes(-1, -2)
    gram[..., :mine, mine:] = first @ last.swapaxes(-1, -2)
    gram[..., mine:, :mine] = gram[..., :mine, mine:].swapaxes(-1, -2)
    gram[..., mine:, mine:] = last @ last.swapaxes(-1, -2)
    return gram


def _unit(spot: _Spot, applied: Applied, values: Array, one: int) -> Array:
    """What a unit of a law's linear parameter adds, the others being as in `values` (B, P, J): (B or 1, N, J)."""
    unit = values.copy()
    unit[:, [applied.law.names.index(name) for name in getattr(applied.law, "linear", ())]] = 0.0
    unit[:, one] = 1.0
    added = spot.model.added(applied, spot.driven, unit)
    return added if added.ndim == 3 else added[None]


class _Screen:
    """Least squares of the model of a spot, with `tried` on it if there is one, for many guesses of its parameters.

    Unknown are the linear parameters of the law, and of those on the model already, of each joint, and gains and delays,
    shared as the model shares them.
    """

    def __init__(self, spot: _Spot, tried: Applied | None) -> None:
        self.spot, self.tried = spot, tried
        law, model = None if tried is None else tried.law, spot.model
        self.linear = [law.names.index(name) for name in getattr(law, "linear", ())] if law else []
        bounds = [(law.parameters[k].low, law.parameters[k].high) for k in self.linear] if law else []
        self.bounds = np.array([*bounds, *((-np.inf, np.inf) for _ in spot.freed)]).reshape(-1, 2)
        groups = np.concatenate([model.gain_groups, np.tile(model.delay_groups, (2, 1))])
        offsets = np.cumsum([0, *(int(one.max()) + 1 for one in groups)])
        self.index, self.count = groups + offsets[:4, None], int(offsets[4])

    def best(self, table: Array) -> tuple[Model, Array]:
        """The model at the best of `table` (guesses, P, J) for each joint, and its squared error (J,)."""
        parts = [self._products(one) for one in np.split(table, range(_BATCH, len(table), _BATCH))]
        gram, right, square = (np.concatenate(one) for one in zip(*parts, strict=True))
        free = _Quadratic.of(gram, right, square, len(self.bounds))
        joint = np.arange(table.shape[2])
        chosen = self._least(free.alone())
        outside = np.zeros(free.error.shape, dtype=bool)
        for _ in range(_ROUNDS):
            off = outside[chosen, joint]
            hessian = np.where(off[:, None, None], free.plain[2][chosen, joint], free.hessian[chosen, joint])
            gradient = np.where(off[:, None], free.plain[1][chosen, joint], free.gradient[chosen, joint])
            change = self._shared(hessian, gradient)
            error, values, outside = free.at(change, self.bounds)
            chosen = self._least(error)
        found = values[chosen, joint].T
        best = table[chosen, :, joint].T.copy()
        best[self.linear] = found[: len(self.linear)]
        return self._moved_by(change, best, found[len(self.linear) :]), error[chosen, joint]

    def _least(self, error: Array) -> NDArray[np.intp]:
        """The best guess for each joint (J,) by its error (guesses, J), or the best for all where they have one cause."""
        if self.tried is not None and self.tried.law.common:
            return np.full(error.shape[1], np.argmin(error.sum(axis=1)))
        return np.argmin(error, axis=0)

    def _shared(self, hessian: Array, gradient: Array) -> Array:
        """The change (4, J) of gains and delays that lessens the error of all joints most."""
        total, right = np.zeros((self.count, self.count)), np.zeros(self.count)
        for at, one, g in zip(self.index.T, hessian, gradient, strict=True):
            total[np.ix_(at, at)] += one
            right[at] += g
        size = np.diagonal(total)
        change = np.linalg.solve(total + np.diag(1e-6 * size + 1e-12), right)[self.index]
        change[2:] = np.clip(change[2:], -_FARTHEST, _FARTHEST)
        return change

    def _moved_by(self, change: Array, values: Array, own: Array) -> Model:
        """The model with gains and delays changed by (4, J), its own laws by `own`, and the new law at these values."""
        model = self.spot.model
        delays = np.round(
            np.clip(
                [model.input_delay + change[2], model.output_delay + change[3]],
                0.0,
                np.array(LONGEST)[:, None],
            ),
            7,
        )
        applied = list(model.applied)
        for (k, p), by in zip(self.spot.freed, own, strict=True):
            parameter, moved_to = applied[k].law.parameters[p], applied[k].values.copy()
            moved_to[p] = np.clip(moved_to[p] + by, parameter.low, parameter.high)
            applied[k] = attrs.evolve(applied[k], values=moved_to)
        moved = attrs.evolve(model, gains=model.gains + change[:2], applied=tuple(applied))
        moved = moved.with_delays(*delays)
        return moved if self.tried is None else moved.plus(attrs.evolve(self.tried, values=values))

    def _products(self, values: Array) -> tuple[Array, Array, Array]:
        """Of each guess (B, P, J) and joint: products of the columns (B, J, M, M), with the target, and of the target."""
        if self.tried is None or self.linear:  # without its linear parameters the law does nothing
            own = [_unit(self.spot, self.tried, values, one) for one in self.linear] if self.tried else []
            gram = _gram(self.spot.wide(own), self.spot.plain)
        else:  # the columns that differ with the guess come between others
            found = _gram(self.spot.wide(self.spot.of(self._run(values))), self.spot.still)
            own_count = self.spot.still.shape[1] - 2
            order = np.array([*range(3, 3 + own_count), 0, 1, 3 + own_count, 4 + own_count, 2])
            gram = found[..., order[:, None], order]
        gram = np.broadcast_to(gram, (len(values), *gram.shape[1:]))
        return gram[..., :-1, :-1], gram[..., :-1, -1], gram[..., -1, -1]

    def _run(self, values: Array) -> Array:
        """Torque (3 B, N, J) of a batch of values (B, P, J), each with the moved gains."""
        assert self.tried is not None
        model, count = self.spot.model, 3 * len(values)
        batch = [np.repeat(one.values[None], count, axis=0) for one in model.applied]
        gains = np.tile(self.spot.moved, (len(values), 1, 1))
        return model.plus(self.tried).evaluate(gains, [*batch, np.repeat(values, 3, axis=0)])


@attrs.frozen(eq=False)
class _Quadratic:
    """The squared error of each guess and joint over a change d (4,) of gains and delays: e - 2 g d + d H d.

    The linear parameters are at their best, la - LX d, or 0 where that is outside of their bounds (then `plain`).
    """

    error: Array  # (S, J)
    gradient: Array  # (S, J, 4)
    hessian: Array  # (S, J, 4, 4)
    local: Array  # (S, J, K)
    follows: Array  # (S, J, K, 4)
    plain: tuple[Array, Array, Array]

    @classmethod
    def of(cls, gram: Array, right: Array, square: Array, count: int) -> _Quadratic:
        """`count` linear parameters come first among the columns."""
        mine, cross, rest = gram[..., :count, :count], gram[..., :count, count:], gram[..., count:, count:]
        size = np.einsum("sjkk->sjk", mine)
        mine = mine + np.eye(count) * (1e-8 * size[..., None] + 1e-12)
        local = np.linalg.solve(mine, right[..., :count, None])[..., 0]
        follows = np.linalg.solve(mine, cross)
        back = cross.swapaxes(-1, -2)
        plain = square, right[..., count:], rest
        return cls(
            square - np.einsum("sjk,sjk->sj", right[..., :count], local),
            right[..., count:] - (back @ local[..., None])[..., 0],
            rest - back @ follows,
            local,
            follows,
            plain,
        )

    def alone(self) -> Array:
        """Error (S, J) with a change for each joint."""
        size = np.einsum("sjkk->sjk", self.hessian)
        ridged = self.hessian + np.eye(4) * (1e-6 * size[..., None] + 1e-12)
        best = np.linalg.solve(ridged, self.gradient[..., None])[..., 0]
        error: Array = self.error - np.einsum("sjk,sjk->sj", self.gradient, best)
        return error

    def at(self, change: Array, bounds: Array) -> tuple[Array, Array, Bools]:
        """With the change (4, J): error (S, J), linear parameters (S, J, K), and where these would be out of bounds."""
        d = change.T
        values = self.local - np.einsum("sjka,ja->sjk", self.follows, d)
        outside = np.zeros(self.error.shape, dtype=bool)
        if len(bounds):
            outside = ((values < bounds[:, 0]) | (values > bounds[:, 1])).any(axis=-1)
        error, plain = (
            e - 2.0 * np.einsum("sja,ja->sj", g, d) + np.einsum("ja,sjab,jb->sj", d, h, d)
            for e, g, h in ((self.error, self.gradient, self.hessian), self.plain)
        )
        return np.where(outside, plain, error), np.where(outside[..., None], 0.0, values), outside

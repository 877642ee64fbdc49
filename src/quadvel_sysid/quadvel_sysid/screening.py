"""Which candidates are worth a fit: a score test of each, profiled over the delays.

An effect that the model lacks bends the gains and delays that were fitted without it. So candidates are looked at on a
grid of delays, where the model is linear in its gains, in small changes of the delays and in the weights of its laws. What
these explain is projected out of the residual and of the candidate's regressors (Frisch, Waugh and Lovell); what the
regressors then explain of the residual is the candidate's promise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw, Stage

from .criterion import PER_PARAMETER
from .fit import RIDGE
from .library import Context, SignalTerm, complexity, may_act
from .model import LONGEST, Applied, Model, Unknowns, jacobian, linear_columns
from .parallel import side_by_side
from .signals import Array, scattered

_SHIFTS = (-0.006, -0.004, -0.002, 0.0, 0.002, 0.004, 0.006, 0.008)
_FEW_SHIFTS = (0.0,)
_OUTPUTS = (0.0005, 0.0025, 0.0045)
"""s: the grid of delays, as changes of their sum and as output delays"""
_FARTHEST = 0.0015
"""s, that slopes along the delays are followed between points of the grid"""
_ROWS = 1500
"""Of each joint that a score test looks at"""
_BATCH = 8
"""Starting values evaluated at once"""
_LEAST = 1e-3
"""Of the error: less than that a score test does not promise to leave"""
_AMPLITUDE = (0.7, 1.4)
"""Times a start that is not linear: how far it is followed"""


@attrs.frozen(eq=False)
class Screened:
    """A candidate at its best starting values and delays."""

    model: Model
    """with the candidate as its last law"""
    promise: float
    """what it takes off the criterion"""

    @property
    def law(self) -> EffectLaw:
        return self.model.applied[-1].law


class Screen:
    """The model that candidates are held against, on some of the fitted rows.

    Laws that remember are followed over all rows; for others these rows are enough.
    """

    def __init__(self, context: Context, cores: int = 1) -> None:
        """`cores` that share the work."""
        self.context, self._cores = context, cores
        self.joints = context.samples.joints
        fitted = np.flatnonzero(context.parts.fit.any(axis=1))
        self.rows = fitted[scattered(len(fitted), max(1, len(fitted) // _ROWS))]
        self.weight = np.where(context.parts.fit[self.rows], 1.0, 0.0) / np.sqrt(context.noise)
        """(n, J): rows that are fitted, in units of the noise"""
        self.few = context.samples.taken(self.rows)
        """the rows that are looked at, alone"""
        self._remembers = any(one.law.remembers for one in context.model.applied)
        shifts = _FEW_SHIFTS if self._remembers else _SHIFTS
        self._grid = [context.model, *_around(context.model, shifts)]
        """the model as it is, and at the points of the grid of delays"""
        self._here: dict[bool, _Spot] = {}

    def laws(self, candidates: Iterable[EffectLaw]) -> list[Screened]:
        """Laws, each at the point of the grid where it promises most."""
        asked = [(law, table) for law in candidates if (table := self._table(law)) is not None]

        def at(k: int) -> tuple[Array, list[tuple[Model, Array]]]:
            spots = self._spots(k, (law for law, _ in asked))
            return spots[False].bare, [spots[law.remembers].best(law, table) for law, table in asked]

        found = side_by_side(at, len(self._grid), self._cores, self.context.samples)
        self.bare = np.min([bare for bare, _ in found], axis=0)
        return [
            max((self._promised(*one) for one in points), key=lambda one: one.promise)
            for points in zip(*(each for _, each in found), strict=True)
        ]

    def terms(self, candidates: Sequence[SignalTerm]) -> list[Screened]:
        """Terms, at the delays of the model."""
        self.prepare(candidates)
        return side_by_side(
            lambda k: self.term(candidates[k]), len(candidates), self._cores, self.context.samples
        )

    def prepare(self, candidates: Iterable[SignalTerm]) -> None:
        """Do now what `term` needs for all of these."""
        self._here = self._spots(0, candidates)
        self.bare  # noqa: B018

    def term(self, law: SignalTerm) -> Screened:
        """One of the terms that were prepared for."""
        table = np.zeros((1, law.shape.count, len(self.joints)))
        return self._promised(*self._here[law.remembers].best(law, table))

    @cached_property
    def bare(self) -> Array:
        """Squared error (J,) of the model without a candidate, at its best delays."""
        bare = side_by_side(
            lambda k: self._spots(k)[False].bare, len(self._grid), self._cores, self.context.samples
        )
        least: Array = np.min(bare, axis=0)
        return least

    def _spots(self, k: int, candidates: Iterable[EffectLaw] = ()) -> dict[bool, _Spot]:
        """A point of the grid, for laws that remember and for others, where these are asked for."""
        model, few = self._grid[k], attrs.evolve(self._grid[k], samples=self.few)
        if self._remembers:
            return dict.fromkeys((False, True), _Spot(self, model, whole=True))
        spots = {False: _Spot(self, few, whole=False)}
        if any(law.remembers for law in candidates):
            spots[True] = _Spot(self, model, whole=True)
        return spots

    def _promised(self, model: Model, error: Array) -> Screened:
        """A candidate at its best start, and the squared error (J,) that it leaves."""
        law = model.applied[-1].law
        fall = np.maximum(self.bare - error, 0.0) * may_act(law, self.joints)
        gain = -np.log(np.maximum(1.0 - fall / np.maximum(self.bare, 1e-300), _LEAST))
        promise = float(np.sum(np.maximum(gain - PER_PARAMETER * complexity(law), 0.0)))
        return Screened(model, promise)

    def _table(self, law: EffectLaw) -> Array | None:
        """The starting values (S, P, J) of a law; None where there are none."""
        context, joints = self.context, len(self.joints)
        starts = law.starts(context.signals, context.torque, context.residual)
        rows = [
            [np.broadcast_to(one.get(p.name, p.scale), joints).clip(p.low, p.high) for p in law.parameters]
            for one in starts
        ]
        return np.array(rows) if rows else None


def _around(model: Model, shifts: Sequence[float]) -> Iterator[Model]:
    """The model at the points of the grid of delays."""
    total = model.delays.sum(axis=0)
    for shift in shifts:
        for output in _OUTPUTS:
            delays = np.stack([total + shift - output, np.full_like(total, output)])
            if (delays > -1e-9).all() and (delays <= LONGEST[:, None] + 1e-9).all():
                yield model.with_delays(delays)


class _Spot:
    """The model at one pair of delays: what its own slopes explain is projected out of everything."""

    def __init__(self, screen: Screen, model: Model, whole: bool) -> None:
        self.screen, self.model = screen, model
        self.rows = screen.rows if whole else slice(None)
        unknowns = Unknowns.of(model)
        predicted, slopes = jacobian(model, unknowns)
        rows, weight = self.rows, screen.weight
        left = (model.samples.tau - predicted)[rows] * weight  # (n, J)
        slopes = slopes[:, :, rows] * weight.T[:, None]  # (J, A, n)
        shared = [0, 1, slopes.shape[1] - 2, slopes.shape[1] - 1]
        own = slopes[:, 2:-2]
        self.basis = [_basis(one[np.linalg.norm(one, axis=1) > 0.0]) for one in own]  # of each joint (n, k)
        self.left = self.project(left.T[:, None])[:, 0]  # (J, n)
        self.shared = self.project(slopes[:, shared])  # (J, 4, n)
        groups = np.array([model.gain_groups, model.gain_groups, model.delay_groups, model.delay_groups])
        offsets = np.cumsum([0, *(int(one.max()) + 1 for one in groups)])
        self.index, self.count = groups + offsets[:4, None], int(offsets[4])

    def project(self, columns: Array) -> Array:
        """Columns (J, ..., n) without what the laws of the model explain on each joint."""
        return np.stack([c - (c @ q) @ q.T for c, q in zip(columns, self.basis, strict=True)])

    @cached_property
    def bare(self) -> Array:
        """Squared error (J,) of the model alone, gains and delays at their best."""
        joints = len(self.left)
        error, _, _ = self._solve(np.zeros((1, joints, 0, self.left.shape[1])), None)
        return error

    @cached_property
    def torque(self) -> Array:
        return self.model.predict()

    def driven(self, one: Applied) -> Array:
        """What an added law is given; kept, as every law asks."""
        if one.last:
            return self.model.driven(one)
        if not hasattr(self, "_x"):
            self._x = self.model.driven(one)
        return self._x

    def columns(self, law: EffectLaw, table: Array) -> Array:
        """The regressors of a law at starting values (S, P, J): (S, J, L, n)."""
        joints = self.left.shape[0]
        every = np.ones(joints, dtype=bool)
        found = []
        model, groups = self.model, np.arange(joints)
        if law.stage == Stage.ADDED:
            x, rows = self.driven(Applied(law, every, table[0], groups)), self.rows
            if len(x) > len(self.screen.rows) and not law.remembers:
                x, rows = x[rows], slice(None)
                model = attrs.evolve(model, samples=self.screen.few)
            for values in table:
                one = Applied(law, every, values, groups)
                found.append(linear_columns(model, one, x)[:, rows].transpose(2, 0, 1))
        else:
            base = self.torque
            for first in range(0, len(table), _BATCH):
                values = table[first : first + _BATCH]
                grown = model.plus(Applied(law, every, values[0], groups))
                batch = [np.repeat(one.values[None], len(values), axis=0) for one in model.applied]
                torque = grown.evaluate(np.repeat(model.gains[None], len(values), axis=0), [*batch, values])
                found += list((torque - base)[:, self.rows].transpose(0, 2, 1)[:, :, None])
        return np.stack(found) * self.screen.weight.T[None, :, None]

    def best(self, law: EffectLaw, table: Array) -> tuple[Model, Array]:
        """The model with the law at the best of its starting values for each joint, and the squared error (J,) there."""
        columns = self.columns(law, table)
        columns = np.stack([self.project(one) for one in columns])
        error, choice, (change, weights) = self._solve(columns, law, getattr(law, "penalty", None))
        return self._started(law, table, choice, change, weights), error

    def _solve(
        self, columns: Array, law: EffectLaw | None, penalty: Array | None = None
    ) -> tuple[Array, Array, tuple[Array, Array]]:
        """Squared error (J,), the best start of each joint, the shared change (4, J) and the columns' weights (J, L)."""
        joints, size = columns.shape[1:3]
        cc = columns @ columns.swapaxes(-1, -2)
        scale = np.einsum("sjll->sj", cc)[..., None, None] / max(size, 1)
        ridge = 1e-8 * np.eye(size) if penalty is None else RIDGE * penalty
        cc = cc + ridge * scale + 1e-12 * np.eye(size)
        cr = np.einsum("sjln,jn->sjl", columns, self.left)
        cs = np.einsum("sjln,jkn->sjlk", columns, self.shared)
        follows = np.linalg.solve(cc, cs)
        local = np.linalg.solve(cc, cr[..., None])[..., 0]
        ss = self.shared @ self.shared.swapaxes(-1, -2)
        sr = np.einsum("jkn,jn->jk", self.shared, self.left)
        error = np.einsum("jn,jn->j", self.left, self.left) - np.einsum("sjl,sjl->sj", cr, local)
        gradient = sr - np.einsum("sjlk,sjl->sjk", cs, local)
        hessian = ss - np.einsum("sjlk,sjlm->sjkm", cs, follows)
        alone = error - np.einsum("sjk,sjk->sj", gradient, _solved(hessian, gradient))
        joint, choice = np.arange(joints), np.argmin(alone, axis=0)
        for _ in range(2):
            change = self._shared_change(hessian[choice, joint], gradient[choice, joint])
            weights = local - np.einsum("sjlk,kj->sjl", follows, change)
            at = (
                error
                - 2.0 * np.einsum("sjk,kj->sj", gradient, change)
                + np.einsum("kj,sjkm,mj->sj", change, hessian, change)
            )
            bounded = self._bounded(law, weights)
            off = weights - bounded
            at = at + np.einsum("sjl,sjlm,sjm->sj", off, cc, off)
            choice = np.argmin(at, axis=0)
        return at[choice, joint], choice, (change, bounded[choice, joint])

    def _bounded(self, law: EffectLaw | None, weights: Array) -> Array:
        """Weights (S, J, L) within the bounds of the linear parameters, or of the amplitude of a start."""
        if law is None:
            return weights
        if law.stage != Stage.ADDED:
            return weights.clip(*_AMPLITUDE)
        bounds = {p.name: (p.low, p.high) for p in law.parameters}
        low, high = np.array([bounds[name] for name in law.linear]).T  # type: ignore[attr-defined]
        return weights.clip(low, high)

    def _shared_change(self, hessian: Array, gradient: Array) -> Array:
        """The best change (4, J) of gains and delays, shared as the model shares them."""
        total, right = np.zeros((self.count, self.count)), np.zeros(self.count)
        for j in range(hessian.shape[0]):
            at = self.index[:, j]
            total[np.ix_(at, at)] += hessian[j]
            right[at] += gradient[j]
        change = _solved(total, right)
        far = (np.arange(self.count) >= self.index[2].min()) & (
            np.abs(change) > _FARTHEST
        )  # delays come last
        if far.any():
            change[far] = change[far].clip(-_FARTHEST, _FARTHEST)
            rest = right[~far] - total[np.ix_(~far, far)] @ change[far]
            change[~far] = _solved(total[np.ix_(~far, ~far)], rest)
        shared: Array = change[self.index]
        return shared

    def _started(self, law: EffectLaw, table: Array, choice: Array, change: Array, weights: Array) -> Model:
        """The model with the law at the chosen starts, gains and delays changed."""
        model, joint = self.model, np.arange(table.shape[2])
        values = table[choice, :, joint].T.copy()
        if law.stage == Stage.ADDED:
            linear = [law.names.index(name) for name in law.linear]  # type: ignore[attr-defined]
            values[linear] = weights.T
        groups = np.zeros(len(joint), dtype=np.intp) if law.common else joint
        one = Applied(law, may_act(law, self.screen.joints), values, groups)
        moved = attrs.evolve(model, gains=np.maximum(model.gains + change[:2], 0.0)).with_delays(
            model.delays + change[2:]
        )
        return attrs.evolve(moved.plus(one), samples=self.screen.context.samples)


def _solved(hessian: Array, gradient: Array) -> Array:
    """Solutions of systems (..., K, K), a little ridged, as some slopes may be 0."""
    size = np.einsum("...kk->...k", hessian)
    ridged = hessian + np.eye(hessian.shape[-1]) * (1e-7 * size[..., None] + 1e-12)
    solution: Array = np.linalg.solve(ridged, gradient[..., None])[..., 0]
    return solution


def _basis(columns: Array) -> Array:
    """An orthonormal basis (n, k) of columns (A, n)."""
    if not len(columns):
        return np.zeros((columns.shape[1], 0))
    q, r = np.linalg.qr((columns / np.linalg.norm(columns, axis=1, keepdims=True)).T)
    return q[:, np.abs(np.diagonal(r)) > 1e-6]


def best_first(found: Iterable[Screened]) -> Sequence[Screened]:
    """Those that promise something, the most promising one first."""
    return sorted((one for one in found if one.promise > 0.0), key=lambda one: -one.promise)

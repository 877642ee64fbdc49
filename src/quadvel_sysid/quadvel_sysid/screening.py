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

from .criterion import PENALTY_PER_PARAMETER
from .fit import RIDGE
from .library import Context, SignalTerm, complexity, may_act
from .model import MAX_DELAYS_S, AppliedEffect, Model, Unknowns, jacobian, linear_columns
from .parallel import side_by_side
from .signals import Array, scattered_rows

_TOTAL_DELAY_CHANGES_S = (-0.006, -0.004, -0.002, 0.0, 0.002, 0.004, 0.006, 0.008)
_FEW_SHIFTS = (0.0,)
_OUTPUT_DELAYS_S = (0.0005, 0.0025, 0.0045)
"""s: the grid of delays, as changes of their sum and as output delays"""
_MAX_DELAY_CHANGE_S = 0.0015
"""s, that slopes along the delays are followed between points of the grid"""
_ROWS_PER_JOINT = 1500
"""Of each joint that a score test looks at"""
_BATCH = 8
"""Starting values evaluated at once"""
_MIN_ERROR_RATIO = 1e-3
"""Of the error: less than that a score test does not promise to leave"""
_AMPLITUDE_RANGE = (0.7, 1.4)
"""Times a start that is not linear: how far it is followed"""


@attrs.frozen(eq=False)
class ScreenedCandidate:
    """A candidate at its best starting values and delays."""

    model: Model
    """with the candidate as its last law"""
    score: float
    """what it takes off the criterion"""

    @property
    def law(self) -> EffectLaw:
        return self.model.effects[-1].law


class CandidateScreening:
    """The model that candidates are held against, on some of the fitted rows.

    Laws that remember are followed over all rows; for others these rows are enough.
    """

    def __init__(self, context: Context, cores: int = 1) -> None:
        """`cores` that share the work."""
        self.context, self._cores = context, cores
        self.joints = context.samples.joints
        fitted = np.flatnonzero(context.parts.fit.any(axis=1))
        self.rows = fitted[scattered_rows(len(fitted), max(1, len(fitted) // _ROWS_PER_JOINT))]
        self.weight = np.where(context.parts.fit[self.rows], 1.0, 0.0) / np.sqrt(context.noise)
        """(n, J): rows that are fitted, in units of the noise"""
        self.screening_rows = context.samples.take_rows(self.rows)
        """the rows that are looked at, alone"""
        self._remembers = any(one.law.has_memory for one in context.model.effects)
        shifts = _FEW_SHIFTS if self._remembers else _TOTAL_DELAY_CHANGES_S
        self._grid = [context.model, *_delay_grid(context.model, shifts)]
        """the model as it is, and at the points of the grid of delays"""
        self._here: dict[bool, DelayGridPoint] = {}

    def laws(self, candidates: Iterable[EffectLaw]) -> list[ScreenedCandidate]:
        """Laws, each at the point of the grid where it promises most."""
        asked = [(law, table) for law in candidates if (table := self._start_values(law)) is not None]

        def at(k: int) -> tuple[Array, list[tuple[Model, Array]]]:
            spots = self._grid_points(k, (law for law, _ in asked))
            return spots[False].baseline_sse, [
                spots[law.has_memory].best_start(law, table) for law, table in asked
            ]

        found = side_by_side(at, len(self._grid), self._cores, self.context.samples)
        self.baseline_sse = np.min([bare for bare, _ in found], axis=0)
        return [
            max((self._scored(*one) for one in points), key=lambda one: one.score)
            for points in zip(*(each for _, each in found), strict=True)
        ]

    def terms(self, candidates: Sequence[SignalTerm]) -> list[ScreenedCandidate]:
        """Terms, at the delays of the model."""
        self.prepare(candidates)
        return side_by_side(
            lambda k: self.term(candidates[k]), len(candidates), self._cores, self.context.samples
        )

    def prepare(self, candidates: Iterable[SignalTerm]) -> None:
        """Do now what `term` needs for all of these."""
        self._here = self._grid_points(0, candidates)
        self.baseline_sse  # noqa: B018

    def term(self, law: SignalTerm) -> ScreenedCandidate:
        """One of the terms that were prepared for."""
        table = np.zeros((1, law.shape.count, len(self.joints)))
        return self._scored(*self._here[law.has_memory].best_start(law, table))

    @cached_property
    def baseline_sse(self) -> Array:
        """Squared error (J,) of the model without a candidate, at its best delays."""
        bare = side_by_side(
            lambda k: self._grid_points(k)[False].baseline_sse,
            len(self._grid),
            self._cores,
            self.context.samples,
        )
        least: Array = np.min(bare, axis=0)
        return least

    def _grid_points(self, k: int, candidates: Iterable[EffectLaw] = ()) -> dict[bool, DelayGridPoint]:
        """A point of the grid, for laws that remember and for others, where these are asked for."""
        model, few = self._grid[k], attrs.evolve(self._grid[k], samples=self.screening_rows)
        if self._remembers:
            return dict.fromkeys((False, True), DelayGridPoint(self, model, whole=True))
        spots = {False: DelayGridPoint(self, few, whole=False)}
        if any(law.has_memory for law in candidates):
            spots[True] = DelayGridPoint(self, model, whole=True)
        return spots

    def _scored(self, model: Model, error: Array) -> ScreenedCandidate:
        """A candidate at its best start, and the squared error (J,) that it leaves."""
        law = model.effects[-1].law
        fall = np.maximum(self.baseline_sse - error, 0.0) * may_act(law, self.joints)
        gain = -np.log(np.maximum(1.0 - fall / np.maximum(self.baseline_sse, 1e-300), _MIN_ERROR_RATIO))
        promise = float(np.sum(np.maximum(gain - PENALTY_PER_PARAMETER * complexity(law), 0.0)))
        return ScreenedCandidate(model, promise)

    def _start_values(self, law: EffectLaw) -> Array | None:
        """The starting values (S, P, J) of a law; None where there are none."""
        context, joints = self.context, len(self.joints)
        starts = law.initial_guesses(context.signals, context.torque, context.residual)
        rows = [
            [np.broadcast_to(one.get(p.name, p.scale), joints).clip(p.low, p.high) for p in law.parameters]
            for one in starts
        ]
        return np.array(rows) if rows else None


def _delay_grid(model: Model, shifts: Sequence[float]) -> Iterator[Model]:
    """The model at the points of the grid of delays."""
    total = model.delays.sum(axis=0)
    for shift in shifts:
        for output in _OUTPUT_DELAYS_S:
            delays = np.stack([total + shift - output, np.full_like(total, output)])
            if (delays > -1e-9).all() and (delays <= MAX_DELAYS_S[:, None] + 1e-9).all():
                yield model.with_delays(delays)


class DelayGridPoint:
    """The model at one pair of delays: what its own slopes explain is projected out of everything."""

    def __init__(self, screen: CandidateScreening, model: Model, whole: bool) -> None:
        self.screen, self.model = screen, model
        self.rows = screen.rows if whole else slice(None)
        unknowns = Unknowns.of(model)
        predicted, slopes = jacobian(model, unknowns)
        rows, weight = self.rows, screen.weight
        left = (model.samples.tau - predicted)[rows] * weight  # (n, J)
        slopes = slopes[:, :, rows] * weight.T[:, None]  # (J, A, n)
        shared = [0, 1, slopes.shape[1] - 2, slopes.shape[1] - 1]
        own = slopes[:, 2:-2]
        self.basis = [
            _orthonormal_basis(one[np.linalg.norm(one, axis=1) > 0.0]) for one in own
        ]  # of each joint (n, k)
        self.left = self.project(left.T[:, None])[:, 0]  # (J, n)
        self.shared = self.project(slopes[:, shared])  # (J, 4, n)
        groups = np.array([model.gain_groups, model.gain_groups, model.delay_groups, model.delay_groups])
        offsets = np.cumsum([0, *(int(one.max()) + 1 for one in groups)])
        self.index, self.count = groups + offsets[:4, None], int(offsets[4])

    def project(self, columns: Array) -> Array:
        """Columns (J, ..., n) without what the laws of the model explain on each joint."""
        return np.stack([c - (c @ q) @ q.T for c, q in zip(columns, self.basis, strict=True)])

    @cached_property
    def baseline_sse(self) -> Array:
        """Squared error (J,) of the model alone, gains and delays at their best."""
        joints = len(self.left)
        error, _, _ = self._solve(np.zeros((1, joints, 0, self.left.shape[1])), None)
        return error

    @cached_property
    def torque(self) -> Array:
        return self.model.predict()

    def drive_torque(self, one: AppliedEffect) -> Array:
        """What an added law is given; kept, as every law asks."""
        if one.reads_total_torque:
            return self.model.drive_torque(one)
        if not hasattr(self, "_x"):
            self._x = self.model.drive_torque(one)
        return self._x

    def columns(self, law: EffectLaw, table: Array) -> Array:
        """The regressors of a law at starting values (S, P, J): (S, J, L, n)."""
        joints = self.left.shape[0]
        every = np.ones(joints, dtype=bool)
        found = []
        model, groups = self.model, np.arange(joints)
        if law.stage == Stage.ADDED:
            x, rows = self.drive_torque(AppliedEffect(law, every, table[0], groups)), self.rows
            if len(x) > len(self.screen.rows) and not law.has_memory:
                x, rows = x[rows], slice(None)
                model = attrs.evolve(model, samples=self.screen.screening_rows)
            for values in table:
                one = AppliedEffect(law, every, values, groups)
                found.append(linear_columns(model, one, x)[:, rows].transpose(2, 0, 1))
        else:
            base = self.torque
            for first in range(0, len(table), _BATCH):
                values = table[first : first + _BATCH]
                grown = model.with_effect(AppliedEffect(law, every, values[0], groups))
                batch = [np.repeat(one.values[None], len(values), axis=0) for one in model.effects]
                torque = grown.evaluate(np.repeat(model.gains[None], len(values), axis=0), [*batch, values])
                found += list((torque - base)[:, self.rows].transpose(0, 2, 1)[:, :, None])
        return np.stack(found) * self.screen.weight.T[None, :, None]

    def best_start(self, law: EffectLaw, table: Array) -> tuple[Model, Array]:
        """The model with the law at the best of its starting values for each joint, and the squared error (J,) there."""
        columns = self.columns(law, table)
        columns = np.stack([self.project(one) for one in columns])
        error, choice, (change, weights) = self._solve(columns, law, getattr(law, "penalty", None))
        return self._model_at_start(law, table, choice, change, weights), error

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
        alone = error - np.einsum("sjk,sjk->sj", gradient, _ridge_solve(hessian, gradient))
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
            return weights.clip(*_AMPLITUDE_RANGE)
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
        change = _ridge_solve(total, right)
        far = (np.arange(self.count) >= self.index[2].min()) & (
            np.abs(change) > _MAX_DELAY_CHANGE_S
        )  # delays come last
        if far.any():
            change[far] = change[far].clip(-_MAX_DELAY_CHANGE_S, _MAX_DELAY_CHANGE_S)
            rest = right[~far] - total[np.ix_(~far, far)] @ change[far]
            change[~far] = _ridge_solve(total[np.ix_(~far, ~far)], rest)
        shared: Array = change[self.index]
        return shared

    def _model_at_start(
        self, law: EffectLaw, table: Array, choice: Array, change: Array, weights: Array
    ) -> Model:
        """The model with the law at the chosen starts, gains and delays changed."""
        model, joint = self.model, np.arange(table.shape[2])
        values = table[choice, :, joint].T.copy()
        if law.stage == Stage.ADDED:
            linear = [law.names.index(name) for name in law.linear]  # type: ignore[attr-defined]
            values[linear] = weights.T
        groups = np.zeros(len(joint), dtype=np.intp) if law.shared_by_joints else joint
        one = AppliedEffect(law, may_act(law, self.screen.joints), values, groups)
        moved = attrs.evolve(model, gains=np.maximum(model.gains + change[:2], 0.0)).with_delays(
            model.delays + change[2:]
        )
        return attrs.evolve(moved.with_effect(one), samples=self.screen.context.samples)


def _ridge_solve(hessian: Array, gradient: Array) -> Array:
    """Solutions of systems (..., K, K), a little ridged, as some slopes may be 0."""
    size = np.einsum("...kk->...k", hessian)
    ridged = hessian + np.eye(hessian.shape[-1]) * (1e-7 * size[..., None] + 1e-12)
    solution: Array = np.linalg.solve(ridged, gradient[..., None])[..., 0]
    return solution


def _orthonormal_basis(columns: Array) -> Array:
    """An orthonormal basis (n, k) of columns (A, n)."""
    if not len(columns):
        return np.zeros((columns.shape[1], 0))
    q, r = np.linalg.qr((columns / np.linalg.norm(columns, axis=1, keepdims=True)).T)
    return q[:, np.abs(np.diagonal(r)) > 1e-6]


def best_first(found: Iterable[ScreenedCandidate]) -> Sequence[ScreenedCandidate]:
    """Those that promise something, the most promising one first."""
    return sorted((one for one in found if one.score > 0.0), key=lambda one: -one.score)

"""Screening of candidate effects: a linearised score test, profiled over a grid of delays.

A missing effect biases the gains and delays that were fitted without it. At each grid point the
model is linear in the gains, in small changes of the delays, and in the weights of the effects. Their
columns are projected out of the residual and of the candidate's regressors (Frisch, Waugh and
Lovell). The reduction of the squared error by the projected regressors gives the candidate's score.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array, Indices

from ..data.signals import Samples, scattered_rows
from ..model.applied_effect import AppliedEffect
from ..model.effect_candidate import EffectCandidate
from ..model.fit import RIDGE
from ..model.jacobian import Unknowns, jacobian
from ..model.torque_model import MAX_DELAYS_S, Model
from ..parallel import parallel_map
from ..statistics.criterion import PENALTY_PER_PARAMETER
from .context import Context
from .regressors import RegressorCandidate

_TOTAL_DELAY_CHANGES_S = (-0.006, -0.004, -0.002, 0.0, 0.002, 0.004, 0.006, 0.008)
_NO_DELAY_CHANGES_S = (0.0,)
_OUTPUT_DELAYS_S = (0.0005, 0.0025, 0.0045)
"""Grid of delays, s: changes of their sum, and output delays."""
_ONE_GRID_POINT = (0.0,), (0.0025,)
"""The same, if only one other pair of delays is tried."""
_FIRST_POINTS_S = (-0.004, 0.0, 0.004)
"""Changes of the sum of delays, s, at which every effect is scored, at the middle output delay."""
_PROFILED_EFFECTS = 16
"""Best forms of effects after these points; only they are scored on the whole grid."""
_MAX_DELAY_CHANGE_S = 0.0015
"""Range, s, of the linearisation along the delays around a grid point."""
_ROWS_PER_JOINT = 1500
"""Rows of each joint that the score test uses."""
_BATCH_SIZE = 8
"""Batch size of starting values."""
_MIN_ERROR_RATIO = 1e-3
"""Lower bound of the remaining error in the score, relative to the error before."""
_ROUNDING = 1e-14
"""Rounding error of products of columns, relative to their diagonal."""
_AMPLITUDE_RANGE = (0.7, 1.4)
"""Range of the amplitude of a nonlinear effect, relative to its starting values."""


@attrs.frozen(eq=False)
class ScreenedCandidate:
    """A candidate at its best starting values and delays.

    Attributes:
        model: Model with the candidate as its last effect.
        score: Expected reduction of the criterion of `statistics.criterion`.
    """

    model: Model
    score: float

    @property
    def candidate(self) -> EffectCandidate:
        """The candidate."""
        return self.model.effects[-1].candidate


@attrs.frozen(eq=False)
class ScreeningRows:
    """The subset of the fitted rows on which candidates are scored.

    Attributes:
        all_samples: Samples of all rows.
        rows: Row numbers of the subset, (n,).
        samples: Samples of the subset.
        weight: Inverse standard deviation of the noise on fitted samples, 0 on others, (n, J), 1/(N
            m).
    """

    all_samples: Samples
    rows: Indices
    samples: Samples
    weight: Array

    @classmethod
    def of(cls, context: Context) -> ScreeningRows:
        """Choose the rows.

        Args:
            context: Model to extend, and its data.

        Returns:
            About `_ROWS_PER_JOINT` rows.
        """
        fit = context.parts.fit
        fitted = np.flatnonzero(fit.any(axis=1))
        rows = fitted[scattered_rows(len(fitted), max(1, len(fitted) // _ROWS_PER_JOINT))]
        weight = np.where(fit[rows], 1.0, 0.0) / np.sqrt(context.noise)
        return cls(context.samples, rows, context.samples.take_rows(rows), weight)


class CandidateScreening:
    """Scores candidate effects on a subset of the fitted rows.

    Effects with memory are simulated over all rows, and compared on the subset.
    """

    def __init__(self, context: Context, cores: int = 1) -> None:
        """Choose the rows and the grid of delays; the work is done on first use.

        Args:
            context: Model to extend, and its data.
            cores: Worker processes.
        """
        self._context, self._cores, self._rows = context, cores, ScreeningRows.of(context)
        self._has_memory = any(one.candidate.has_memory for one in context.model.effects)
        shifts = _NO_DELAY_CHANGES_S if self._has_memory else _TOTAL_DELAY_CHANGES_S
        grid = (shifts, _OUTPUT_DELAYS_S) if context.options.screening_grid else _ONE_GRID_POINT
        self._grid = [context.model, *_delay_grid(context.model, *grid)]

    def screen_effects(self, candidates: Iterable[EffectCandidate]) -> list[ScreenedCandidate]:
        """Score effects on the grid of delays: all at a few points, the best of them at every point.

        Args:
            candidates: Effects, in all their forms.

        Returns:
            Each effect at its best grid point; effects without starting values are left out.
        """
        with_starts = [(one, table) for one in candidates if (table := self._start_values(one)) is not None]
        first = self._first_points
        found = self._screen_at(first, with_starts)
        best = sorted(range(len(found)), key=lambda k: -found[k].score)[:_PROFILED_EFFECTS]
        others = [k for k in range(len(self._grid)) if k not in first]
        for k, one in zip(best, self._screen_at(others, [with_starts[k] for k in best]), strict=False):
            found[k] = max(found[k], one, key=lambda each: each.score)
        return found

    @property
    def _first_points(self) -> list[int]:
        """Grid points at which every effect is scored, the delays of the model first."""
        own, middle = self._context.model.delays, _OUTPUT_DELAYS_S[len(_OUTPUT_DELAYS_S) // 2]
        totals = own.sum(axis=0) + np.array(_FIRST_POINTS_S)[:, None]
        return [0] + [
            k
            for k, one in enumerate(self._grid)
            if k
            and (np.abs(one.delays.sum(axis=0) - totals) < 1e-6).all(axis=1).any()
            and np.allclose(one.delays[1], middle)
        ]

    def _screen_at(
        self, grid: Sequence[int], with_starts: Sequence[tuple[EffectCandidate, Array]]
    ) -> list[ScreenedCandidate]:
        """Each effect, with its starting values (S, P, J), at the best of some grid points."""
        with_memory = any(one.has_memory for one, _ in with_starts)
        points = self._points  # before the map, so that its processes share them

        def solve_at(k: int) -> list[tuple[Model, Array]]:
            here = {False: points[k], True: self._all_rows_point(k) if with_memory else points[k]}
            return [here[one.has_memory].best_start(one, table) for one, table in with_starts]

        # Profile over the delays: each effect is scored at its own best grid point.
        found = parallel_map(lambda k: solve_at(grid[k]), len(grid), self._cores, self._context.samples)
        return [
            max((self._scored(*solution) for solution in of_effect), key=lambda one: one.score)
            for of_effect in zip(*found, strict=True)
        ]

    def screen_regressors(self, candidates: Sequence[RegressorCandidate]) -> list[ScreenedCandidate]:
        """Score regressors of named signals at the delays of the model.

        Args:
            candidates: Regressors.

        Returns:
            The scored regressors, in the same order.
        """
        points = self._model_points  # before the map, so that its processes share them
        return parallel_map(
            lambda k: self._score(candidates[k], points),
            len(candidates),
            self._cores,
            self._context.samples,
        )

    def screen_regressor(self, candidate: RegressorCandidate) -> ScreenedCandidate:
        """Score one regressor of a named signal at the delays of the model.

        Args:
            candidate: The regressor.

        Returns:
            The scored regressor.
        """
        return self._score(candidate, self._model_points)

    def _score(
        self, candidate: RegressorCandidate, points: Mapping[bool, DelayGridPoint]
    ) -> ScreenedCandidate:
        """Score a regressor, whose weights start from 0."""
        table = np.zeros((1, len(candidate.names), len(self._context.samples.joints)))
        return self._scored(*points[candidate.has_memory].best_start(candidate, table))

    @cached_property
    def _model_points(self) -> dict[bool, DelayGridPoint]:
        """The model at its own delays, by whether a candidate has memory."""
        return {False: self._points[0], True: self._all_rows_point(0)}

    @cached_property
    def _points(self) -> list[DelayGridPoint]:
        """The model at each point of the grid; on the subset unless its effects have memory."""
        return [DelayGridPoint(self._rows, model, self._has_memory) for model in self._grid]

    def _all_rows_point(self, k: int) -> DelayGridPoint:
        """The model at one point of the grid, on all rows."""
        return self._points[k] if self._has_memory else DelayGridPoint(self._rows, self._grid[k], True)

    @cached_property
    def baseline_sse(self) -> Array:
        """Weighted squared error (J,) of the model without a candidate, at its best delays."""
        least: Array = np.min([point.baseline_sse for point in self._points], axis=0)
        return least

    def _scored(self, model: Model, error: Array) -> ScreenedCandidate:
        """A candidate at its best start, with the score of its squared error (J,)."""
        # Score = sum over joints of max(ln(SSE_0 / SSE) - cost, 0): the fall of the criterion.
        one = model.effects[-1].candidate
        allowed = one.allowed_joints(self._context.samples.joints)
        reduction = np.maximum(self.baseline_sse - error, 0.0) * allowed
        ratio = 1.0 - reduction / np.maximum(self.baseline_sse, 1e-300)
        gain = -np.log(np.maximum(ratio, _MIN_ERROR_RATIO))
        cost = PENALTY_PER_PARAMETER * one.complexity(self._context.options.memory_cost)
        score = float(np.sum(np.maximum(gain - cost, 0.0)))
        return ScreenedCandidate(model, score)

    def _start_values(self, candidate: EffectCandidate) -> Array | None:
        """Starting values (S, P, J) of a candidate; None if there are none."""
        context, joints = self._context, len(self._context.samples.joints)
        starts = candidate.initial_guesses(context.signals, context.torque, context.residual)
        rows = [
            [
                np.broadcast_to(one.get(p.name, p.scale), joints).clip(p.low, p.high)
                for p in candidate.parameters
            ]
            for one in starts
        ]
        return np.array(rows) if rows else None


def _delay_grid(model: Model, shifts: Sequence[float], outputs: Sequence[float]) -> Iterator[Model]:
    """The model at the grid points within the bounds of the delays."""
    total = model.delays.sum(axis=0)
    for shift in shifts:
        for output in outputs:
            delays = np.stack([total + shift - output, np.full_like(total, output)])
            if (delays > -1e-9).all() and (delays <= MAX_DELAYS_S[:, None] + 1e-9).all():
                yield model.with_delays(delays)


class DelayGridPoint:
    """Linearised model at one pair of delays, with the columns of its own effects projected out.

    Attributes:
        model: The model at this pair of delays.
        basis: Orthonormal basis of the derivatives of the model's effects, (n, k) for each joint.
        residual: Weighted, projected residual, (J, n).
        shared_slopes: Weighted, projected derivatives along both gains and both delays, (J, 4, n).
        index: Unknown of each of these on each joint, (4, J); shared as the model shares them.
        count: Number of these unknowns.
    """

    def __init__(self, rows: ScreeningRows, model: Model, all_rows: bool) -> None:
        """Linearise the model.

        Args:
            rows: The subset on which candidates are scored.
            model: The model at this pair of delays.
            all_rows: Whether to evaluate the model on all rows, which effects with memory need,
                rather than on the subset alone.
        """
        self._screening = rows
        self.model = model if all_rows else attrs.evolve(model, samples=rows.samples)
        self._rows = rows.rows if all_rows else slice(None)  # within the samples of the model
        unknowns = Unknowns.of(self.model)
        predicted, slopes = jacobian(self.model, unknowns)
        residual = (self.model.samples.tau - predicted)[self._rows] * rows.weight  # (n, J)
        slopes = slopes[:, :, self._rows] * rows.weight.T[:, None]  # (J, A, n)
        averaged = self.model.averaged_noise()[self._rows] * rows.weight**2
        self._averaged = np.sum(averaged, axis=0)  # (J,), as in `squared_error`

        # Parameters of effects belong to one joint each: with an orthonormal basis B of their
        # columns every other column c becomes (I - B B') c. Gains and delays are shared by joints
        # and stay columns.
        shared_slots = [0, 1, slopes.shape[1] - 2, slopes.shape[1] - 1]
        self.basis = [
            _orthonormal_basis(one[np.linalg.norm(one, axis=1) > 0.0]) for one in slopes[:, 2:-2]
        ]  # of each joint (n, k)
        self.residual = self.project_out(residual.T[:, None])[:, 0]  # (J, n)
        self.shared_slopes = self.project_out(slopes[:, shared_slots])  # (J, 4, n)

        # Numbers of the unknowns: two gains, then two delays, one for each group of joints.
        groups = np.array([model.gain_groups, model.gain_groups, model.delay_groups, model.delay_groups])
        offsets = np.cumsum([0, *(int(one.max()) + 1 for one in groups)])
        self.index, self.count = groups + offsets[:4, None], int(offsets[4])

    def project_out(self, columns: Array) -> Array:
        """Project the effects of the model out of columns.

        Args:
            columns: Columns, (J, ..., n).

        Returns:
            Columns orthogonal to the basis of each joint, (J, ..., n).
        """
        return np.stack([c - (c @ q) @ q.T for c, q in zip(columns, self.basis, strict=True)])

    @cached_property
    def baseline_sse(self) -> Array:
        """Weighted squared error (J,) of the model alone, with the best gains and delays."""
        joints = len(self.residual)
        error, _, _ = self._solve(np.zeros((1, joints, 0, self.residual.shape[1])), None)
        return error + self._averaged

    @cached_property
    def torque(self) -> Array:
        """Predicted torque, (N, J), N m."""
        return self.model.predict()

    @cached_property
    def _drive_torque(self) -> Array:
        """Torque of the drive, (N, J), N m."""
        return self.model.drive_torque()

    def regressors(self, candidate: EffectCandidate, table: Array) -> Array:
        """Compute the weighted regressors of a candidate at its starting values.

        An added effect has one regressor per linear parameter. Others have a single one, the change
        of the torque that they cause.

        Args:
            candidate: The candidate.
            table: Starting values, (S, P, J).

        Returns:
            Regressors, (S, J, L, n).
        """
        joints = self.residual.shape[0]
        found: list[Array] = []
        model, every, groups = self.model, np.ones(joints, dtype=bool), np.arange(joints)
        if candidate.linear:
            # Regressors phi_l of tau = ... + sum_l w_l phi_l, at the starts of the other
            # parameters.
            x, rows = self._drive_torque, self._rows
            if candidate.reads_total_torque:
                x = model.input_torque(candidate)
            if len(x) > len(self._screening.rows) and not candidate.has_memory:
                x, rows = x[rows], slice(None)
                model = attrs.evolve(model, samples=self._screening.samples)
            for values in table:
                effect = AppliedEffect(candidate, every, values, groups)
                found.append(model.linear_columns(effect, x)[:, rows].transpose(2, 0, 1))
        else:
            # d tau = tau(with the effect at its start) - tau, for an amplitude of 1.
            base = self.torque
            for first in range(0, len(table), _BATCH_SIZE):
                values = table[first : first + _BATCH_SIZE]
                extended = model.with_effect(AppliedEffect(candidate, every, values[0], groups))
                batch = [np.repeat(effect.values[None], len(values), axis=0) for effect in model.effects]
                torque = extended.evaluate(
                    np.repeat(model.gains[None], len(values), axis=0), [*batch, values]
                )
                found += list((torque - base)[:, self._rows].transpose(0, 2, 1)[:, :, None])
        weighted = np.empty((len(found), *found[0].shape))
        for out, columns in zip(weighted, found, strict=True):
            np.multiply(columns, self._screening.weight.T[:, None], out=out)
        return weighted

    def best_start(self, candidate: EffectCandidate, table: Array) -> tuple[Model, Array]:
        """Find the best starting values of a candidate on each joint.

        Args:
            candidate: The candidate.
            table: Starting values, (S, P, J).

        Returns:
            Model with the candidate at its best start, and the remaining weighted squared error (J,).
        """
        error, choice, (change, weights) = self._solve(self.regressors(candidate, table), candidate)
        return self._model_at_start(candidate, table, choice, change, weights), error + self._averaged

    def _solve(
        self, columns: Array, candidate: EffectCandidate | None
    ) -> tuple[Array, Array, tuple[Array, Array]]:
        """Solve the linear least-squares problem of each joint and start.

        Returns the squared error (J,), the best start of each joint, the change (4, J) of gains and
        delays, and the weights (J, L) of the regressors.
        """
        # Linear model of joint j at start s: residual r = C'w + S'b + noise, with the regressors
        # C (L, n) and weights w of the candidate, and the derivatives S (4, n) and changes b of
        # gains and delays. cc, cr, cs, ss and sr are the products C C', C r, C S', S S' and S r. With
        # the basis B of the model's effects, (I - B B') C' has the products C C' - C B (C B)', C r and
        # C S', as r and S are orthogonal to B.
        joints, size = columns.shape[1:3]
        penalty = None if candidate is None else candidate.penalty
        cc = columns @ columns.swapaxes(-1, -2)
        total = np.einsum("sjll->sj", cc)[..., None, None]
        for j, basis in enumerate(self.basis):
            within = columns[:, j] @ basis  # (S, L, k)
            cc[:, j] -= within @ within.swapaxes(-1, -2)
        cc = cc + _ROUNDING * total * np.eye(size)
        scale = np.einsum("sjll->sj", cc)[..., None, None] / max(size, 1)
        ridge = 1e-8 * np.eye(size) if penalty is None else RIDGE * penalty
        cc = cc + ridge * scale + 1e-12 * np.eye(size)
        cr = (columns @ self.residual[:, :, None])[..., 0]
        cs = columns @ self.shared_slopes.swapaxes(-1, -2)
        solved = np.linalg.solve(cc, np.concatenate([cs, cr[..., None]], axis=-1))
        cc_cs, local = solved[..., :-1], solved[..., -1]
        ss = self.shared_slopes @ self.shared_slopes.swapaxes(-1, -2)
        sr = np.einsum("jkn,jn->jk", self.shared_slopes, self.residual)

        # For given b the best weights are w = cc^-1 (cr - cs b). The reduced problem in b is
        #     error(b) = r'r - cr'cc^-1 cr - 2 g'b + b'H b
        #     g = sr - cs'cc^-1 cr,   H = ss - cs'cc^-1 cs
        # (the Schur complement of cc in the normal equations).
        error = np.einsum("jn,jn->j", self.residual, self.residual) - np.einsum("sjl,sjl->sj", cr, local)
        gradient = sr - np.einsum("sjlk,sjl->sjk", cs, local)
        hessian = ss - np.einsum("sjlk,sjlm->sjkm", cs, cc_cs)

        # The best start of each joint depends on b, which joints share. Alternate twice: begin with
        # a separate b of each joint, solve b for the chosen starts, and choose the starts again.
        joint_error = error - np.einsum("sjk,sjk->sj", gradient, _ridge_solve(hessian, gradient))
        joint, choice = np.arange(joints), np.argmin(joint_error, axis=0)
        for _ in range(2):
            change = self._shared_change(hessian[choice, joint], gradient[choice, joint])
            weights = local - np.einsum("sjlk,kj->sjl", cc_cs, change)
            shared_error = (
                error
                - 2.0 * np.einsum("sjk,kj->sj", gradient, change)
                + np.einsum("kj,sjkm,mj->sj", change, hessian, change)
            )
            # Clipping the weights by v raises the error by v'cc v, as w was the minimum.
            bounded = self._bounded(candidate, weights)
            clipped = weights - bounded
            shared_error = shared_error + np.einsum("sjl,sjlm,sjm->sj", clipped, cc, clipped)
            choice = np.argmin(shared_error, axis=0)
        return shared_error[choice, joint], choice, (change, bounded[choice, joint])

    def _bounded(self, candidate: EffectCandidate | None, weights: Array) -> Array:
        """Clip weights (S, J, L) to the parameter bounds, or to the amplitude range."""
        if candidate is None:
            return weights
        if not candidate.linear:
            return weights.clip(*_AMPLITUDE_RANGE)
        bounds = {p.name: (p.low, p.high) for p in candidate.parameters}
        low, high = np.array([bounds[name] for name in candidate.linear]).T
        return weights.clip(low, high)

    def _shared_change(self, hessian: Array, gradient: Array) -> Array:
        """Best change (4, J) of gains and delays, shared by joints as in the model."""
        # Sum of the joints' normal equations H b = g, in the unknowns that they share.
        total, right = np.zeros((self.count, self.count)), np.zeros(self.count)
        at = self.index.T
        np.add.at(total, (at[:, :, None], at[:, None, :]), hessian)
        np.add.at(right, at, gradient)
        change = _ridge_solve(total, right)
        # Delays, the last unknowns, stay in the range of the linearisation; the gains follow them.
        is_delay = np.arange(self.count) >= self.index[2].min()
        beyond = is_delay & (np.abs(change) > _MAX_DELAY_CHANGE_S)
        if beyond.any():
            change[beyond] = change[beyond].clip(-_MAX_DELAY_CHANGE_S, _MAX_DELAY_CHANGE_S)
            remaining = right[~beyond] - total[np.ix_(~beyond, beyond)] @ change[beyond]
            change[~beyond] = _ridge_solve(total[np.ix_(~beyond, ~beyond)], remaining)
        shared: Array = change[self.index]
        return shared

    def _model_at_start(
        self, candidate: EffectCandidate, table: Array, choice: Array, change: Array, weights: Array
    ) -> Model:
        """The model with the candidate at the selected starts and with changed gains and delays."""
        model, joint, all_samples = self.model, np.arange(table.shape[2]), self._screening.all_samples
        values = table[choice, :, joint].T.copy()
        if candidate.linear:
            values[[candidate.names.index(name) for name in candidate.linear]] = weights.T
        groups = np.zeros(len(joint), dtype=np.intp) if candidate.shared_by_joints else joint
        effect = AppliedEffect(candidate, candidate.allowed_joints(all_samples.joints), values, groups)
        extended = model.with_effect(effect).with_delays(model.delays + change[2:])
        gains = np.maximum(model.gains + change[:2], 0.0)
        gains = np.where(extended.holds_gains, model.gains, gains)
        return attrs.evolve(extended, gains=gains, samples=all_samples)


def _ridge_solve(hessian: Array, gradient: Array) -> Array:
    """Solve systems (..., K, K) with a small ridge, as some derivatives may be 0."""
    size = np.einsum("...kk->...k", hessian)
    ridged = hessian + np.eye(hessian.shape[-1]) * (1e-7 * size[..., None] + 1e-12)
    solution: Array = np.linalg.solve(ridged, gradient[..., None])[..., 0]
    return solution


def _orthonormal_basis(columns: Array) -> Array:
    """Orthonormal basis (n, k) of columns (A, n), without dependent ones."""
    if not len(columns):
        return np.zeros((columns.shape[1], 0))
    q, r = np.linalg.qr((columns / np.linalg.norm(columns, axis=1, keepdims=True)).T)
    return q[:, np.abs(np.diagonal(r)) > 1e-6]


def promising(found: Iterable[ScreenedCandidate]) -> Sequence[ScreenedCandidate]:
    """Select the candidates with a positive score.

    Args:
        found: Scored candidates.

    Returns:
        Candidates in descending order of their score.
    """
    return sorted((one for one in found if one.score > 0.0), key=lambda one: -one.score)

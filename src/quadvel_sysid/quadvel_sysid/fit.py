"""One bounded least-squares fit of a model's gains, delays and effects (Levenberg and Marquardt).

Every joint keeps its own small Jacobian, so that the normal equations of all rows are small; each step is a bounded
quadratic problem.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import attrs
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from .model import MAX_DELAYS_S, Model, Unknowns, jacobian, pack, with_slots
from .parallel import side_by_side
from .signals import Array, Bools

_CONVERGED = 2e-5
"""Relative fall of the error below which a fit has converged"""
_DAMPING_FACTORS = (1e-6, 1e-3, 0.1, 10.0)
"""Shares of the curvature, tried until the error falls"""
_PIVOTS = 5, 60
"""Of all bounds at once, and at most; one by one in between, as all at once may go round in circles (Murty)"""
RIDGE = 1e-4
"""Weight of a term's own penalty on its weights, of its columns' mean second moment"""


def fit(model: Model, rows: Bools, iterations: int = 12, delays: bool = True) -> Model:
    """The model with its parameters fitted to `rows` (N, J)."""
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    unknowns = Unknowns.of(model, delays)
    error = squared_error(model, rows)
    for _ in range(iterations):
        better = _step(model, unknowns, rows, error)
        if better is None:
            break
        before, (model, error) = error, better
        if error > before * (1.0 - _CONVERGED):
            break
    return attrs.evolve(canonical(model), samples=samples)


def _fitted_rows_only(model: Model, rows: Bools) -> tuple[Model, Bools]:
    """The model on `rows` (N, J) alone, and which of these each joint has; on all rows where a law of it remembers some before."""
    some: Bools = np.asarray(rows.any(axis=1))
    if some.all() or any(one.law.has_memory for one in model.effects):
        return model, rows
    return attrs.evolve(model, samples=model.samples.select_rows(some)), rows[some]


_TOTAL_DELAY_CHANGES_S = np.arange(-0.003, 0.0031, 0.0005)
_OUTPUT_DELAY_CHANGES_S = np.array([-0.002, -0.001, 0.0, 0.001, 0.002])
"""s: the grid of delays, as changes of their sum and of the output delay. Commands come in steps, which make small valleys."""
_FAR_DELAY_CHANGES_S = np.array([-0.008, -0.007, -0.006, -0.005, -0.004, 0.004, 0.005, 0.006, 0.007, 0.008])
"""s: changes of the sum alone, as far as what a model lacked may have led its delays astray"""
_DELAY_STARTS = 3
"""Points of the grid that a fit starts from"""
_NEAR_DELAY_CHANGES_S = (-0.002, -0.001, 0.001, 0.002)
"""s: a coarser grid of the sum of delays alone"""


def fit_delay_profile(model: Model, rows: Bools, cores: int = 1) -> Model:
    """The model fitted from the best points of a grid of delays, everything else adapted at each (a profile likelihood)."""
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    shifts = (
        *product(_TOTAL_DELAY_CHANGES_S, _OUTPUT_DELAY_CHANGES_S),
        *product(_FAR_DELAY_CHANGES_S, (0.0,)),
    )
    starts = [model, *_one_step_at_each_delay(model, rows, shifts, cores)[:_DELAY_STARTS]]
    tried = side_by_side(lambda k: fit(starts[k], rows), len(starts), cores, model.samples)
    return attrs.evolve(min([model, *tried], key=lambda one: squared_error(one, rows)), samples=samples)


def fit_near_delays(model: Model, rows: Bools) -> Model:
    """The model, or one that leaves less, fitted from input delays that are a millisecond or two off."""
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    found = _one_step_at_each_delay(model, rows, product(_NEAR_DELAY_CHANGES_S, (0.0,)))
    tried = [model, *(fit(one, rows) for one in found[:1])]
    return attrs.evolve(min(tried, key=lambda one: squared_error(one, rows)), samples=samples)


def _one_step_at_each_delay(
    model: Model, rows: Bools, shifts: Iterable[tuple[float, float]], cores: int = 1
) -> list[Model]:
    """The model at other delays, everything else adapted by a step, the best one first.

    shifts: changes (s) of the sum of both delays and of the output delay.
    """
    unknowns = Unknowns.of(model, delays=False)
    every = [model.delays + np.array([[more - later], [later]]) for more, later in shifts]
    within = [one for one in every if (one >= -1e-9).all() and (one <= MAX_DELAYS_S[:, None] + 1e-9).all()]

    def adapted(k: int) -> tuple[Model, float]:
        at = model.with_delays(within[k])
        error = squared_error(at, rows)
        return _step(at, unknowns, rows, error) or (at, error)

    found = side_by_side(adapted, len(within), cores, model.samples)
    return [one for one, _ in sorted(found, key=lambda one: one[1])]


def canonical(model: Model) -> Model:
    """With every law's parameters in their unique order."""
    return attrs.evolve(model, effects=tuple(one.canonical() for one in model.effects))


def squared_error(model: Model, rows: Bools) -> float:
    """Sum of squared errors over `rows` (N, J), N^2 m^2."""
    left = np.where(rows, model.residual(), 0.0)
    return float(np.sum(left * left))


def normal_equations(model: Model, unknowns: Unknowns, rows: Bools) -> tuple[Array, Array, Array, Array]:
    """J'J, J'r, the slopes (J, A, N) on `rows`, and the residual (N, J) there."""
    predicted, slopes = jacobian(model, unknowns)
    left = np.where(rows, model.samples.tau - predicted, 0.0)
    slopes *= rows.T[:, None]
    hessian = unknowns.accumulate(slopes @ slopes.transpose(0, 2, 1))
    gradient = unknowns.accumulate(np.einsum("jan,nj->ja", slopes, left))
    return hessian, gradient, slopes, left


def _step(model: Model, unknowns: Unknowns, rows: Bools, error: float) -> tuple[Model, float] | None:
    """The model after a step that lessens the error, and the error; None where none does."""
    hessian, gradient, _, _ = normal_equations(model, unknowns, rows)
    theta = pack(model)
    x = unknowns.vector(theta)
    penalty = _penalty(model, unknowns, hessian)
    hessian, gradient = hessian + penalty, gradient - penalty @ x
    size = np.diagonal(hessian) + 1e-12 * (1.0 + np.diagonal(hessian).max(initial=0.0))
    for damping in _DAMPING_FACTORS:
        change = _bounded_minimum(
            hessian + np.diag(damping * size), gradient, unknowns.low - x, unknowns.high - x, np.sqrt(size)
        )
        after = np.where(unknowns.index >= 0, (x + change)[unknowns.index], theta)
        tried = with_slots(model, after)
        found = squared_error(tried, rows)
        if found < error:
            return tried, found
    return None


def _penalty(model: Model, unknowns: Unknowns, hessian: Array) -> Array:
    """The quadratic penalty on the weights of terms, in the unknowns."""
    total = np.zeros_like(hessian)
    first = 2
    for one in model.effects:
        count = len(one.values)
        shape = getattr(one.law, "penalty", None)
        if shape is not None:
            joints = np.flatnonzero(one.active)
            _, first_of_group = np.unique(one.groups[joints], return_index=True)
            for j in joints[first_of_group]:
                at = unknowns.index[first : first + count, j]
                total[np.ix_(at, at)] += shape * float(np.mean(hessian[at, at])) * RIDGE
        first += count
    return total


def _bounded_minimum(matrix: Array, gradient: Array, low: Array, high: Array, scale: Array) -> Array:
    """The minimum of x'Ax/2 - g'x within bounds that 0 lies in.

    What a step takes beyond a bound is held there for as long as the slope does not lead back inside (block pivoting).
    """
    matrix, gradient = matrix / np.outer(scale, scale), gradient / scale
    matrix = matrix + 1e-12 * np.eye(len(matrix))
    low, high = np.minimum(low, 0.0) * scale, np.maximum(high, 0.0) * scale
    x, held = np.zeros(len(gradient)), np.zeros(len(gradient), dtype=bool)
    for pivot in range(_PIVOTS[1]):
        free = ~held
        right = gradient[free] - matrix[np.ix_(free, held)] @ x[held]
        x[free] = splu(csc_array(matrix[np.ix_(free, free)])).solve(right)  # joints share few unknowns
        beyond = free & ((x < low) | (x > high))
        x = x.clip(low, high)
        slope = matrix @ x - gradient
        wrong = beyond | (held & (low < high) & np.where(x <= low, slope < 0.0, slope > 0.0))
        if not wrong.any():
            break
        if pivot >= _PIVOTS[0]:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        held ^= wrong
    return np.asarray(x / scale)

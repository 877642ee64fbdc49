"""Bounded nonlinear least squares for the parameters of a model (Levenberg-Marquardt).

`fit` minimises `squared_error` over gains, delays and effect parameters. `fit_delay_profile`
repeats it from a grid of delays, as the error has several local minima along them. Every joint has
its own small Jacobian block, so that the normal equations stay small for any number of rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

import attrs
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from quadvel_description.arrays import Array, Bools

from ..options import SEARCH_DEFAULTS, SearchOptions
from ..parallel import parallel_map
from .jacobian import DELAY_STEP_S, Unknowns, jacobian, pack, with_slots
from .torque_model import MAX_DELAYS_S, Model

MAX_ITERATIONS = 12
"""Maximum number of Levenberg-Marquardt steps of a fit."""
_CONVERGED = 2e-5
"""Relative reduction of the error below which a fit has converged."""
_DAMPING_FACTORS = (1e-6, 1e-3, 0.1, 10.0)
"""Levenberg-Marquardt damping, as multiples of the curvature, tried in this order."""
_MAX_PIVOTS = 5, 60
"""Pivots that exchange all violated bounds, and pivots in total.

After the first ones a single bound changes at a time, as block pivots may cycle (Murty).
"""
RIDGE = 1e-4
"""Weight of the smoothness penalty on regressor weights, relative to their mean second moment."""


def fit(model: Model, rows: Bools, iterations: int = MAX_ITERATIONS, delays: bool = True) -> Model:
    """Fit the parameters of a model by least squares.

    Args:
        model: Start of the fit.
        rows: Samples to fit, (N, J) bool.
        iterations: Maximum number of Levenberg-Marquardt steps.
        delays: Whether the delays are fitted as well.

    Returns:
        The fitted model in canonical form, on the samples of `model`.
    """
    # The error falls with every step. Effects with memory need all rows, others the fitted rows alone.
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    unknowns = Unknowns.of(model, delays)
    error = squared_error(model, rows)
    for _ in range(iterations):
        step = _damped_step(model, unknowns, rows, error)
        if step is None:
            break
        before, (model, error) = error, step
        if error > before * (1.0 - _CONVERGED):
            break
    return attrs.evolve(canonical(model), samples=samples)


def _fitted_rows_only(model: Model, rows: Bools) -> tuple[Model, Bools]:
    """The model on the fitted rows and their mask; on whole logs if an effect has memory."""
    used: Bools = np.asarray(rows.any(axis=1))
    if any(effect.candidate.has_memory for effect in model.effects):
        samples = model.samples.drop_heldout(rows)
        return attrs.evolve(model, samples=samples), rows[: len(samples.t)]
    if used.all():
        return model, rows
    return attrs.evolve(model, samples=model.samples.select_rows(used)), rows[used]


_TOTAL_DELAY_CHANGES_S = np.arange(-0.003, 0.0031, 0.0005)
_OUTPUT_DELAY_CHANGES_S = np.array([-0.002, -0.001, 0.0, 0.001, 0.002])
"""Grid of delays, s: changes of their sum, and of the output delay."""
_FAR_DELAY_CHANGES_S = np.array([-0.008, -0.007, -0.006, -0.005, -0.004, 0.004, 0.005, 0.006, 0.007, 0.008])
"""Further changes of the sum alone, s: a missing effect may have biased the delays by so much."""
_NEAR_DELAY_CHANGES_S = (-0.002, -0.001, 0.001, 0.002)
"""Coarse grid of changes of the sum of delays, s."""
_SPLIT_CHANGES_S = np.array([-0.004, -0.002, 0.002, 0.004])
"""Changes of the output delay, at an equal sum of delays, s; the bounds of the output delay clip them."""


def fit_delay_profile(
    model: Model, rows: Bools, cores: int = 1, options: SearchOptions = SEARCH_DEFAULTS
) -> Model:
    """Fit a model from the best points of a grid of delays (profile likelihood).

    Args:
        model: A fitted model.
        rows: Samples to fit, (N, J) bool.
        cores: Worker processes.
        options: Options of the search.

    Returns:
        The model with the least squared error, among `model` and the fits.
    """
    # Profile likelihood: at each pair of delays one step adapts the other parameters. Full fits
    # start from the pairs with the least error, as step commands give the error several local
    # minima.
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    shifts = (
        *product(_TOTAL_DELAY_CHANGES_S, _OUTPUT_DELAY_CHANGES_S),
        *product(_FAR_DELAY_CHANGES_S if options.far_delays else (), (0.0,)),
    )
    starts = [model, *_one_step_at_each_delay(model, rows, shifts, cores)[: options.delay_starts]]
    fits = parallel_map(lambda k: fit(starts[k], rows), len(starts), cores, model.samples)
    return attrs.evolve(min([model, *fits], key=lambda one: squared_error(one, rows)), samples=samples)


def fit_near_delays(model: Model, rows: Bools) -> Model:
    """Fit a model from input delays that differ by 1 or 2 ms.

    Args:
        model: A fitted model.
        rows: Samples to fit, (N, J) bool.

    Returns:
        The model with the least squared error, among `model` and the fit from the best start.
    """
    return _fit_from_best(model, rows, product(_NEAR_DELAY_CHANGES_S, (0.0,)))


def fit_delay_splits(model: Model, rows: Bools) -> Model:
    """Fit a model from other splits of the same total delay into input and output delay.

    Args:
        model: A fitted model.
        rows: Samples to fit, (N, J) bool.

    Returns:
        The model with the least squared error, among `model` and the fit from the best start.
    """
    splits = np.unique(np.clip(model.delays[1].mean() + _SPLIT_CHANGES_S, 0.0, MAX_DELAYS_S[1]))
    return _fit_from_best(model, rows, product((0.0,), splits - model.delays[1].mean()))


def _fit_from_best(model: Model, rows: Bools, shifts: Iterable[tuple[float, float]]) -> Model:
    """The better one of a model and its fit from the best of other delays."""
    samples, (model, rows) = model.samples, _fitted_rows_only(model, rows)
    starts = _one_step_at_each_delay(model, rows, shifts)
    tried = [model, *(fit(one, rows) for one in starts[:1])]
    return attrs.evolve(min(tried, key=lambda one: squared_error(one, rows)), samples=samples)


def _one_step_at_each_delay(
    model: Model, rows: Bools, shifts: Iterable[tuple[float, float]], cores: int = 1
) -> list[Model]:
    """Models at other delays after one step of the other parameters, ordered by squared error.

    `shifts` are changes (s) of the sum of both delays and of the output delay.
    """
    unknowns = Unknowns.of(model, delays=False)
    grid = [model.delays + np.array([[more - later], [later]]) for more, later in shifts]
    allowed = [one for one in grid if (one >= -1e-9).all() and (one <= MAX_DELAYS_S[:, None] + 1e-9).all()]

    def adapted(k: int) -> tuple[Model, float]:
        at = model.with_delays(allowed[k])
        error = squared_error(at, rows)
        return _damped_step(at, unknowns, rows, error) or (at, error)

    found = parallel_map(adapted, len(allowed), cores, model.samples)
    return [one for one, _ in sorted(found, key=lambda one: one[1])]


def canonical(model: Model) -> Model:
    """Return the model with every effect in canonical form.

    Args:
        model: The model.

    Returns:
        An equivalent model; see `AppliedEffect.canonical`.
    """
    return attrs.evolve(model, effects=tuple(effect.canonical() for effect in model.effects))


def squared_error(model: Model, rows: Bools) -> float:
    """Sum the squared residuals over a set of rows, and the encoder noise that interpolation averaged.

    Args:
        model: The model.
        rows: Samples to sum, (N, J) bool.

    Returns:
        Sum of squared errors as all delays would have it without averaging, N^2 m^2.
    """
    return float(np.sum(model.residual() ** 2 + model.averaged_noise(), where=rows))


def normal_equations(model: Model, unknowns: Unknowns, rows: Bools) -> tuple[Array, Array, Array, Array]:
    """Compute the normal equations of the linearised least-squares problem.

    Args:
        model: The model.
        unknowns: Mapping from slots to unknowns.
        rows: Samples to fit, (N, J) bool.

    Returns:
        J'J (K, K), J'r (K,), derivatives (J, A, N) and residual (N, J), both 0 outside `rows`.
    """
    slopes, residual = _linearised(model, unknowns, rows)
    hessian, gradient = (unknowns.accumulate(one) for one in _joint_products(slopes, residual))
    return hessian, gradient, slopes, residual


def expected_errors(models: Sequence[Model], rows: Bools) -> list[Array]:
    """Predict the errors of models whose joints share gains and delays in other groups.

    Args:
        models: Models with equal values, which differ in their groups alone.
        rows: Samples to fit, (N, J) bool.

    Returns:
        For each model the squared error of each joint (J,), N^2 m^2, that its linearisation expects
        of a fit.
    """
    # One linearisation serves all groups: joint j has the error r'r - 2 g'd + d'H d after a step d.
    model, rows = _fitted_rows_only(models[0], rows)
    slopes, residual = _linearised(model, Unknowns.of(model), rows)
    hessians, gradients = _joint_products(slopes, residual)
    found = []
    for one in models:
        unknowns = Unknowns.of(one)
        hessian, gradient, x = _penalised(one, unknowns, hessians, gradients)
        change = _bounded_minimum(hessian, gradient, unknowns.low - x, unknowns.high - x)
        step = np.where(unknowns.index >= 0, change[unknowns.index], 0.0)  # (A, J)
        reduction = 2.0 * np.einsum("ja,aj->j", gradients, step)
        reduction -= np.einsum("aj,jab,bj->j", step, hessians, step)
        found.append(np.sum(residual**2, axis=0) - reduction)
    return found


def _linearised(model: Model, unknowns: Unknowns, rows: Bools) -> tuple[Array, Array]:
    """Derivatives (J, A, N) and residual (N, J), both 0 outside `rows`."""
    predicted, slopes = jacobian(model, unknowns)
    slopes *= rows.T[:, None]
    return slopes, np.where(rows, model.samples.tau - predicted, 0.0)


def _joint_products(slopes: Array, residual: Array) -> tuple[Array, Array]:
    """Products J'J (J, A, A) and J'r (J, A) of each joint."""
    return slopes @ slopes.transpose(0, 2, 1), (slopes @ residual.T[:, :, None])[..., 0]


def _penalised(
    model: Model, unknowns: Unknowns, hessians: Array, gradients: Array
) -> tuple[Array, Array, Array]:
    """Normal equations H = J'J + P and g = J'r - P x with the penalty P, and the unknowns x."""
    hessian, gradient = unknowns.accumulate(hessians), unknowns.accumulate(gradients)
    penalty, x = _weight_penalty(model, unknowns, hessian), unknowns.vector(pack(model))
    return hessian + penalty, gradient - penalty @ x, x


def _damped_step(model: Model, unknowns: Unknowns, rows: Bools, error: float) -> tuple[Model, float] | None:
    """The model after a step that reduces the error, and that error; None if converged."""
    # Levenberg-Marquardt step d of the penalised problem, with H = J'J + P and g = J'r - P x:
    #     minimise  d'(H + lambda D) d / 2 - g'd   subject to   low <= x + d <= high
    # where D is the diagonal of H. The first lambda that reduces the true squared error counts. The
    # linear problem expects a reduction of 2 g'd - d'H d, less for every larger lambda. If that is
    # below the limit of convergence, the model is not evaluated.
    products = _joint_products(*_linearised(model, unknowns, rows))
    hessian, gradient, x = _penalised(model, unknowns, *products)
    gradient, theta = gradient - _averaging_gradient(model, unknowns, rows), pack(model)
    diagonal = _curvature(hessian)
    for damping in _DAMPING_FACTORS:
        change = _bounded_minimum(
            hessian + np.diag(damping * diagonal), gradient, unknowns.low - x, unknowns.high - x
        )
        if 2.0 * gradient @ change - change @ hessian @ change < _CONVERGED * error:
            return None
        after = np.where(unknowns.index >= 0, (x + change)[unknowns.index], theta)
        moved = with_slots(model, after)
        moved_error = squared_error(moved, rows)
        if moved_error < error:
            return moved, moved_error
    return None


def _averaging_gradient(model: Model, unknowns: Unknowns, rows: Bools) -> Array:
    """Half the derivative (K,) of the averaged encoder noise, which depends on the output delays."""
    local = np.zeros(unknowns.index.shape[::-1])
    if (unknowns.index[-1] >= 0).any():
        step = np.array([[0.0], [DELAY_STEP_S]])
        high, low = model.with_delays(model.delays + step), model.with_delays(model.delays - step)
        change = np.sum(high.averaged_noise() - low.averaged_noise(), axis=0, where=rows)
        local[:, -1] = 0.5 * change / (high.delays - low.delays)[1]
    return unknowns.accumulate(local)


def _weight_penalty(model: Model, unknowns: Unknowns, hessian: Array) -> Array:
    """Matrix of the quadratic penalty on regressor weights, (K, K)."""
    total = np.zeros_like(hessian)
    first = 2
    for effect in model.effects:
        count = len(effect.values)
        penalty = effect.candidate.penalty
        if penalty is not None:
            joints = np.flatnonzero(effect.active)
            _, first_of_group = np.unique(effect.groups[joints], return_index=True)
            for j in joints[first_of_group]:
                at = unknowns.index[first : first + count, j]
                total[np.ix_(at, at)] += penalty * float(np.mean(hessian[at, at])) * RIDGE
        first += count
    return total


def _curvature(hessian: Array) -> Array:
    """Diagonal (K,) of a matrix, slightly raised where it is 0."""
    diagonal = np.diagonal(hessian)
    found: Array = diagonal + 1e-12 * (1.0 + diagonal.max(initial=0.0))
    return found


def _bounded_minimum(matrix: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Minimum of x'Ax/2 - g'x within bounds that contain 0, by block pivoting.

    A variable beyond a bound is fixed there. It becomes free again when the gradient at the bound
    points back inside (the Karush-Kuhn-Tucker conditions).
    """
    scale = np.sqrt(_curvature(matrix))
    matrix, gradient = matrix / np.outer(scale, scale), gradient / scale
    matrix = matrix + 1e-12 * np.eye(len(matrix))
    low, high = np.minimum(low, 0.0) * scale, np.maximum(high, 0.0) * scale
    x, at_bound = np.zeros(len(gradient)), np.zeros(len(gradient), dtype=bool)
    for pivot in range(_MAX_PIVOTS[1]):
        # Free variables F solve A_FF x_F = g_F - A_FB x_B, the others B lie on their bounds.
        free = ~at_bound
        right = gradient[free] - matrix[np.ix_(free, at_bound)] @ x[at_bound]
        x[free] = splu(csc_array(matrix[np.ix_(free, free)])).solve(right)  # joints share few unknowns
        beyond = free & ((x < low) | (x > high))
        x = x.clip(low, high)
        # Optimality: x_F is within its bounds, and A x - g points outwards at every bound.
        slope = matrix @ x - gradient
        inwards = np.where(x <= low, slope < 0.0, slope > 0.0)
        violated = beyond | (at_bound & (low < high) & inwards)
        if not violated.any():
            break
        if pivot >= _MAX_PIVOTS[0]:
            violated[: np.flatnonzero(violated)[-1]] = False
        at_bound ^= violated
    return np.asarray(x / scale)

"""Delays that a log cannot resolve, and the delays of a running model with a fixed step.

Rows and commands with stamps on one grid make the error constant between two grid points. Input and
output delay are nearly exchangeable. The functions choose among equivalent delays.
"""

from __future__ import annotations

from functools import cache

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools

from .fit import fit, squared_error
from .torque_model import MAX_DELAYS_S, Model

DRIVE_STEP_S = 0.001
"""Clock period of a drive, s, and of models that run with the identified parameters."""
_DELAY_STEP_S = 5e-5  # s
_RELATIVE_TOLERANCE = 1e-9  # of the error
_CHI2_99 = 9.21
"""99 % quantile of chi-squared with 2 degrees of freedom, for the two delays."""
_REFINEMENT_STEPS_S = (0.25 * DRIVE_STEP_S, 0.125 * DRIVE_STEP_S, 0.0625 * DRIVE_STEP_S)
_ROUND_OFF_STEPS = 1e-6  # of a step


def central_equivalent_delay(model: Model, rows: Bools) -> Model:
    """Move the input delays to the middle of the range in which the prediction does not change.

    At an edge of that range a little jitter moves rows across the steps of commands.

    Args:
        model: The fitted model.
        rows: Samples on which the error must not change, (N, J) bool.

    Returns:
        The model with the central input delays.
    """
    low, high = (_move_while_equivalent(model, rows, by).delays for by in (-_DELAY_STEP_S, _DELAY_STEP_S))
    return model.with_delays(0.5 * (low + high)) if (low != high).any() else model


def delay_flatness(model: Model, rows: Bools) -> float:
    """Return how far the input delays can change without a change of the error.

    Args:
        model: The fitted model.
        rows: Samples on which the error must not change, (N, J) bool.

    Returns:
        Largest change over the joints, in either direction, s.
    """
    moved = (_move_while_equivalent(model, rows, by * _DELAY_STEP_S) for by in (-5, 5))
    return max(float(np.abs(model.delays[0] - one.delays[0]).max()) for one in moved)


def _move_while_equivalent(model: Model, rows: Bools, by: float) -> Model:
    """Move the input delays in steps of `by` (s) while the error stays equal up to round-off."""
    found, limit = model, squared_error(model, rows) * (1.0 + _RELATIVE_TOLERANCE)
    step = np.array([[by], [0.0]])
    while True:
        delays = found.delays + step
        if (delays[0] < 0.0).any() or (delays[0] > MAX_DELAYS_S[0]).any():
            return found
        moved = model.with_delays(delays)
        if squared_error(moved, rows) > limit:
            return found
        found = moved


def quantised_delays(model: Model, rows: Bools) -> Model:
    """Round the output delay and the sum of both to whole steps of the drive's clock, if the data allow it.

    The likelihood-ratio test accepts the rounded delays if they increase the sum of squares by less
    than the 99 % quantile of chi-squared with two degrees of freedom.

    Args:
        model: The fitted model.
        rows: Samples to fit, (N, J) bool.

    Returns:
        The model refitted with rounded delays, or `model`.
    """
    # Likelihood-ratio test of 2 restrictions (both delays): with the noise variance s^2 = SSE / n,
    # (SSE_rounded - SSE) / s^2 has a chi-squared distribution with 2 degrees of freedom.
    total, output = model.delays.sum(axis=0) / DRIVE_STEP_S, np.round(model.delays[1] / DRIVE_STEP_S)
    error = squared_error(model, rows)
    allowed = _CHI2_99 * error / max(int(rows.sum()), 1)
    for steps in (np.round(total), np.ceil(total)):
        delays = np.stack([np.maximum(steps - output, 0.0), output]) * DRIVE_STEP_S
        rounded = fit(model.with_delays(delays), rows, delays=False)
        if squared_error(rounded, rows) < error + allowed:
            return rounded
    return model


def running_delays(model: Model, rows: Bools) -> tuple[float, float]:
    """Find the delays with which a running model repeats a fit best.

    A running model averages a command over each step. With an output delay that is not a whole
    number of steps it interpolates between two steps. Both smooth the jumps of commands, so that
    its best delays differ from those of the fit.

    Args:
        model: The fitted model.
        rows: Samples to compare, (N, J) bool.

    Returns:
        Input and output delay, s, medians over the joints.
    """
    if model.window > DRIVE_STEP_S:
        return _median_delays(model.delays)
    alone = attrs.evolve(model, window=DRIVE_STEP_S)
    whole = np.round(model.delays[1] / DRIVE_STEP_S) * DRIVE_STEP_S
    fits = [_best_input_delay(alone, late, rows) for late in (model.delays[1], whole)]
    return _median_delays(min(fits, key=lambda one: one[0])[1].delays)


def _best_input_delay(model: Model, output_delays: Array, rows: Bools) -> tuple[float, Model]:
    """Least sum of squares for output delays (J,), and the model with the best input delays."""

    def moved(shift: float) -> Model:
        return model.with_delays(np.stack([model.delays.sum(axis=0) - output_delays + shift, output_delays]))

    @cache
    def error(shift: float) -> float:
        return _running_error(moved(shift), rows)

    # The mean over a step delays a command by half a step, which the search starts from.
    best = 0.5 * DRIVE_STEP_S
    for reach in _REFINEMENT_STEPS_S:
        best = min((best + k * reach for k in (-2, -1, 0, 1, 2)), key=error)
    return error(best), moved(best)


def _running_error(model: Model, rows: Bools) -> float:
    """Sum of squared errors of the running model."""
    # An output delay of (k + s) steps, 0 <= s < 1, is the mean of k and k + 1 steps:
    #     tau = (1 - s) tau_k + s tau_{k+1}
    steps = np.floor(model.delays[1] / DRIVE_STEP_S + _ROUND_OFF_STEPS)
    share = np.maximum(model.delays[1] / DRIVE_STEP_S - steps, 0.0)

    def torque_after(count: Array) -> Array:
        return model.with_delays(np.stack([model.delays[0], count * DRIVE_STEP_S])).predict()

    torque = torque_after(steps)
    if (share > _ROUND_OFF_STEPS).any():
        torque = torque + share * (torque_after(steps + 1.0) - torque)
    return float(np.sum(np.where(rows, model.samples.tau - torque, 0.0) ** 2))


def _median_delays(delays: Array) -> tuple[float, float]:
    """Median input and output delay over the joints, s."""
    first, last = np.median(delays, axis=1)
    return round(float(first), 7), round(float(last), 7)

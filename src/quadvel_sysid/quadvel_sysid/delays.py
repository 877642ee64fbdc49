"""Delays as a drive has them, and as a running model repeats a fit with them.

A log often does not tell delays apart: where rows and commands are stamped on one grid, every delay between two of its steps
predicts the same, and input and output delay trade against each other along a flat valley.
"""

from __future__ import annotations

from functools import cache

import attrs
import numpy as np

from .fit import fit, squared_error
from .model import MAX_DELAYS_S, Model
from .signals import Array, Bools

DRIVE_STEP_S = 0.001
"""s, a step of a drive's clock, and of the models that run with the parameters"""
_DELAY_STEP_S = 5e-5  # s
_RELATIVE_TOLERANCE = 1e-9  # of the error
_CHI2_99 = 9.21
"""Of the mean squared error: by so much 99 % of the logs of one truth have a larger sum of squares at the true pair of delays"""
_REFINEMENT_STEPS_S = (0.25 * DRIVE_STEP_S, 0.125 * DRIVE_STEP_S, 0.0625 * DRIVE_STEP_S)
_ROUND_OFF = 1e-6  # of a step


def longest_equivalent_delay(model: Model, rows: Bools) -> Model:
    """The model with the longest input delays with which it says the same of `rows` (N, J): those of a drive on that grid."""
    return _move_while_equivalent(model, rows, _DELAY_STEP_S)


def delay_flatness(model: Model, rows: Bools) -> float:
    """By how much (s) the input delays may be shorter and the model says the same of `rows` (N, J)."""
    return float((model.delays[0] - _move_while_equivalent(model, rows, -5 * _DELAY_STEP_S).delays[0]).max())


def _move_while_equivalent(model: Model, rows: Bools, by: float) -> Model:
    found, most = model, squared_error(model, rows) * (1.0 + _RELATIVE_TOLERANCE)
    step = np.array([[by], [0.0]])
    while True:
        delays = found.delays + step
        if (delays[0] < 0.0).any() or (delays[0] > MAX_DELAYS_S[0]).any():
            return found
        moved = model.with_delays(delays)
        if squared_error(moved, rows) > most:
            return found
        found = moved


def quantised_delays(model: Model, rows: Bools) -> Model:
    """The model with delays in whole steps of a drive's clock, where `rows` (N, J) do not tell these from its own."""
    stepped = fit(model.with_delays(np.round(model.delays / DRIVE_STEP_S) * DRIVE_STEP_S), rows, delays=False)
    error = squared_error(model, rows)
    chance = _CHI2_99 * error / max(int(rows.sum()), 1)
    return stepped if squared_error(stepped, rows) < error + chance else model


def running_delays(model: Model, rows: Bools) -> tuple[float, float]:
    """Input and output delay (s) with which a running model leaves least of `rows` (N, J), of all joints the median.

    Such a model gives the mean of a command over each of its steps, and after an output delay that is no whole number of
    steps the mean of two of these: both blur what a command makes jump.
    """
    if model.window > DRIVE_STEP_S:
        return _median(model.delays)
    alone = attrs.evolve(model, window=DRIVE_STEP_S)
    whole = np.round(model.delays[1] / DRIVE_STEP_S) * DRIVE_STEP_S
    tried = [_best_input_delay(alone, late, rows) for late in (model.delays[1], whole)]
    return _median(min(tried, key=lambda one: one[0])[1].delays)


def _best_input_delay(model: Model, late: Array, rows: Bools) -> tuple[float, Model]:
    """The least sum of squares with output delays `late` (J,), and the model with the input delays that leave it."""

    def moved(by: float) -> Model:
        return model.with_delays(np.stack([model.delays.sum(axis=0) - late + by, late]))

    @cache
    def error(by: float) -> float:
        return _running_error(moved(by), rows)

    best = 0.5 * DRIVE_STEP_S
    for reach in _REFINEMENT_STEPS_S:
        best = min((best + k * reach for k in (-2, -1, 0, 1, 2)), key=error)
    return error(best), moved(best)


def _running_error(model: Model, rows: Bools) -> float:
    """Sum of squares that the running model leaves."""
    steps = np.floor(model.delays[1] / DRIVE_STEP_S + _ROUND_OFF)
    share = np.maximum(model.delays[1] / DRIVE_STEP_S - steps, 0.0)

    def after(count: Array) -> Array:
        return model.with_delays(np.stack([model.delays[0], count * DRIVE_STEP_S])).predict()

    torque = after(steps)
    if (share > _ROUND_OFF).any():
        torque = torque + share * (after(steps + 1.0) - torque)
    return float(np.sum(np.where(rows, model.samples.tau - torque, 0.0) ** 2))


def _median(delays: Array) -> tuple[float, float]:
    first, last = np.median(delays, axis=1)
    return round(float(first), 7), round(float(last), 7)

"""Delays as a drive has them, and as a running model repeats a fit with them.

A log often does not tell delays apart: where rows and commands are stamped on one grid, every delay between two of its steps
predicts the same, and input and output delay trade against each other along a flat valley.
"""

from __future__ import annotations

from functools import cache

import attrs
import numpy as np

from .fit import fit, squared_error
from .model import LONGEST, Model
from .signals import Array, Bools

CLOCK = 0.001
"""s, a step of a drive's clock, and of the models that run with the parameters"""
_FINE = 5e-5  # s
_EQUAL = 1e-9  # of the error
_CHANCE = 9.21
"""Of the mean squared error: by so much 99 % of the logs of one truth have a larger sum of squares at the true pair of delays"""
_REACHES = (0.25 * CLOCK, 0.125 * CLOCK, 0.0625 * CLOCK)
_ROUND_OFF = 1e-6  # of a step


def latest(model: Model, rows: Bools) -> Model:
    """The model with the longest input delays with which it says the same of `rows` (N, J): those of a drive on that grid."""
    return _walked(model, rows, _FINE)


def plateau(model: Model, rows: Bools) -> float:
    """By how much (s) the input delays may be shorter and the model says the same of `rows` (N, J)."""
    return float((model.delays[0] - _walked(model, rows, -5 * _FINE).delays[0]).max())


def _walked(model: Model, rows: Bools, by: float) -> Model:
    found, most = model, squared_error(model, rows) * (1.0 + _EQUAL)
    step = np.array([[by], [0.0]])
    while True:
        delays = found.delays + step
        if (delays[0] < 0.0).any() or (delays[0] > LONGEST[0]).any():
            return found
        moved = model.with_delays(delays)
        if squared_error(moved, rows) > most:
            return found
        found = moved


def in_steps(model: Model, rows: Bools) -> Model:
    """The model with delays in whole steps of a drive's clock, where `rows` (N, J) do not tell these from its own."""
    stepped = fit(model.with_delays(np.round(model.delays / CLOCK) * CLOCK), rows, delays=False)
    error = squared_error(model, rows)
    chance = _CHANCE * error / max(int(rows.sum()), 1)
    return stepped if squared_error(stepped, rows) < error + chance else model


def running_delays(model: Model, rows: Bools) -> tuple[float, float]:
    """Input and output delay (s) with which a running model leaves least of `rows` (N, J), of all joints the median.

    Such a model gives the mean of a command over each of its steps, and after an output delay that is no whole number of
    steps the mean of two of these: both blur what a command makes jump.
    """
    if model.window > CLOCK:
        return _median(model.delays)
    alone = attrs.evolve(model, window=CLOCK)
    whole = np.round(model.delays[1] / CLOCK) * CLOCK
    tried = [_nearest(alone, late, rows) for late in (model.delays[1], whole)]
    return _median(min(tried, key=lambda one: one[0])[1].delays)


def _nearest(model: Model, late: Array, rows: Bools) -> tuple[float, Model]:
    """The least sum of squares with output delays `late` (J,), and the model with the input delays that leave it."""

    def moved(by: float) -> Model:
        return model.with_delays(np.stack([model.delays.sum(axis=0) - late + by, late]))

    @cache
    def error(by: float) -> float:
        return _running_error(moved(by), rows)

    best = 0.5 * CLOCK
    for reach in _REACHES:
        best = min((best + k * reach for k in (-2, -1, 0, 1, 2)), key=error)
    return error(best), moved(best)


def _running_error(model: Model, rows: Bools) -> float:
    """Sum of squares that the running model leaves."""
    steps = np.floor(model.delays[1] / CLOCK + _ROUND_OFF)
    share = np.maximum(model.delays[1] / CLOCK - steps, 0.0)

    def after(count: Array) -> Array:
        return model.with_delays(np.stack([model.delays[0], count * CLOCK])).predict()

    torque = after(steps)
    if (share > _ROUND_OFF).any():
        torque = torque + share * (after(steps + 1.0) - torque)
    return float(np.sum(np.where(rows, model.samples.tau - torque, 0.0) ** 2))


def _median(delays: Array) -> tuple[float, float]:
    first, last = np.median(delays, axis=1)
    return round(float(first), 7), round(float(last), 7)

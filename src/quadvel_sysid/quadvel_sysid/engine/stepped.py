"""The delays with which a model that runs in steps repeats a fitted one.

Such a model gives the mean of a command over each of its steps, and after an output delay that is no whole number of
steps the mean of two of these. What a command makes jump is blurred by both, so that delays which say the same of the
rows of a log do not say the same there.
"""

from __future__ import annotations

from functools import cache

import attrs
import numpy as np

from .delays import LONGEST
from .learned import Learned, beside
from .model import Model
from .signals import Array, Bools

STEP = 0.001
"""s, of the models that run with the parameters"""

_ROUND_OFF = 1e-6  # of a step
_REACHES = (0.25 * STEP, 0.125 * STEP, 0.0625 * STEP)


def stepped_delays(model: Model, learned: Learned | None, rows: Bools) -> tuple[float, float]:
    """Input and output delay (s) with which a running model leaves least of `rows` (N, J), of all joints the median.

    With the output delay that was fitted, or with one of whole steps, which blurs nothing. Where what was measured are
    means over longer than a step, those that were fitted.
    """
    if model.window > STEP:
        return _median(model.input_delay), _median(model.output_delay)
    alone, rows = attrs.evolve(beside(model, learned), window=STEP).reaching(rows)
    whole = np.round(model.output_delay / STEP) * STEP
    _, best = min(
        (_nearest(alone, late, rows) for late in (model.output_delay, whole)), key=lambda one: one[0]
    )
    return _median(best.input_delay), _median(best.output_delay)


def _nearest(model: Model, late: Array, rows: Bools) -> tuple[float, Model]:
    """The least sum of squares with output delays `late` (J,), and the model with the input delays that leave it."""

    def moved(by: float) -> Model:
        early = np.clip(model.input_delay + model.output_delay - late + by, 0.0, LONGEST[0])
        return model.with_delays(early, late)

    @cache
    def error(by: float) -> float:
        return _error(moved(by), rows)

    best = 0.5 * STEP
    for reach in _REACHES:
        best = min((best + k * reach for k in (-2, -1, 0, 1, 2)), key=error)
    return error(best), moved(best)


def _error(model: Model, rows: Bools) -> float:
    """Sum of squares that the running model leaves."""
    steps = np.floor(model.output_delay / STEP + _ROUND_OFF)
    share = np.maximum(model.output_delay / STEP - steps, 0.0)
    torque = _after(steps, model)
    if (share > _ROUND_OFF).any():
        torque = torque + share * (_after(steps + 1.0, model) - torque)
    return float(np.sum(np.where(rows, model.samples.tau - torque, 0.0) ** 2))


def _after(steps: Array, model: Model) -> Array:
    return model.with_delays(model.input_delay, steps * STEP).predict()


def _median(delay: Array) -> float:
    return round(float(np.median(delay)), 7)

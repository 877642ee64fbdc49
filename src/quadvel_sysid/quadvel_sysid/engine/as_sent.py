"""A model with the gains that were commanded, and delays that suit them.

A strong effect that the model lacks bends its gains and delays so far that what is left no longer looks like the effect.
Gains as sent are then nearer to the truth, and so are the delays with which smooth curves of angle and speed, whatever
they stand for, explain most.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_actuator.effects.terms import Curve

from .few import Few
from .model import Model
from .signals import Bools

_TOTALS = np.arange(0.0015, 0.0261, 0.0015)
"""s, sums of both delays"""
_OUTPUTS = (0.0005, 0.002, 0.0035, 0.005)  # s
_LONGEST = 0.0201  # s, of input delays
_PIECES, _RIDGE = 6, 1e-4


def as_sent(model: Model, few: Few) -> Model:
    """The model with its gains held as commanded."""
    some, rows = few.of(model.as_commanded())
    pairs = [(total - out, out) for total in _TOTALS for out in _OUTPUTS if 0.0 < total - out < _LONGEST]
    joints = rows.shape[1]
    tried = [some.with_delays(*(np.full(joints, round(one, 7)) for one in pair)) for pair in pairs]
    return attrs.evolve(min(tried, key=lambda one: _left(one, rows)), samples=model.samples)


def _left(model: Model, rows: Bools) -> float:
    """Sum of squares that curves of q and dq leave of each joint's torque."""
    left, seen = model.residual(rows), model.signals
    start = np.zeros(len(rows), dtype=bool)
    shapes = [Curve.over(u, _PIECES).columns(u, start, model.samples.period) for u in (seen.q, seen.dq)]
    curves = np.concatenate(shapes, axis=1)
    total = 0.0
    for j, mine in enumerate(rows.T):
        x, y = curves[mine, :, j], left[mine, j]
        gram = x.T @ x
        gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
        y = y - x @ np.linalg.solve(gram, x.T @ y)
        total += float(y @ y)
    return total

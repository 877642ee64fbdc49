"""What is left in the end: is it white, how much of it is more than noise, and what does it depend on."""

from __future__ import annotations

import attrs
import numpy as np

from .judging import Judge
from .learned import Learned, leanings
from .model import Model
from .signals import Array, Bools

_LAGS = 5
_CORRELATED = 0.2
"""A mean correlation of neighbouring rows above this is structure, whatever its cause."""


@attrs.frozen(eq=False)
class Remainder:
    """The verdict on the rows that judge."""

    structured: bool
    depends_on: tuple[str, ...]
    joints: Bools
    correlation: Array  # (J,), of neighbouring rows
    residual: Array  # (N, J), of the corrected model


def remainder(model: Model, learned: Learned | None, judge: Judge) -> Remainder:
    """Look at what the corrected model leaves."""
    both = judge.fit | judge.judge
    left = model.residual(both)
    joints = np.zeros(left.shape[1], dtype=bool)
    names: tuple[str, ...] = ()
    if learned is not None:
        left = left - learned.torque * both
        joints, names = learned.joints, tuple(learned.inputs)
    correlation = _correlation(left, model)
    coloured = correlation > _CORRELATED
    if coloured.any() and not names:
        names = leanings(model, judge)
    return Remainder(learned is not None or bool(coloured.any()), names, joints | coloured, correlation, left)


def _correlation(left: Array, model: Model) -> Array:
    """Mean correlation of rows up to _LAGS apart, (J,)."""
    power = np.sum(left * left, axis=0) + 1e-30
    mean: Array = np.mean([np.sum(left[k:] * left[:-k], axis=0) / power for k in range(1, _LAGS + 1)], axis=0)
    return mean

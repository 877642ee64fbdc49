"""Some of the fitted rows, enough to fit a model to, whatever the length of the logs.

Every so many-th row; stretches of rows where a law of the model needs those before. What is found on them is judged on
all held-out rows.
"""

from __future__ import annotations

from collections.abc import Callable

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw

from .judging import Judge
from .model import Model
from .signals import Array, Bools, Samples

APART, TOGETHER = 1800, 4000
"""Rows, some more or less: one by one, and in stretches"""
_VALUES = 11_000
"""Of all joints, in rows that stand one by one: robots of many joints have fewer; in stretches bristles and play need them all"""


def remembers(model: Model) -> bool:
    """Does a law of the model need the rows before each?"""
    return any(one.law.remembers for one in model.applied)


class Few:
    """The rows of `samples` that are fitted, or few of them."""

    def __init__(self, samples: Samples, judge: Judge, left: Array) -> None:
        """left: what a model leaves of each row, (N, J), in units of the noise: stretches lie where there is much of it."""
        whole = samples.reaching(judge.fit)
        fitted = judge.fit[: len(whole.t)]
        joints = fitted.shape[1]
        self.fitted_rows = fitted.sum(axis=0)
        """of all rows, those that are fitted, (J,)"""
        apart, rows = whole.thinned(max(1, int(fitted.any(axis=1).sum()) // min(APART, _VALUES // joints)))
        self._apart = apart, fitted[rows]
        weight = np.where(fitted, left[: len(fitted)] ** 2, 0.0).sum(axis=1)
        together, rows, known = whole.stretches(TOGETHER, weight)
        self._together = together, fitted[rows] & known[:, None]

    def of(self, model: Model, law: EffectLaw | None = None) -> tuple[Model, Bools]:
        """`model` on the rows that suit it, and `law` besides, and those of them that are fitted."""
        long = remembers(model) or (law is not None and law.remembers)
        samples, rows = self._together if long else self._apart
        return attrs.evolve(model, samples=samples), rows

    def fitted(self, model: Model, fit: Callable[[Model, Bools, int], Model], steps: int) -> Model:
        """The model as `fit` fits it to the rows that suit it."""
        return attrs.evolve(fit(*self.of(model), steps), samples=model.samples)

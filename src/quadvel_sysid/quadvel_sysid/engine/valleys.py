"""Down to the deepest of many small valleys, and which others are as deep.

Commands that step and laws with hard edges give the error of a fit many small valleys, a few tenths of a millisecond or
a hundredth of a parameter wide, and input and output delay trade against each other along a flat one. A fit that has
settled is therefore fitted again from a little to either side.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_actuator.effects import AddedLaw

from .ahead import side_by_side
from .delays import CHANCE, LONGEST, fit_with_delays
from .eam import WINDOWS
from .few import remembers
from .model import Model
from .signals import Array, Bools

_DELAYS = np.array(
    [(1.0, -1.0), (-1.0, 1.0), (0.3, -0.3), (-0.3, 0.3), (-0.3, 0.0), (0.3, 0.0), (0.0, -1.0), (0.0, 1.0)]
) * 1e-3  # fmt: skip
_OUTPUTS = (0.0, -1e-3, 1e-3)
"""s more of input and output delay, and of the latter where the drive takes other steps"""
_OF_STEP = 0.6  # of a drive's step, by which commands seem later with it
_SHARES = (0.98, 0.99, 1.01, 1.02)
_STEPS = 5
_DEEPER = 1.0
"""Of the mean squared error: a sum of squares that has to fall by this much to count as less"""


def deepest(model: Model, rows: Bools, rounds: int, cores: int = 1) -> Model:
    """The model fitted to `rows` (N, J) from either side of where it is, at most so often, while that says more.

    `cores` share the work.
    """
    for _ in range(rounds):
        best = min(_neighbours(model, rows, cores), key=lambda one: one.error(rows))
        if model.error(rows) - best.error(rows) < _DEEPER * model.mse(rows):
            break
        model = best
    return model


def as_deep(model: Model, rows: Bools) -> list[Model]:
    """What the fits from either side come to, where nobody could tell that from the model by `rows` (N, J).

    Not of laws with a memory, whose fits take long.
    """
    if remembers(model):
        return []
    bound = model.error(rows) + CHANCE * model.mse(rows)
    return [one for one in _neighbours(model, rows) if one.error(rows) < bound]


def _neighbours(model: Model, rows: Bools, cores: int = 1) -> list[Model]:
    starts = list(_starts(model))
    return side_by_side(lambda k: fit_with_delays(starts[k], rows, _STEPS), len(starts), cores, model.samples)


def _starts(model: Model) -> Iterator[Model]:
    for early, late in _DELAYS:
        yield _moved(model, early, late)
    for window in WINDOWS if model.window in WINDOWS else ():
        for late in _OUTPUTS if window != model.window else ():
            yield _moved(attrs.evolve(model, window=window), _OF_STEP * (window - model.window), late)
    for k, one in enumerate(model.applied):
        linear = one.law.linear if isinstance(one.law, AddedLaw) else ()
        for p, parameter in enumerate(one.law.parameters):
            for share in _SHARES if parameter.name not in linear else ():
                values: Array = one.values.copy()
                values[p] = np.clip(share * values[p], parameter.low, parameter.high)
                yield model.replacing(k, attrs.evolve(one, values=values))
        if len(np.unique(one.groups[one.active])) > 1:
            clearest = _clearest(model, k)
            yield model.replacing(k, attrs.evolve(one, values=np.where(one.active, clearest, one.values)))


def _moved(model: Model, early: float, late: float) -> Model:
    """With so much more input and output delay, s, as far as there is."""
    delays = model.input_delay + early, model.output_delay + late
    return model.with_delays(*(np.clip(one, 0.0, most) for one, most in zip(delays, LONGEST, strict=True)))


def _clearest(model: Model, index: int) -> Array:
    """The values (P, 1) of the joint whose torque an effect changes most: drives are often alike, and it shows them best."""
    one = model.applied[index]
    change = np.square(model.predict() - model.without(index).predict()).mean(axis=0)
    joint = int(np.argmax(np.where(one.active, change, -1.0)))
    return one.values[:, joint, None]

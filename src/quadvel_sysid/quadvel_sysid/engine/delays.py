"""Delays fitted together with gains and effects.

How a torque changes with a delay is taken from predictions a fraction of a millisecond apart, so that commands which
step have a slope, too; a step that does not lessen the error is not taken.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, AddedLaw, EffectLaw

from .eam import LONGEST_INPUT, LONGEST_OUTPUT
from .model import Model, Slots, fit, gather, jacobian, pack, step, with_slots
from .signals import Array, Bools

SLOPE = 0.0003
"""s, between the predictions that a slope is taken from, to either side"""

_DAMPING = (1e-6, 1e-2, 1.0)
_SETTLED = 2e-5
_FINE, _COARSE = 5e-5, 2.5e-4  # s
_EQUAL = 1e-9  # of the error
_CLOCK = 0.001
"""s, a step of a drive's clock"""
CHANCE = 3.84
"""Of the mean squared error: by so much 95 % of the logs of one truth have a larger sum of squares there than at the best fit"""
_CHANCE_OF_TWO = 9.21
"""The same of 99 % of the logs, and of two delays that are off: it is rare that a drive does not wait for whole steps"""
LONGEST = (LONGEST_INPUT, LONGEST_OUTPUT)
"""s, input and output delay at most"""


def jacobian_with_delays(model: Model) -> tuple[Array, Array, Slots]:
    """Prediction (N, J), slopes (J, A + 2, N) along every slot and the delays, and these slots."""
    slots = Slots.of(model)
    predicted, slopes = jacobian(model, slots)
    extra = []
    for k in range(2):
        moved = attrs.evolve(model, applied=tuple(one for one in model.applied if _feels(one.law, k)))
        high = _at(moved, k, SLOPE)
        low = _at(moved, k, -SLOPE)
        reach = (high.input_delay - low.input_delay) + (high.output_delay - low.output_delay)
        extra.append((high.predict() - low.predict()) / reach)
    both = np.stack(extra).transpose(2, 0, 1)
    groups = model.delay_groups
    index = np.stack([slots.count + groups, slots.count + int(groups.max()) + 1 + groups])
    bound = np.broadcast_to(np.array(LONGEST)[:, None], index.shape)
    wider = attrs.evolve(
        slots,
        index=np.concatenate([slots.index, index]),
        low=np.concatenate([slots.low, np.zeros(index.shape)]),
        high=np.concatenate([slots.high, bound]),
        step=np.concatenate([slots.step, [SLOPE, SLOPE]]),
        count=slots.count + 2 * (int(groups.max()) + 1),
    )
    return predicted, np.concatenate([slopes, both], axis=1), wider


def _feels(law: EffectLaw, which: int) -> bool:
    """Does its torque change with the input delay (0), or the output delay (1)?

    An acceleration does, which is read as commands move the joint.
    """
    if not isinstance(law, AddedLaw) or law.of_drive or law.signal == "ddq":
        return True
    return which == 1 and law.at == DRIVE


def _at(model: Model, which: int, by: float) -> Model:
    delays = [model.input_delay, model.output_delay]
    delays[which] = np.clip(delays[which] + by, 0.0, LONGEST[which])
    return model.with_delays(*delays)


def latest(model: Model, rows: Bools) -> Model:
    """The model with the longest input delays with which it says the same of `rows` (N, J).

    Where the stamps of rows and commands lie on a grid, a command is in force at the same rows for a whole step of
    delays. A drive that works on that grid has the longest of them, and so has a model that is to foretell rows that
    lie otherwise; a fit needs the room to either side.
    """
    return _walked(model, rows, _FINE)


def plateau(model: Model, rows: Bools) -> float:
    """By how much (s) the input delays may be shorter and the model says the same of `rows` (N, J): see `latest`."""
    return float((model.input_delay - _walked(model, rows, -_COARSE).input_delay).max())


def _walked(model: Model, rows: Bools, by: float) -> Model:
    """The model with input delays as many steps `by` (s) on as it says the same of `rows` (N, J)."""
    found, error = model, model.error(rows) * (1.0 + _EQUAL)
    while True:
        delay = np.round(found.input_delay + by, 7)
        if (delay < 0.0).any() or (delay > LONGEST_INPUT).any():
            return found
        moved = model.with_delays(delay, model.output_delay)
        if moved.error(rows) > error:
            return found
        found = moved


def in_steps(model: Model, rows: Bools) -> Model:
    """The model with delays in whole steps of a drive's clock, where `rows` (N, J) do not tell these from its own.

    Input and output delay trade against each other and against the gains along a valley that is all but flat. A drive
    waits for whole steps, so that of delays that say the same those in steps are the likelier ones.
    """
    near = [np.round(delay / _CLOCK) * _CLOCK for delay in (model.input_delay, model.output_delay)]
    stepped = fit(model.with_delays(*near), rows)
    return stepped if stepped.error(rows) < model.error(rows) + _CHANCE_OF_TWO * model.mse(rows) else model


def fit_with_delays(model: Model, rows: Bools, iterations: int = 5) -> Model:
    """The model with delays, gains and effects fitted to `rows` (N, J)."""
    whole, model, rows = model.samples, *model.reaching(rows)
    for _ in range(iterations):
        predicted, slopes, slots = jacobian_with_delays(model)
        left = np.where(rows, model.samples.tau - predicted, 0.0)
        error = float(np.sum(left * left))
        slopes *= rows.T[:, None]
        hessian = gather(slots, slopes @ slopes.transpose(0, 2, 1))
        gradient = gather(slots, np.einsum("jan,nj->ja", slopes, left))
        theta = np.concatenate([pack(model), model.input_delay[None], model.output_delay[None]])
        better = None
        for damping in _DAMPING:
            after = step(slots, theta, hessian, gradient, damping)
            tried = with_slots(model, after[:-2]).with_delays(*np.round(after[-2:], 7))
            found = tried.error(rows)
            if found < error:
                better = tried
                break
        if better is None:
            break
        model = better
        if found > error * (1.0 - _SETTLED):
            break
    return attrs.evolve(model, samples=whole, applied=tuple(one.tidied() for one in model.applied))

"""How sure the parameters are: 95 % intervals from the Jacobian, with residuals that may be correlated.

Two covariances are compared and the wider one counts: that of white residuals, and the sandwich of sums over blocks of
consecutive rows, which holds whatever the correlation within a block. The delays are unknowns of it, too. Where a law may
have other shapes that no log tells apart, what these say of its parameters lies within the interval; and so does what
other valleys of the error say that are as deep, and what the held-out rows say where they contradict the fitted ones.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy import stats

from .delays import LONGEST, fit_with_delays, jacobian_with_delays, plateau
from .few import remembers
from .judging import Judge
from .learned import Learned, beside
from .model import Model, gather
from .screening import split
from .signals import Array, Bools
from .valleys import as_deep

LEVEL = 0.95
_CLOCK = 0.25e-3
"""s, by which times may be off besides: the clock of a drive, whose step is up to 1 ms, is in no log"""
_BENT, _BENT_GAIN = 0.01, 0.005
"""of an effect's value, of a gain, by which they may be off besides: a log holds noisy samples of a motion, not the motion"""
_AS_WELL = 1.003
"""of the error: a shape of a law that leaves no more explains the log as well"""


@attrs.frozen(eq=False)
class Intervals:
    """Half widths (units of the parameter): of gains (2, J), of each effect's values (P, J), of delays (2, J)."""

    gains: Array
    effects: tuple[Array, ...]
    delays: Array
    on_bound: tuple[str, ...]


def intervals(
    model: Model, judge: Judge, learned: Learned | None = None, chosen: Model | None = None
) -> Intervals:
    """Intervals of everything that was fitted to the rows `judge.every`, the weights of learned terms left free beside it.

    `chosen` is the model as it was fitted to `judge.fit`, where these are others.
    """
    part = beside(model if chosen is None else chosen, learned)
    model = beside(model, learned)
    wide = _half_widths(model, judge, judge.every, learned)
    fitted = wide if judge.every is judge.fit else _half_widths(part, judge, judge.fit, learned)
    here = _everything(model)
    for other in as_deep(model, judge.every):
        wide = np.maximum(wide, np.abs(_everything(other) - here))
    wide = np.maximum(wide, _contradicted(part, judge, fitted, learned))
    effects: list[Array] = []
    first = 2
    for one in model.applied:
        mine = wide[first : first + len(one.law.parameters)]
        random = one.law.chance(dict(zip(one.law.names, one.values, strict=True)), model.signals)
        chance = np.array([random.get(name, row) for name, row in zip(one.law.names, mine, strict=True)])
        clock = np.array([[_CLOCK if parameter.unit == "s" else 0.0] for parameter in one.law.parameters])
        systematic = np.maximum(clock, _BENT * np.abs(one.values)) * one.active
        effects.append(chance + _shape_error(model, len(effects), judge) + systematic)
        first += len(one.law.parameters)
    size = np.abs(model.gains)
    gains = np.minimum(wide[:2] + _BENT_GAIN * size, np.maximum(1.0, size))  # or anything from 0 on
    delays = wide[-2:] + _CLOCK
    if shorter := plateau(model, judge.every):  # where no slope says anything
        delays[0] = shorter + _CLOCK
    delays = np.minimum(delays, np.array(LONGEST)[:, None])
    return Intervals(gains, tuple(effects), delays, on_bound(model))


def _half_widths(model: Model, judge: Judge, rows: Bools, learned: Learned | None) -> Array:
    """Half widths (A + 2, J) of what was fitted to `rows` (N, J), from the slopes there; 0 where nothing was."""
    predicted, slopes, slots = jacobian_with_delays(model)
    left = np.where(rows, model.samples.tau - predicted, 0.0)
    slopes *= rows.T[:, None]
    if learned is not None:
        slopes = _beside_terms(slopes, learned, rows)
    hessian = gather(slots, slopes @ slopes.transpose(0, 2, 1))
    freedom = max(int(rows.sum()) - slots.count, 1)
    scale = np.sqrt(np.diagonal(hessian)) + 1e-12
    inverse = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(
        scale, scale
    )
    noise = np.array([np.sum(one**2) for one in left.T]) / np.maximum(rows.sum(axis=0), 1)
    white = gather(slots, noise[:, None, None] * (slopes @ slopes.transpose(0, 2, 1)))
    meat = np.zeros_like(hessian)
    units = 0
    for j, moment in enumerate(slopes * left.T[:, None]):  # (A, N)
        used = slots.index[:, j] >= 0
        sums = judge.sums(moment[used].T)
        units += int((judge.sums(rows[:, j].astype(float)) > 0).sum())
        at = slots.index[used, j]
        np.add.at(meat, (at[:, None], at[None]), sums.T @ sums)
    covariance = [inverse @ middle @ inverse for middle in (white, meat)]
    variance = np.maximum(*(np.diagonal(one) for one in covariance)) * (1.0 + slots.count / freedom)
    half = np.sqrt(np.maximum(variance, 0.0)) * stats.t.ppf(0.5 + LEVEL / 2, max(units - slots.count, 5))
    return np.where(slots.index >= 0, half[slots.index], 0.0)


def _contradicted(model: Model, judge: Judge, wide: Array, learned: Learned | None) -> Array:
    """How far off the model fitted to the held-out rows is, (A + 2, J), where the two contradict each other, else 0.

    Then neither of the two widths holds: the model lacks something that bends what is fitted on one of them.
    """
    other = fit_with_delays(model, judge.judge)
    apart = np.abs(_everything(other) - _everything(model))
    return np.where(apart > wide + _half_widths(other, judge, judge.judge, learned), apart, 0.0)


def _beside_terms(slopes: Array, learned: Learned, rows: Bools) -> Array:
    """Of the slopes (J, A, N) what no weights of the terms of their joint explain."""
    found = slopes.copy()
    for j, columns in enumerate(learned.columns):
        if columns.shape[1]:
            x = columns * rows[:, j, None]
            weights = np.linalg.lstsq(x, slopes[j].T, rcond=1e-6)[0]
            found[j] -= (x @ weights).T
    return found


def _everything(model: Model) -> Array:
    """Gains, effects' values and delays, (A + 2, J)."""
    values = [model.gains, *(one.values for one in model.applied)]
    return np.concatenate([*values, model.input_delay[None], model.output_delay[None]])


def _shape_error(model: Model, index: int, judge: Judge) -> Array:
    """How far an effect's values (P, J) move where it has another shape that explains the log as well.

    One that looks like a delay may do so with the delays divided otherwise.
    """
    one, rows = model.applied[index], judge.every
    bound, moved = _AS_WELL * model.error(rows), np.zeros(one.values.shape)
    for law in one.law.alternatives:
        other = model.replacing(index, attrs.evolve(one, law=law))
        starts = split(other) if law.shifts and not remembers(model) else (other,)
        for tried in (fit_with_delays(start, rows) for start in starts):
            if tried.error(rows) < bound:
                moved = np.maximum(moved, np.abs(tried.applied[index].values - one.values))
    return moved


def on_bound(model: Model) -> tuple[str, ...]:
    """Delays, and effect.parameter, of those that sit on a bound of theirs."""
    delays = zip(
        ("input_delay", "output_delay"), (model.input_delay, model.output_delay), LONGEST, strict=True
    )
    found = [name for name, values, most in delays if (values >= most - 1e-9).any()]
    for one in model.applied:
        for parameter, values in zip(one.law.parameters, one.values, strict=True):
            reach = 1e-9 * max(abs(parameter.low), abs(parameter.high))
            sits = (values <= parameter.low + reach) | (values >= parameter.high - reach)
            if (sits & one.active).any():
                found.append(f"{one.law.name}.{parameter.name}")
    return tuple(found)

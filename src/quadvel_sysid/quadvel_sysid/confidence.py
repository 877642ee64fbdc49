"""How sure the parameters are: 95 % intervals from the slopes of the prediction, with residuals that may be correlated.

Two covariances are compared and the wider one counts: that of white residuals, and the cluster-robust sandwich of sums over
0.1 s and all joints, which holds whatever the correlation within a cluster. Gains and delays are unknowns of it, too. Where a
law may have other shapes that the log does not tell apart, what these say of its parameters lies within the interval.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy import stats

from .criterion import DataSplit
from .delays import delay_flatness
from .fit import fit, normal_equations, squared_error
from .model import MAX_DELAYS_S, Model, Unknowns
from .signals import Array, Bools

CONFIDENCE_LEVEL = 0.95
_CLOCK_ERROR_S = 0.25e-3
"""s, by which times may be off besides: the clock of a drive, whose step is up to 1 ms, is in no log"""
_SYSTEMATIC, _SYSTEMATIC_GAIN = 0.01, 0.005
"""of an effect's value, of a gain, by which they may be off besides: a log holds noisy samples of a motion, not the motion"""
_EQUIVALENT_ERROR = 1.003
"""of the error: a shape of a law that leaves no more explains the log as well"""


@attrs.frozen(eq=False)
class Intervals:
    """Half widths (units of the parameter): of gains (2, J), of each effect's values (P, J), of delays (2, J)."""

    gains: Array
    effects: tuple[Array, ...]
    delays: Array
    on_bound: tuple[str, ...]


def intervals(model: Model, parts: DataSplit) -> Intervals:
    """Intervals of everything that was fitted to all rows."""
    wide = _half_widths(model, parts, parts.all_rows)
    effects, first = [], 2
    for index, one in enumerate(model.effects):
        mine = wide[first : first + len(one.values)]
        first += len(one.values)
        random = one.law.sampling_error(dict(zip(one.law.names, one.values, strict=True)), model.signals)
        chance = np.array([random.get(name, row) for name, row in zip(one.law.names, mine, strict=True)])
        clock = np.array(
            [[_CLOCK_ERROR_S if parameter.unit == "s" else 0.0] for parameter in one.law.parameters]
        )
        systematic = np.maximum(clock, _SYSTEMATIC * np.abs(one.values)) * one.active
        effects.append(chance + _shape_error(model, index, parts.all_rows) + systematic)
    size = np.abs(model.gains)
    gains = np.minimum(wide[:2] + _SYSTEMATIC_GAIN * size, np.maximum(1.0, size))  # or anything from 0 on
    delays = wide[-2:] + _CLOCK_ERROR_S
    delays[0] = np.maximum(delays[0], delay_flatness(model, parts.all_rows) + _CLOCK_ERROR_S)
    return Intervals(gains, tuple(effects), np.minimum(delays, MAX_DELAYS_S[:, None]), on_bound(model))


def _half_widths(model: Model, parts: DataSplit, rows: Bools) -> Array:
    """Half widths (A, J) of what was fitted to `rows` (N, J), from the slopes there; 0 where nothing was."""
    unknowns = Unknowns.of(model)
    hessian, _, slopes, left = normal_equations(model, unknowns, rows)
    freedom = max(int(rows.sum()) - unknowns.count, 1)
    scale = np.sqrt(np.diagonal(hessian)) + 1e-12
    inverse = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    inverse /= np.outer(scale, scale)
    noise = np.sum(left**2, axis=0) / np.maximum(rows.sum(axis=0), 1)
    white = unknowns.accumulate(noise[:, None, None] * (slopes @ slopes.transpose(0, 2, 1)))
    sums = np.zeros((len(parts.starts), unknowns.count))
    for j, moment in enumerate(slopes * left.T[:, None]):  # (A, N)
        used = unknowns.index[:, j] >= 0
        sums[:, unknowns.index[used, j]] += parts.cluster_sums(moment[used].T)
    meat = sums.T @ sums
    units = int((parts.cluster_sums(rows.any(axis=1).astype(float)) > 0).sum())
    of_joint = int((unknowns.index >= 0).any(axis=1).sum())
    variance = np.maximum(*(np.diagonal(inverse @ middle @ inverse) for middle in (white, meat)))
    variance = np.maximum(variance * (1.0 + unknowns.count / freedom), 0.0)
    half = np.sqrt(variance) * stats.t.ppf(0.5 + CONFIDENCE_LEVEL / 2, max(units - of_joint, 5))
    return np.where(unknowns.index >= 0, half[unknowns.index], 0.0)


def _shape_error(model: Model, index: int, rows: Bools) -> Array:
    """How far an effect's values (P, J) move where it has another shape that explains the log as well."""
    one, moved = model.effects[index], np.zeros(model.effects[index].values.shape)
    if one.law.indistinguishable_forms:
        bound = _EQUIVALENT_ERROR * squared_error(model, rows)
        for law in one.law.indistinguishable_forms:
            other = fit(model.with_replaced_effect(index, attrs.evolve(one, law=law)), rows)
            if squared_error(other, rows) < bound:
                moved = np.maximum(moved, np.abs(other.effects[index].values - one.values))
    return moved


def on_bound(model: Model) -> tuple[str, ...]:
    """Delays, and effect.parameter, of those that sit on a bound of theirs."""
    found = [
        name
        for name, values, most in zip(
            ("input_delay", "output_delay"), model.delays, MAX_DELAYS_S, strict=True
        )
        if (values >= most - 1e-9).any()
    ]
    for one in model.effects:
        for parameter, values in zip(one.law.parameters, one.values, strict=True):
            reach = 1e-9 * max(abs(parameter.low), abs(parameter.high))
            sits = (values <= parameter.low + reach) | (values >= parameter.high - reach)
            if (sits & one.active).any():
                found.append(f"{one.law.name}.{parameter.name}")
    return tuple(found)

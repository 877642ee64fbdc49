"""Jacobian of the torque: derivatives with respect to gains, effect parameters and delays.

`fit` solves the normal equations with it, and `statistics.confidence` derives standard errors.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE
from quadvel_description.arrays import Array, Bools, Indices

from .effect_candidate import EffectCandidate
from .torque_model import MAX_DELAYS_S, Model


@attrs.frozen(eq=False)
class Unknowns:
    """Mapping from the parameter slots of a model to the vector of unknowns of a fit.

    A slot is one gain, one effect parameter or one delay, on every joint.

    Attributes:
        index: Unknown of slot a on joint j, (A, J); -1 where the slot is not fitted.
        low: Lower bounds of the unknowns, (K,), each in the unit of its parameter.
        high: Upper bounds of the unknowns, (K,), in the same units.
        step: Step of the finite differences of each slot, (A,), in the unit of its parameter.
    """

    index: Indices
    low: Array
    high: Array
    step: Array

    @property
    def count(self) -> int:
        """Number of unknowns K."""
        return len(self.low)

    @classmethod
    def of(cls, model: Model, delays: bool = True, all_gains: bool = False) -> Unknowns:
        """Collect the unknowns of a model.

        Args:
            model: The model to fit.
            delays: Whether the delays are fitted.
            all_gains: Whether gains are unknowns also where `Model.holds_gains`.

        Returns:
            The mapping, with one unknown for each slot and group of joints.
        """
        rows: list[Indices] = []
        low: list[float] = []
        high: list[float] = []
        step: list[float] = []
        for groups, free, bounds, size in _parameter_slots(model, delays, all_gains):
            names = np.unique(groups[free])
            rows.append(np.where(free, len(low) + np.searchsorted(names, groups), -1))
            low += [bounds[0]] * len(names)
            high += [bounds[1]] * len(names)
            step.append(size)
        return cls(np.array(rows), np.array(low, dtype=float), np.array(high, dtype=float), np.array(step))

    def accumulate(self, local: Array) -> Array:
        """Sum vectors or matrices of the joints into the shared unknowns.

        Args:
            local: Vectors (J, A) or matrices (J, A, A) over the slots of each joint.

        Returns:
            Vector (K,) or matrix (K, K) over the unknowns.
        """
        fitted = self.index.T >= 0
        at = np.where(fitted, self.index.T, 0)
        if local.ndim == 2:
            total = np.zeros(self.count)
            np.add.at(total, at, np.where(fitted, local, 0.0))
            return total
        square = np.zeros((self.count, self.count))
        both = fitted[:, :, None] & fitted[:, None, :]
        np.add.at(square, (at[:, :, None], at[:, None, :]), np.where(both, local, 0.0))
        return square

    def vector(self, theta: Array) -> Array:
        """Return the vector of unknowns of given slot values.

        Args:
            theta: Slot values, (A, J).

        Returns:
            Unknowns, (K,).
        """
        found = np.zeros(self.count)
        used = self.index >= 0
        found[self.index[used]] = theta[used]
        return found


_MAX_GAIN_RATIO = 4.0
"""Upper bound of the ratio of real to commanded gain."""
RELATIVE_STEP = 0.01
"""Finite-difference step, as a fraction of the parameter's scale."""
DELAY_STEP_S = 0.0003
"""Half the span of central differences along a delay, s; not small, as commands are steps."""


def _parameter_slots(
    model: Model, delays: bool, all_gains: bool
) -> Iterator[tuple[Indices, Bools, tuple[float, float], float]]:
    """Indices, free joints, bounds and finite-difference step of each slot."""
    everywhere = np.ones(model.gains.shape[1], dtype=bool)
    has_gains = model.samples.commanded and not model.samples.undamped
    free = everywhere if all_gains else ~model.holds_gains
    for _ in model.gains:
        yield model.gain_groups, free, (0.0, _MAX_GAIN_RATIO if has_gains else 1e6), RELATIVE_STEP
    for effect in model.effects:
        for parameter in effect.candidate.parameters:
            yield (
                effect.groups,
                effect.active,
                (parameter.low, parameter.high),
                RELATIVE_STEP * parameter.scale,
            )
    for longest in MAX_DELAYS_S:
        yield model.delay_groups, everywhere & delays, (0.0, float(longest)), DELAY_STEP_S


def pack(model: Model) -> Array:
    """Stack all parameters of a model into slots.

    Args:
        model: The model.

    Returns:
        Slot values, (A, J): gains, values of each effect, delays.
    """
    return np.concatenate([model.gains, *(effect.values for effect in model.effects), model.delays])


def with_slots(model: Model, theta: Array) -> Model:
    """Return the model with other slot values; the inverse of `pack`.

    Args:
        model: The model.
        theta: Slot values, (A, J).

    Returns:
        A new model.
    """
    gains, values = _unpack(model, theta[None])
    applied = tuple(
        attrs.evolve(effect, values=value[0]) for effect, value in zip(model.effects, values, strict=True)
    )
    return attrs.evolve(model, gains=gains[0], effects=applied).with_delays(theta[-2:])


def _unpack(model: Model, theta: Array) -> tuple[Array, list[Array]]:
    """Split slots (B, A, J) into gains and the values of each effect."""
    values, first = [], 2
    for effect in model.effects:
        values.append(theta[:, first : first + len(effect.values)])
        first += len(effect.values)
    return theta[:, :2], values


def jacobian(model: Model, unknowns: Unknowns) -> tuple[Array, Array]:
    """Predict the torque and differentiate it with respect to every slot.

    Linear parameters of added effects have exact derivatives, their regressors. Delays use central
    differences, all others forward differences (backward ones at an upper bound). The derivative of
    regressors that read the total torque neglects how that torque changes with the other slots.

    Args:
        model: The model.
        unknowns: Which slots are fitted.

    Returns:
        Prediction (N, J), N m, and derivatives (J, A, N); 0 for slots that are not fitted.
    """
    theta, free = pack(model), np.any(unknowns.index >= 0, axis=1)
    high = np.where(unknowns.index >= 0, unknowns.high[unknowns.index], np.inf)
    steps = np.where(theta + unknowns.step[:, None] > high, -unknowns.step[:, None], unknowns.step[:, None])
    slopes = np.zeros((theta.shape[1], len(theta), len(model.samples.t)))

    # Exact derivatives: tau = ... + sum_l w_l phi_l has d tau / d w_l = phi_l.
    numeric, first, torque_of_total = free.copy(), 2, np.zeros(model.samples.tau.shape)
    numeric[-2:] = False
    for effect in model.effects:
        slots = first + np.arange(len(effect.values))
        first += len(slots)
        candidate = effect.candidate
        if candidate.linear:
            columns = model.linear_columns(effect)
            linear = slots[[candidate.names.index(name) for name in candidate.linear]]
            slopes[:, linear] = columns.transpose(2, 0, 1)
            numeric[linear] = False
            if candidate.reads_total_torque:
                numeric[slots] = False
                torque_of_total = torque_of_total + np.einsum("kj,knj->nj", theta[slots], columns)

    # Finite differences: row 0 of the batch is theta, the others theta + h_a e_a.
    numeric_slots = np.flatnonzero(numeric)
    batch = np.repeat(theta[None], len(numeric_slots) + 1, axis=0)
    batch[1 + np.arange(len(numeric_slots)), numeric_slots] += steps[numeric_slots]
    independent = tuple(effect for effect in model.effects if not effect.candidate.reads_total_torque)
    others = attrs.evolve(model, effects=independent)
    gains, values = _unpack(model, batch[:, :-2])
    effect_values = [
        value
        for effect, value in zip(model.effects, values, strict=True)
        if not effect.candidate.reads_total_torque
    ]
    torque = others.evaluate(gains, effect_values)
    differences = (torque[1:] - torque[0]) / steps[numeric_slots][:, None, :]
    slopes[:, numeric_slots] = differences.transpose(2, 0, 1)
    for k in np.flatnonzero(free[-2:]):
        slopes[:, len(theta) - 2 + k] = _delay_slope(model, int(k)).T
    return torque[0] + torque_of_total, slopes


def _delay_slope(model: Model, which: int) -> Array:
    """Derivative (N, J) of the torque along the input delay (0) or the output delay (1)."""
    dependent = tuple(effect for effect in model.effects if _depends_on_delay(effect.candidate, which))
    moved = attrs.evolve(model, effects=dependent)
    step = np.zeros((2, 1))
    step[which] = DELAY_STEP_S
    high, low = moved.with_delays(model.delays + step), moved.with_delays(model.delays - step)
    slope: Array = (high.predict() - low.predict()) / (high.delays - low.delays)[which]
    return slope


def _depends_on_delay(candidate: EffectCandidate, which: int) -> bool:
    """Whether the torque of an effect changes with the input delay (0) or the output delay (1)."""
    return candidate.depends_on_commands or (which == 1 and candidate.at == DRIVE)

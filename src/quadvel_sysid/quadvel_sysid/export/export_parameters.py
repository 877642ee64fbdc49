"""Export a fitted model as `ActuatorParameters`, the file format of the simulator.

`quadvel_actuator.parameters` has the format; `export.replay` compares the models in a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL
from quadvel_actuator.parameters import ActuatorParameters, DelayPair, Effect
from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import JOINT_NAMES

from ..data.split import DataSplit
from ..model.applied_effect import AppliedEffect
from ..model.delays import running_delays
from ..model.torque_model import Model
from ..search.regressors import RegressorCandidate


def actuator_parameters(
    model: Model,
    parts: DataSplit,
    base: ActuatorParameters,
    widths: Sequence[Array] = (),
    clock_offsets: Sequence[float] = (),
) -> ActuatorParameters:
    """Convert a fitted model to actuator parameters.

    Args:
        model: The fitted model.
        parts: Data split.
        base: Parameters whose torque limits are kept.
        widths: Half widths of the 95 % intervals of each effect's values, (P, J) each; without them
            the effects have no ranges.
        clock_offsets: Offsets of the recordings' commands, s.

    Returns:
        Parameters with gains, one pair of delays (and one for each offset, as the recordings are
        equally probable), torque noise and effects.
    """
    joints = model.samples.joints
    error = mean_square(model.predictive().residual(), parts.fit_or_select)
    input_delay, output_delay = running_delays(model, parts.fit_or_select)
    pairs = [
        DelayPair(max(input_delay + offset, 0.0), output_delay, error) for offset in (0.0, *clock_offsets)
    ]
    deltas, own = _gain_parameters(model)
    return attrs.evolve(
        base,
        name="identified",
        joints=joints,
        torque_limit=torque_limits(base, joints),
        pairs=tuple(dict.fromkeys(pairs)),
        torque_noise=error,
        effects=(*_named_effects(model, widths), *_regressor_effect(model, parts.fit), *own),
        **deltas,
    )


def mean_square(error: Array, rows: Bools) -> float:
    """Mean square of an error over a set of rows.

    Args:
        error: Error, (N, J).
        rows: Samples to average, (N, J) bool.

    Returns:
        Mean square, in squared units of the error; 0 without rows.
    """
    count = int(rows.sum())
    return float(np.sum(np.where(rows, error, 0.0) ** 2) / count) if count else 0.0


def _named_effects(model: Model, widths: Sequence[Array]) -> list[Effect]:
    """The effects of the registry as those of a parameter file."""
    found = []
    for k, effect in enumerate(model.effects):
        if isinstance(effect.candidate, RegressorCandidate):
            continue
        params = parameter_entries(effect, widths[k] if widths else np.zeros_like(effect.values))
        values, units, ranges = (
            {name: each[field] for name, each in params.items()} for field in ("value", "unit", "ci95")
        )
        acts = tuple(acting_joints(effect.active, model.samples.joints))
        found.append(
            Effect(
                effect.candidate.name, acts, values | effect_settings(effect), units, ranges if widths else {}
            )
        )
    return found


def _regressor_effect(model: Model, rows: Bools) -> list[Effect]:
    """All regressors of named signals as one effect; `rows` (N, J) give their torque bounds."""
    joints = model.samples.joints
    saved = [
        effect.candidate.basis_regressor(
            effect.active, effect.values, _peak_torque(model, effect, rows)
        ).to_entry(joints)
        for effect in model.effects
        if isinstance(effect.candidate, RegressorCandidate)
    ]
    if not saved:
        return []
    active = [effect.active for effect in model.effects if isinstance(effect.candidate, RegressorCandidate)]
    acts = acting_joints(np.any(active, axis=0), joints)
    return [Effect(LEARNED_RESIDUAL, tuple(acts), {"terms": saved})]


def _peak_torque(model: Model, effect: AppliedEffect, rows: Bools) -> Array:
    """Largest absolute torque (J,) of a regressor on `rows`, the bound in a running model."""
    torque = np.einsum("kj,knj->nj", effect.values, model.linear_columns(effect))
    return np.max(np.abs(torque) * rows, axis=0)


def _gain_parameters(model: Model) -> tuple[dict[str, Any], list[Effect]]:
    """Reference gains and their deviations; viscous friction for a drive without commanded kd."""
    joints, (kp, kd) = model.samples.joints, model.samples.reference_gains
    delta_kp, delta_kd = gain_deviations(model)
    own = []
    if model.samples.undamped:
        damping = {"b": np.maximum(delta_kd, 0.0).tolist()}
        own = [Effect("viscous_friction", joints, damping, {"b": "N m s/rad"})]
        delta_kd = np.zeros(len(joints))
    deltas = {"delta_kp": delta_kp, "delta_kd": delta_kd}
    shared = {name: float(v[0]) if np.all(v == v[0]) else tuple(v.tolist()) for name, v in deltas.items()}
    return {"kp_ref": kp, "kd_ref": kd, **shared}, own


def gain_deviations(model: Model) -> Array:
    """Compute the deviations of the gains from the usual commanded gains.

    Args:
        model: The fitted model.

    Returns:
        Deviations of kp (N m/rad) and kd (N m s/rad), (2, J); the whole kd where none is commanded.
    """
    commanded = np.array([[1.0], [0.0 if model.samples.undamped else 1.0]])
    found: Array = (model.gains - commanded) * np.array(model.samples.reference_gains)[:, None]
    return found


def torque_limits(base: ActuatorParameters, joints: Sequence[str]) -> float | tuple[float, ...]:
    """Return the torque limits of the base parameters for a set of joints.

    Args:
        base: Parameters with limits.
        joints: Names of the joints.

    Returns:
        Limits, N m; the largest limit of the base for joints that it does not have.
    """
    limit = base.torque_limit
    if not isinstance(limit, tuple):
        return limit
    names = list(base.joints or JOINT_NAMES)
    every = limit if len(limit) == len(names) else limit * (len(names) // len(limit))
    return tuple(every[names.index(name)] if name in names else max(limit) for name in joints)


def parameter_entries(effect: AppliedEffect, half: Array) -> dict[str, dict[str, Any]]:
    """Return an effect's parameters on its joints, as in the report.

    Args:
        effect: The fitted effect.
        half: Half widths of the 95 % intervals, (P, J).

    Returns:
        For each parameter name a dict with `value`, `ci95` and `unit`.
    """
    params = {}
    for parameter, values, width in zip(effect.candidate.parameters, effect.values, half, strict=True):
        value, ci = value_and_interval(
            values[effect.active], width[effect.active], parameter.low, parameter.high
        )
        params[parameter.name] = {"value": value, "ci95": ci, "unit": parameter.unit}
    return params


def value_and_interval(
    values: Array, half: Array, least: float = -np.inf, most: float = np.inf
) -> tuple[Any, Any]:
    """Return values with their intervals, clipped to bounds.

    Args:
        values: Values of the joints, (J,).
        half: Half widths, (J,).
        least: Lower bound.
        most: Upper bound.

    Returns:
        Value and [low, high] if all joints share the value; else lists of these.
    """
    low, high = np.maximum(values - half, least), np.minimum(values + half, most)
    if np.all(values == values[0]):
        return float(values[0]), [float(low[0]), float(high[0])]
    return values.tolist(), np.stack([low, high], axis=1).tolist()


def acting_joints(active: Bools, joints: Sequence[str]) -> list[str]:
    """Return the names of the joints that an effect acts on.

    Args:
        active: Mask of the joints, (J,).
        joints: Names of the joints.

    Returns:
        Names.
    """
    return [name for name, acts in zip(joints, active, strict=True) if acts]


def effect_settings(effect: AppliedEffect) -> dict[str, Any]:
    """Return the settings of an effect.

    Args:
        effect: The fitted effect.

    Returns:
        Settings by name; lists over joints are restricted to the active joints.
    """
    return {
        name: [v for v, acts in zip(value, effect.active, strict=True) if acts]
        if isinstance(value, list)
        else value
        for name, value in effect.candidate.effect.settings.items()
    }

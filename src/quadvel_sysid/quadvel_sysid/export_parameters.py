"""The corrected model as the stack loads it: the fitted gains, delays, laws and terms as `ActuatorParameters`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects.terms import LEARNED_RESIDUAL as TERMS
from quadvel_actuator.parameters import ActuatorParameters, DelayPair, Effect
from quadvel_description.robot import JOINT_NAMES

from .criterion import DataSplit
from .delays import running_delays
from .library import SignalTerm
from .model import AppliedEffect, Model, linear_columns
from .preparation import reference_gains
from .signals import Array, Bools


def parameters(
    model: Model, parts: DataSplit, base: ActuatorParameters, widths: Sequence[Array] = ()
) -> ActuatorParameters:
    """A fitted model as parameters; the torque limits are those of `base`.

    widths: half of the 95 % interval of each effect's values, (P, J) each; without them the effects tell no ranges.
    """
    joints = model.samples.joints
    error = mean_square(model.predictive().residual(), parts.fit_or_select)
    pair = DelayPair(*running_delays(model, parts.fit_or_select), error)
    deltas, own = _deviations(model)
    return attrs.evolve(
        base,
        name="identified",
        joints=joints,
        torque_limit=limits(base, joints),
        pairs=(pair,),
        torque_noise=error,
        effects=(*_laws(model, widths), *_terms(model, parts.fit), *own),
        **deltas,
    )


def mean_square(error: Array, rows: Bools) -> float:
    """Of an error (N, J) on `rows`; 0 where there are none."""
    count = int(rows.sum())
    return float(np.sum(np.where(rows, error, 0.0) ** 2) / count) if count else 0.0


def _laws(model: Model, widths: Sequence[Array]) -> list[Effect]:
    found = []
    for k, one in enumerate(model.effects):
        if isinstance(one.law, SignalTerm):
            continue
        params = parameter_entries(one, widths[k] if widths else np.zeros_like(one.values))
        values, units, ranges = (
            {name: each[field] for name, each in params.items()} for field in ("value", "unit", "ci95")
        )
        acts = tuple(acting_joints(one.active, model.samples.joints))
        found.append(Effect(one.law.name, acts, values | law_settings(one), units, ranges if widths else {}))
    return found


def _terms(model: Model, rows: Bools) -> list[Effect]:
    """All terms as one effect; on `rows` (N, J) it is looked how large their torque becomes."""
    joints = model.samples.joints
    terms = [one for one in model.effects if isinstance(one.law, SignalTerm)]
    if not terms:
        return []
    saved = [one.law.term(one, _largest(model, one, rows)).to_entry(joints) for one in terms]  # type: ignore[attr-defined]
    acts = acting_joints(np.any([one.active for one in terms], axis=0), joints)
    return [Effect(TERMS, tuple(acts), {"terms": saved})]


def _largest(model: Model, one: AppliedEffect, rows: Bools) -> Array:
    """The largest torque (J,) that a term had on `rows` (N, J): a running model's stays within it."""
    torque = np.einsum("kj,knj->nj", one.values, linear_columns(model, one))
    return np.max(np.abs(torque) * rows, axis=0)


def _deviations(model: Model) -> tuple[dict[str, Any], list[Effect]]:
    """Gains and how far they are off; a damping of the drive's own where none is commanded, of which there is no deviation."""
    joints, (kp, kd) = model.samples.joints, reference_gains(model.samples)
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
    """Of kp and kd, (2, J), at the gains usual in the log; where no kd is commanded all of it."""
    commanded = np.array([[1.0], [0.0 if model.samples.undamped else 1.0]])
    found: Array = (model.gains - commanded) * np.array(reference_gains(model.samples))[:, None]
    return found


def limits(base: ActuatorParameters, joints: Sequence[str]) -> float | tuple[float, ...]:
    """The base's torque limits for these joints: each its own where the base knows it, else the largest."""
    limit = base.torque_limit
    if not isinstance(limit, tuple):
        return limit
    names = list(base.joints or JOINT_NAMES)
    every = limit if len(limit) == len(names) else limit * (len(names) // len(limit))
    return tuple(every[names.index(name)] if name in names else max(limit) for name in joints)


def parameter_entries(one: AppliedEffect, half: Array) -> dict[str, dict[str, Any]]:
    """The parameters of an effect on its joints, by name: value, interval and unit."""
    params = {}
    for parameter, values, width in zip(one.law.parameters, one.values, half, strict=True):
        value, ci = with_interval(values[one.active], width[one.active], parameter.low, parameter.high)
        params[parameter.name] = {"value": value, "ci95": ci, "unit": parameter.unit}
    return params


def with_interval(
    values: Array, half: Array, least: float = -np.inf, most: float = np.inf
) -> tuple[Any, Any]:
    """Value and interval, within what is possible: numbers if all joints share them, else lists."""
    low, high = np.maximum(values - half, least), np.minimum(values + half, most)
    if np.all(values == values[0]):
        return float(values[0]), [float(low[0]), float(high[0])]
    return values.tolist(), np.stack([low, high], axis=1).tolist()


def acting_joints(active: Bools, joints: Sequence[str]) -> list[str]:
    """The names of the joints that an effect acts on."""
    return [name for name, acts in zip(joints, active, strict=True) if acts]


def law_settings(one: AppliedEffect) -> dict[str, Any]:
    """The settings of a law; what it has for each joint, for those that it acts on."""
    return {
        name: [v for v, acts in zip(value, one.active, strict=True) if acts]
        if isinstance(value, list)
        else value
        for name, value in one.law.settings.items()
    }

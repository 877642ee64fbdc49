"""Everything that was found, as the report and the series for the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects.terms import LEARNED_RESIDUAL as TERMS
from quadvel_actuator.parameters import ActuatorParameters

from .baselines import explained_share, torque_variance
from .confidence import Intervals
from .criterion import SIGNIFICANCE_LEVEL, WHITENESS_LEVEL, DataSplit, normality, whiteness
from .export_parameters import (
    acting_joints,
    gain_deviations,
    law_settings,
    limits,
    mean_square,
    parameter_entries,
    parameters,
    with_interval,
)
from .identification import Identification, Shape, Trace
from .library import SignalTerm
from .logs.findings import Finding as LogFinding
from .model import AppliedEffect, Model
from .preparation import reference_gains
from .signals import Array
from .summary_text import decision

SCHEMA = 1
_DELTAS = "delta_kp", "delta_kd"
UNITS = {"mse": "N^2 m^2", "torque": "N m", "delta_kp": "N m/rad", "delta_kd": "N m s/rad", "delay": "ms"}
_REMOVABLE = 0.05
"""Of the floor: what the plain EAM leaves above it must be more than this to speak of a share of it."""

_ALIKE = 0.05  # ms
_OVER = 1.1  # times the limit, that noise and a short peak may reach

_SHOWN = 4000  # points of a series in a picture
_SIGNAL_UNITS = {
    "q": "rad",
    "q_des": "rad",
    "dq": "rad/s",
    "ddq": "rad/s^2",
    "tau": "N m",
    "t": "s",
}


@attrs.frozen(eq=False)
class SelectedEffect:
    """An effect that was chosen, of the corrected model the one of the same index, on the rows that are reported."""

    gain: float
    """error without it, everything else fitted anew, less that with it, N^2 m^2"""
    p: float
    indistinguishable: tuple[str, ...]
    """laws that say the same"""


@attrs.frozen(eq=False)
class Outcome:
    """What the steps of an identification found. Models `whole` are fitted to every row, the others to those that chose."""

    before: Model
    before_whole: Model
    model: Model
    whole: Model
    effects: tuple[SelectedEffect, ...]
    rejected: tuple[tuple[str, float, str], ...]
    """law, gain on the rows that select, reason"""
    is_white: bool
    """is what is left nothing but noise?"""
    residual_correlates: tuple[str, ...]
    """the signals that what is left goes with most, where it is not white and no term says more of it"""
    widths: Intervals
    ideal: Array  # (N, J), torque of the PD law as commanded
    noise: Array  # (J,)
    parts: DataSplit
    base: ActuatorParameters

    @property
    def predicted(self) -> Array:
        """Torque that the corrected model foretells, (N, J)."""
        return self.model.predictive().predict()

    @property
    def terms(self) -> list[tuple[int, AppliedEffect]]:
        """The terms of named signals, and which of the effects they are."""
        return [(k, one) for k, one in enumerate(self.model.effects) if isinstance(one.law, SignalTerm)]


def identification(outcome: Outcome, findings: Sequence[tuple[str, LogFinding]]) -> Identification:
    """The report, the corrected model and the series; `findings` are (log, finding)."""
    report = _report(outcome)
    report["findings"] = [{"log": name, **attrs.asdict(one)} for name, one in findings]
    corrected = parameters(outcome.whole, outcome.parts, outcome.base, outcome.widths.effects)
    return Identification(report, corrected, _traces(outcome), _shapes(outcome))


def _report(o: Outcome) -> dict[str, Any]:
    samples, parts = o.model.samples, o.parts
    errors = {
        name: samples.tau - torque
        for name, torque in (("pd", o.ideal), ("before", o.before.predict()), ("after", o.predicted))
    }
    mses: dict[str, dict[str, Any]] = {
        name: {
            "train_mse": mean_square(error, parts.fit_or_select),
            "heldout_mse": mean_square(error, parts.report),
        }
        for name, error in errors.items()
    }
    variance = torque_variance(samples.tau, parts.report)
    for entry in mses.values():
        entry["heldout_explained"] = explained_share(entry["heldout_mse"], variance)
    for name in ("before", "after"):
        mses[name]["per_joint"] = [
            mean_square(errors[name][:, [j]], parts.report[:, [j]]) for j in range(len(samples.joints))
        ]
    floor = float(np.average(o.noise, weights=np.maximum(parts.report.sum(axis=0), 1)))
    report = {
        "schema": SCHEMA,
        "joints": list(samples.joints),
        "units": UNITS,
        "noise_floor": floor,
        "heldout_variance": variance,
        "pd": mses["pd"],
        "before": mses["before"]
        | {
            **{
                name: float(each[0])
                for name, each in zip(_DELTAS, gain_deviations(o.before_whole), strict=True)
            },
            "input_delay_ms": 1e3 * float(o.before_whole.delays[0, 0]),
            "output_delay_ms": 1e3 * float(o.before_whole.delays[1, 0]),
        },
        "after": mses["after"] | _gains(o),
        "effects": sorted(_effects(o), key=lambda one: -one["heldout_gain"]),
        "rejected": [{"name": name, "selecting_gain": gain, "reason": why} for name, gain, why in o.rejected],
        "unexplained": _unexplained(o, mses["before"]["heldout_mse"], mses["after"]["heldout_mse"], floor),
        "warnings": [
            f"{name} sits on its bound: its value and interval are not to be trusted"
            for name in o.widths.on_bound
        ]
        + _unconfirmed(o)
        + _unlike_delays(o.whole)
        + _negative_gains(o.whole)
        + _beyond_limits(o),
    }
    report["decision"] = decision(report)
    return report


def _unexplained(o: Outcome, before: float, after: float, floor: float) -> dict[str, Any]:
    """What no law explains: terms of named signals, or a residual that is not white."""
    parts, samples = o.parts, o.model.samples
    left = samples.tau - o.model.predict()
    p = np.minimum(
        whiteness(left, parts.all_rows, samples.start, parts.overlap), normality(left, parts.all_rows)
    )
    coloured = p < WHITENESS_LEVEL
    names = [name for _, one in o.terms for name in one.law.inputs]  # type: ignore[attr-defined]
    joints = np.any([one.active for _, one in o.terms], axis=0) if names else np.zeros(len(coloured), bool)
    removable = before - floor
    structured = bool(names) or not o.is_white
    return {
        "verdict": "structured" if structured else "white",
        "fraction": float(np.clip((after - floor) / removable, 0.0, 1.0))
        if removable > _REMOVABLE * floor
        else 0.0,
        "depends_on": list(dict.fromkeys(names or o.residual_correlates)),
        "joints": np.array(samples.joints)[joints | (coloured & structured)].tolist(),
    }


def _unconfirmed(o: Outcome) -> list[str]:
    """Effects that the rows which chose nothing do not show."""
    return [
        f"{one.law.name} is not confirmed by the rows that are reported (p = {found.p:.2g} there)"
        for one, found in zip(o.model.effects, o.effects, strict=True)
        if found.p > SIGNIFICANCE_LEVEL
    ]


def _unlike_delays(model: Model) -> list[str]:
    """A model that runs has one pair of delays."""
    spread = 1e3 * float(np.ptp(model.delays, axis=1).max())
    if spread < _ALIKE:
        return []
    return [
        f"delays differ by up to {spread:.1f} ms between joints: actuator.yaml holds their median, so a model that runs "
        "with it does worse than the error after says"
    ]


def _negative_gains(model: Model) -> list[str]:
    """A drive that pushes away from its target does not exist: the log or the model is wrong."""
    found = []
    for name, row in zip(("kp", "kd"), model.gains, strict=True):
        joints = np.array(model.samples.joints)[row < 0.0]
        if len(joints):
            text = f"{name} + delta_{name} is negative on {', '.join(joints)}"
            found.append(
                f"{text}: look at the signs and stamps of the log before believing anything else here"
            )
    return found


def _beyond_limits(o: Outcome) -> list[str]:
    """Torques that were measured and that the corrected model can not give."""
    joints, most = o.model.samples.joints, np.abs(o.model.samples.tau).max(axis=0)
    allowed = np.broadcast_to(limits(o.base, joints), most.shape)
    return [
        f"{joint}: up to {torque:.1f} N m were measured, and torque_limit in actuator.yaml, which is the base's, is "
        f"{limit:.1f} N m"
        for joint, torque, limit in zip(joints, most, allowed, strict=True)
        if torque > _OVER * limit
    ]


def _gains(o: Outcome) -> dict[str, Any]:
    """Gain deviations and delays of the corrected model, a number, or one for each joint, with intervals."""
    model, widths = o.whole, o.widths
    found: dict[str, Any] = {}
    halves = widths.gains * np.array(reference_gains(model.samples))[:, None]
    rows = {
        **dict(zip(_DELTAS, zip(gain_deviations(model), halves, strict=True), strict=True)),
        "input_delay_ms": (1e3 * model.delays[0], 1e3 * widths.delays[0]),
        "output_delay_ms": (1e3 * model.delays[1], 1e3 * widths.delays[1]),
    }
    for name, (values, half) in rows.items():
        least = -np.inf if name.startswith("delta") else 0.0
        value, ci = with_interval(values, half, least)
        found[name], found[f"{name}_ci95"] = value, ci
    return found


def _effects(o: Outcome) -> list[dict[str, Any]]:
    joints = o.model.samples.joints
    found = [
        _effect(of_it, one, half, joints)
        for of_it, one, half in zip(o.effects, o.whole.effects, o.widths.effects, strict=True)
        if not isinstance(one.law, SignalTerm)
    ]
    if o.terms:
        found.append(_terms(o, joints))
    return found


def _terms(o: Outcome, joints: Sequence[str]) -> dict[str, Any]:
    """All terms as one effect."""
    ranked = sorted(o.terms, key=lambda pair: -o.effects[pair[0]].gain)
    acts = np.any([one.active for _, one in ranked], axis=0)
    return {
        "name": TERMS,
        "joints": acting_joints(acts, joints),
        "params": {},
        "indistinguishable": [],
        "heldout_gain": sum(o.effects[k].gain for k, _ in ranked),
        "p_value": min(o.effects[k].p for k, _ in ranked),
        "inputs": list(dict.fromkeys(name for _, one in ranked for name in one.law.inputs)),  # type: ignore[attr-defined]
        "terms": [
            {
                "kind": one.law.shape.kind,  # type: ignore[attr-defined]
                "inputs": list(one.law.inputs),  # type: ignore[attr-defined]
                "at": one.law.at,
                "joints": acting_joints(one.active, joints),
                "heldout_gain": o.effects[k].gain,
            }
            for k, one in ranked
        ],
    }


def _effect(of_it: SelectedEffect, one: AppliedEffect, half: Array, joints: Sequence[str]) -> dict[str, Any]:
    settings = law_settings(one)
    entry: dict[str, Any] = {
        "name": one.law.name,
        "joints": acting_joints(one.active, joints),
        "params": parameter_entries(one, half),
        "indistinguishable": list(of_it.indistinguishable),
        "heldout_gain": of_it.gain,
        "p_value": of_it.p,
        **one.law.record_statistics(),
    }
    if settings:
        entry["form"] = settings
    if of_it.indistinguishable:
        entry["separated_by"] = one.law.motion
    return entry


def _traces(o: Outcome) -> dict[str, Trace]:
    samples, reported = o.model.samples, o.parts.report
    series = (samples.tau, o.ideal, o.before.predict(), o.predicted)
    rows = np.flatnonzero(reported.any(axis=1))[:_SHOWN]
    return {
        joint: Trace(samples.t[rows], *(np.where(reported[rows, j], x[rows, j], np.nan) for x in series))
        for j, joint in enumerate(samples.joints)
    }


def _shapes(o: Outcome) -> tuple[Shape, ...]:
    """The residual over the signal that explains it, of up to three joints an effect."""
    samples = o.model.samples
    before, after = samples.tau - o.before.predict(), samples.tau - o.predicted
    rows = np.flatnonzero(o.parts.report.any(axis=1))
    rows = rows[:: max(1, len(rows) // _SHOWN)]
    found = []
    for one in o.model.effects:
        for j in np.flatnonzero(one.active)[:3]:
            x, unit = _signal(o, one.law.signal, int(j))
            x, e0, e1 = x[rows], before[rows, j], after[rows, j]
            found.append(Shape(one.law.name, samples.joints[j], one.law.signal, unit, x, e0, e1))
    return tuple(found)


def _signal(o: Outcome, name: str, joint: int) -> tuple[Array, str]:
    """A signal of the report by its name, and its unit."""
    s, samples = o.model.signals, o.model.samples
    owner, _, plain = name.rpartition("/")
    j = samples.joints.index(owner) if owner else joint
    kind = plain.partition("@")[0]
    series: dict[str, Array] = {
        "q": s.q, "dq": s.dq, "ddq": s.ddq, "q_des": s.q_des, "tau": samples.tau,
        "t": np.broadcast_to(s.t, s.q.shape),
    }  # fmt: skip
    return series[kind][:, j], _SIGNAL_UNITS[kind]

"""Everything that was found, as the report, the corrected parameters, and the series for the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects.terms import NAME as TERMS
from quadvel_actuator.parameters import ActuatorParameters, DelayPair, Effect
from quadvel_description.robot import JOINT_NAMES

from ..identification import Identification, Shape, Trace
from ..logs.excerpts import Piece
from ..logs.findings import Finding as LogFinding
from .decision import decision
from .diagnosis import Diagnosis, Finding
from .eam import Eam
from .intervals import Intervals
from .judging import Judge
from .learned import Learned
from .model import Applied, Model
from .residual import Remainder
from .signals import Array
from .stepped import stepped_delays

SCHEMA = 1
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
class Outcome:
    """What the steps of an identification found."""

    eam: Eam
    before: Model
    before_whole: Model  # as `before`, but fitted to every row, held-out ones too: its values are reported
    diagnosis: Diagnosis
    whole: Model  # as `model`, likewise
    learned: Learned | None
    learned_gain: tuple[float, float]  # held-out gain and p-value of all terms together
    rest: Remainder
    widths: Intervals
    ideal: Array  # (N, J), torque of the PD law as commanded
    noise: Array  # (J,)
    judge: Judge
    pieces: Sequence[Piece]
    kp_ref: float
    kd_ref: float
    base: ActuatorParameters

    @property
    def model(self) -> Model:
        """The corrected model, without the learned terms."""
        return self.diagnosis.model

    @property
    def after(self) -> Array:
        """Torque that the corrected model foretells, learned terms included, (N, J)."""
        torque = self.model.foretold().predict()
        return torque if self.learned is None else torque + self.learned.torque


def identification(outcome: Outcome, findings: Sequence[tuple[str, LogFinding]]) -> Identification:
    """The report, the parameters and the series; `findings` are (log, finding)."""
    report = _report(outcome)
    report["findings"] = [{"log": name, **attrs.asdict(one)} for name, one in findings]
    return Identification(report, parameters(outcome), _traces(outcome), _shapes(outcome))


def _report(o: Outcome) -> dict[str, Any]:
    samples, judge = o.model.samples, o.judge
    before, after = o.before.predict(), o.after
    errors = {
        name: samples.tau - torque for name, torque in (("pd", o.ideal), ("before", before), ("after", after))
    }
    mses: dict[str, dict[str, Any]] = {
        name: {"train_mse": _mse(error, judge.fit), "heldout_mse": _mse(error, judge.judge)}
        for name, error in errors.items()
    }
    for name in ("before", "after"):
        mses[name]["per_joint"] = [
            _mse(errors[name][:, [j]], judge.judge[:, [j]]) for j in range(len(samples.joints))
        ]
    floor = float(np.average(o.noise, weights=np.maximum(judge.judge.sum(axis=0), 1)))
    removable = mses["before"]["heldout_mse"] - floor
    left = mses["after"]["heldout_mse"] - floor
    names = np.array(samples.joints)
    effects = sorted(_effects(o), key=lambda one: -one["heldout_gain"])
    report = {
        "schema": SCHEMA,
        "joints": list(samples.joints),
        "units": UNITS,
        "noise_floor": floor,
        "pd": mses["pd"],
        "before": mses["before"]
        | {
            "delta_kp": float((o.before_whole.gains[0, 0] - 1.0) * o.kp_ref),
            "delta_kd": float((o.before_whole.gains[1, 0] - 1.0) * o.kd_ref),
            "input_delay_ms": 1e3 * float(o.before_whole.input_delay[0]),
            "output_delay_ms": 1e3 * float(o.before_whole.output_delay[0]),
        },
        "after": mses["after"] | _gains(o),
        "effects": effects,
        "rejected": [
            {"name": one.name, "heldout_gain": one.gain, "reason": one.reason} for one in o.diagnosis.rejected
        ],
        "unexplained": {
            "verdict": "structured" if o.rest.structured else "white",
            "fraction": float(np.clip(left / removable, 0.0, 1.0)) if removable > _REMOVABLE * floor else 0.0,
            "depends_on": list(o.rest.depends_on),
            "joints": names[o.rest.joints].tolist(),
        },
        "warnings": [
            f"{name} sits on its bound: its value and interval are not to be trusted"
            for name in o.widths.on_bound
        ]
        + _unlike_delays(o.whole)
        + _negative_gains(o.whole)
        + _beyond_limits(o),
        "fitted_seconds": float(judge.fit.any(axis=1).sum() * samples.period),
    }
    report["decision"] = decision(report)
    return report


def _unlike_delays(model: Model) -> list[str]:
    """A model that runs has one pair of delays."""
    spread = 1e3 * float(max(np.ptp(model.input_delay), np.ptp(model.output_delay)))
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
    limits = np.broadcast_to(_limits(o.base, joints), most.shape)
    return [
        f"{joint}: up to {torque:.1f} N m were measured, and torque_limit in actuator.yaml, which is the base's, is "
        f"{limit:.1f} N m"
        for joint, torque, limit in zip(joints, most, limits, strict=True)
        if torque > _OVER * limit
    ]


def _mse(error: Array, rows: Any) -> float:
    count = int(rows.sum())
    return float(np.sum(np.where(rows, error, 0.0) ** 2) / count) if count else 0.0


def _gains(o: Outcome) -> dict[str, Any]:
    """Gain deviations and delays of the corrected model, a number, or one for each joint, with intervals."""
    model, widths = o.whole, o.widths
    found: dict[str, Any] = {}
    rows = {
        "delta_kp": ((model.gains[0] - 1.0) * o.kp_ref, widths.gains[0] * o.kp_ref),
        "delta_kd": ((model.gains[1] - 1.0) * o.kd_ref, widths.gains[1] * o.kd_ref),
        "input_delay_ms": (1e3 * model.input_delay, 1e3 * widths.delays[0]),
        "output_delay_ms": (1e3 * model.output_delay, 1e3 * widths.delays[1]),
    }
    for name, (values, half) in rows.items():
        least = -np.inf if name.startswith("delta") else 0.0
        value, ci = _with_interval(values, half, least)
        found[name], found[f"{name}_ci95"] = value, ci
    return found


def _with_interval(
    values: Array, half: Array, least: float = -np.inf, most: float = np.inf
) -> tuple[Any, Any]:
    """Value and interval, within what is possible: numbers if all joints share them, else lists."""
    low, high = np.maximum(values - half, least), np.minimum(values + half, most)
    if np.all(values == values[0]):
        return float(values[0]), [float(low[0]), float(high[0])]
    return values.tolist(), np.stack([low, high], axis=1).tolist()


def _effects(o: Outcome) -> list[dict[str, Any]]:
    joints = o.model.samples.joints
    found = []
    for finding, one, half in zip(o.diagnosis.findings, o.whole.applied, o.widths.effects, strict=True):
        found.append(_effect(finding, one, half, joints))
    if o.learned is not None:
        found.append(
            {
                "name": TERMS,
                "joints": [name for name, acts in zip(joints, o.learned.joints, strict=True) if acts],
                "params": {},
                "indistinguishable": [],
                "heldout_gain": o.learned_gain[0],
                "p_value": o.learned_gain[1],
                "inputs": o.learned.inputs,
                "terms": [
                    {
                        "kind": term.shape.kind,
                        "inputs": list(term.inputs),
                        "at": term.at,
                        "joints": [name for name, acts in zip(joints, term.active, strict=True) if acts],
                        "heldout_gain": gain,
                    }
                    for term, gain in zip(o.learned.terms, o.learned.gains, strict=True)
                ],
            }
        )
    return found


def _effect(finding: Finding, one: Applied, half: Array, joints: Sequence[str]) -> dict[str, Any]:
    params = {}
    for parameter, values, width in zip(one.law.parameters, one.values, half, strict=True):
        value, ci = _with_interval(values[one.active], width[one.active], parameter.low, parameter.high)
        params[parameter.name] = {"value": value, "ci95": ci, "unit": parameter.unit}
    settings = _settings(one)
    entry: dict[str, Any] = {
        "name": finding.name,
        "joints": [name for name, acts in zip(joints, one.active, strict=True) if acts],
        "params": params,
        "indistinguishable": list(finding.indistinguishable),
        "heldout_gain": finding.gain,
        "p_value": finding.p,
        **one.law.observed(),
    }
    if settings:
        entry["form"] = settings
    if finding.indistinguishable:
        entry["separated_by"] = one.law.motion
    return entry


def _settings(one: Applied) -> dict[str, Any]:
    """The form of a law; what it has for each joint, for those that it acts on."""
    return {
        name: [v for v, acts in zip(value, one.active, strict=True) if acts]
        if isinstance(value, list)
        else value
        for name, value in one.law.settings.items()
    }


def parameters(o: Outcome, model: Model | None = None) -> ActuatorParameters:
    """The corrected model as the stack loads it, or another one of the outcome's: its terms belong to all but the plain one."""
    model = o.whole if model is None else model
    learned = None if model is o.before else o.learned
    joints = model.samples.joints
    mse = _mse(model.samples.tau - (o.before.predict() if model is o.before else o.after), o.judge.fit)
    pair = DelayPair(*stepped_delays(model, learned, o.judge.fit), mse)
    effects = []
    for one, half in zip(model.applied, o.widths.effects, strict=False):
        values: dict[str, Any] = {}
        ranges = {}
        for parameter, row, width in zip(one.law.parameters, one.values, half, strict=True):
            value, ci = _with_interval(row[one.active], width[one.active], parameter.low, parameter.high)
            values[parameter.name], ranges[parameter.name] = value, ci
        values |= _settings(one)
        units = {parameter.name: parameter.unit for parameter in one.law.parameters}
        acts = tuple(name for name, on in zip(joints, one.active, strict=True) if on)
        effects.append(Effect(one.law.name, acts, values, units, ranges))
    if learned is not None:
        acts = tuple(name for name, on in zip(joints, learned.joints, strict=True) if on)
        effects.append(Effect(TERMS, acts, {"terms": [one.saved(joints) for one in learned.terms]}))
    deviations: dict[str, Any] = {
        "delta_kp": (model.gains[0] - 1.0) * o.kp_ref,
        "delta_kd": (model.gains[1] - 1.0) * o.kd_ref,
    }
    deviations = {
        name: float(v[0]) if np.all(v == v[0]) else tuple(v.tolist()) for name, v in deviations.items()
    }
    return attrs.evolve(
        o.base,
        name="identified",
        joints=joints,
        torque_limit=_limits(o.base, joints),
        kp_ref=o.kp_ref,
        kd_ref=o.kd_ref,
        pairs=(pair,),
        torque_noise=mse,
        effects=tuple(effects),
        **deviations,
    )


def _limits(base: ActuatorParameters, joints: Sequence[str]) -> float | tuple[float, ...]:
    """The base's torque limits for these joints: each its own where the base knows it, else the largest."""
    limit = base.torque_limit
    if not isinstance(limit, tuple):
        return limit
    names = list(base.joints or JOINT_NAMES)
    every = limit if len(limit) == len(names) else limit * (len(names) // len(limit))
    return tuple(every[names.index(name)] if name in names else max(limit) for name in joints)


def _traces(o: Outcome) -> dict[str, Trace]:
    samples, judge = o.model.samples, o.judge
    before, after = o.before.predict(), o.after
    rows = np.flatnonzero(judge.judge.any(axis=1))[:_SHOWN]
    found = {}
    for j, joint in enumerate(samples.joints):
        series = [
            np.where(judge.judge[rows, j], x[rows, j], np.nan) for x in (samples.tau, o.ideal, before, after)
        ]
        found[joint] = Trace(samples.t[rows], *series)
    return found


def _shapes(o: Outcome) -> tuple[Shape, ...]:
    """The residual over the signal that explains it, of up to three joints an effect."""
    samples, judge = o.model.samples, o.judge
    before, after = samples.tau - o.before.predict(), samples.tau - o.after
    rows = np.flatnonzero(judge.judge.any(axis=1))
    rows = rows[:: max(1, len(rows) // _SHOWN)]
    found = []
    entries = [(one.law.name, one.law.signal, one.active) for one in o.model.applied]
    if o.learned is not None:
        entries += [(TERMS, term.inputs[0], term.active) for term in o.learned.terms]
    for name, signal, active in entries:
        for j in np.flatnonzero(active)[:3]:
            x, unit = _signal(o, signal, int(j))
            found.append(
                Shape(name, samples.joints[j], signal, unit, x[rows], before[rows, j], after[rows, j])
            )
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

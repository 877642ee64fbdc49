"""Build the report and the figure series from the results of an identification.

`identification` holds the records, `report` writes the files, and `page` renders the HTML.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Array, Bools

from ..data.clocks import RecordingClock, known_offsets
from ..data.plain_model import pd_torque
from ..data.signals import Samples
from ..data.split import DataSplit
from ..export.export_parameters import (
    acting_joints,
    actuator_parameters,
    effect_settings,
    gain_deviations,
    mean_square,
    parameter_entries,
    torque_limits,
    value_and_interval,
)
from ..logs.findings import Finding as LogFinding
from ..model.applied_effect import AppliedEffect
from ..model.torque_model import Model
from ..search.regressors import RegressorCandidate
from ..statistics.baselines import explained_share, torque_variance
from ..statistics.confidence import Intervals
from ..statistics.criterion import (
    SIGNIFICANCE_LEVEL,
    WHITENESS_LEVEL,
    normality_p_values,
    whiteness_p_values,
)
from .identification import Identification, Shape, Trace
from .summary_text import inseparable_warnings, summary_text

SCHEMA = 1
"""Version of the format of report.json."""
_DELTAS = "delta_kp", "delta_kd"
UNITS = {"mse": "N^2 m^2", "torque": "N m", "delta_kp": "N m/rad", "delta_kd": "N m s/rad", "delay": "ms"}
"""Units of the report's numbers."""
_EDGE_S, _MIN_STEP_RAD = 0.004, 1e-4
"""Time after a change of a command, s, whose error is stated, and the least change, rad."""
_MIN_REMOVABLE = 0.05
"""Minimum error of the plain EAM above the noise floor, relative to it, to state a fraction."""

_SAME_DELAY_MS = 0.05
"""Difference of delays between joints, ms, below which they count as equal."""
_TORQUE_LIMIT_MARGIN = 1.1
"""Ratio of measured torque to the limit that noise and short peaks may reach."""

_MAX_POINTS = 4000
"""Maximum number of points of a series in a figure."""
_SIGNAL_UNITS = {"q": "rad", "q_des": "rad", "dq": "rad/s", "ddq": "rad/s^2", "tau": "N m", "t": "s"}


@attrs.frozen(eq=False)
class SelectedEffect:
    """Evidence for a selected effect on the reported rows.

    Attributes:
        gain: Mean squared error without the effect, all else refitted, minus that with it, N^2 m^2.
        p_value: p-value of the score test.
        indistinguishable: Names of effects that explain the log equally well.
    """

    gain: float
    p_value: float
    indistinguishable: tuple[str, ...]


@attrs.frozen(eq=False)
class Evidence:
    """Evidence for and against effects.

    Attributes:
        effects: Evidence for each effect of the corrected model, in the same order.
        rejected: Rejected effects: name, gain on the selection rows (N^2 m^2), reason.
        is_white: Whether the residual is indistinguishable from white noise.
        correlates: Signals that a structured residual correlates with, if no regressor does.
    """

    effects: tuple[SelectedEffect, ...]
    rejected: tuple[tuple[str, float, str], ...]
    is_white: bool
    correlates: tuple[str, ...]


@attrs.frozen(eq=False, kw_only=True)
class Outcome:
    """Results of all steps of an identification.

    Attributes:
        before: Plain EAM.
        after: Corrected model.
        effects_alone: The best model without regressors of named signals.
        evidence: Evidence for and against effects.
        half_widths: 95 % confidence intervals of `after`.
        noise: Variance of the torque noise, (J,), N^2 m^2.
        parts: Data split.
        base: Parameters that the corrected model extends.
        clocks: Clock of each recording.
    """

    before: Model
    after: Model
    effects_alone: Model
    evidence: Evidence
    half_widths: Intervals
    noise: Array
    parts: DataSplit
    base: ActuatorParameters
    clocks: Sequence[RecordingClock]

    @property
    def samples(self) -> Samples:
        """Rows of all logs."""
        return self.after.samples

    @cached_property
    def ideal_torque(self) -> Array:
        """Torque of the commanded PD law without delays, (N, J), N m."""
        commanded = np.ones_like(self.after.gains)
        commanded[1] = 0.0 if self.samples.undamped else 1.0
        return pd_torque(self.samples, commanded, 0.0, 0.0, 0.0)

    @property
    def predicted(self) -> Array:
        """Torque that the corrected model predicts, (N, J), N m."""
        return self.after.predictive().predict()

    @property
    def regressors(self) -> list[tuple[int, AppliedEffect, RegressorCandidate]]:
        """Regressors of named signals: index among the effects, effect, and its form."""
        return [
            (k, effect, effect.candidate)
            for k, effect in enumerate(self.after.effects)
            if isinstance(effect.candidate, RegressorCandidate)
        ]


def build_identification(outcome: Outcome, findings: Sequence[tuple[str, LogFinding]]) -> Identification:
    """Build the report, the corrected model and the series.

    Args:
        outcome: Results of all steps.
        findings: Findings of the log checks, as (log name, finding).

    Returns:
        The complete result.
    """
    report = _report(outcome)
    report["findings"] = [{"log": name, **attrs.asdict(one)} for name, one in findings]
    corrected = actuator_parameters(
        outcome.after,
        outcome.parts,
        outcome.base,
        outcome.half_widths.effects,
        known_offsets(outcome.clocks),
    )
    return Identification(report, corrected, _traces(outcome), _shapes(outcome))


def _report(o: Outcome) -> dict[str, Any]:
    """The dict of report.json, without findings, baselines and replays."""
    samples, parts = o.samples, o.parts
    errors = {
        name: samples.tau - torque
        for name, torque in (
            ("pd", o.ideal_torque),
            ("before", o.before.predict()),
            ("after", o.predicted),
        )
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
    # Where states are held, differences of rows overestimate the noise; it cannot exceed an error.
    noise = float(np.average(o.noise, weights=np.maximum(parts.report.sum(axis=0), 1)))
    floor = min(noise, mses["after"]["train_mse"] or noise)
    report = {
        "schema": SCHEMA,
        "robot": o.base.robot,
        "joints": list(samples.joints),
        "units": UNITS,
        "noise_floor": floor,
        "heldout_variance": variance,
        "reference_gains": dict(zip(("kp", "kd"), samples.reference_gains, strict=True))
        | {"commanded": samples.commanded},
        "pd": mses["pd"],
        "before": mses["before"]
        | {
            **{name: float(each[0]) for name, each in zip(_DELTAS, gain_deviations(o.before), strict=True)},
            "input_delay_ms": 1e3 * float(o.before.delays[0, 0]),
            "output_delay_ms": 1e3 * float(o.before.delays[1, 0]),
        },
        "after": mses["after"] | _gain_entries(o),
        "clocks": [_clock_entry(one) for one in o.clocks],
        "judged_rows": int(parts.report.any(axis=1).sum()),
        "effects": sorted(_effect_entries(o), key=lambda one: -one["heldout_gain"]),
        "effects_alone": _effects_alone_entry(o) if o.regressors else None,
        "inseparable": [
            {
                "names": list(one.names),
                "joint": samples.joints[one.joint],
                "correlation": one.correlation,
                "conditional": one.conditional,
            }
            for one in o.half_widths.inseparable
        ],
        "rejected": [
            {"name": name, "selecting_gain": gain, "reason": why} for name, gain, why in o.evidence.rejected
        ],
        "unexplained": _unexplained(o, mses["before"]["heldout_mse"], mses["after"]["heldout_mse"], floor),
        "warnings": [
            f"{name} is at its bound: its value and interval are not valid" for name in o.half_widths.at_bound
        ]
        + _unconfirmed_warnings(o)
        + inseparable_warnings(o.half_widths.inseparable)
        + _delay_spread_warnings(o.after)
        + _torque_limit_warnings(o),
    }
    report["decision"] = summary_text(report)
    return report


def _clock_entry(clock: RecordingClock) -> dict[str, Any]:
    """Entry of the report for the clock of a recording."""
    offset, interval = clock.offset_s, None
    if offset is not None:
        interval = (1e3 * (offset + clock.half_width_s * np.array([-1.0, 1.0]))).tolist()
    return {
        "log": clock.log,
        "heldout": clock.heldout,
        "even": clock.even,
        "command_drift_ppm": 1e6 * clock.drift,
        "command_drift_ppm_ci95": (
            1e6 * (clock.drift + clock.drift_half_width * np.array([-1.0, 1.0]))
        ).tolist(),
        "command_offset_ms": None if offset is None else 1e3 * offset,
        "command_offset_ms_ci95": interval,
    }


def _unexplained(o: Outcome, before: float, after: float, floor: float) -> dict[str, Any]:
    """Section on the residual: regressors of signals, or structure that no effect explains."""
    parts, samples = o.parts, o.samples
    residual = samples.tau - o.after.predict()
    p = np.minimum(
        whiteness_p_values(residual, parts.all_rows, samples.start, parts.noise_overlap),
        normality_p_values(residual, parts.all_rows),
    )
    coloured = p < WHITENESS_LEVEL
    names = [name for _, _, one in o.regressors for name in one.input_signals]
    joints = (
        np.any([effect.active for _, effect, _ in o.regressors], axis=0)
        if names
        else np.zeros(len(coloured), bool)
    )
    removable = before - floor
    structured = bool(names) or not o.evidence.is_white
    return {
        "verdict": "structured" if structured else "white",
        "fraction": float(np.clip((after - floor) / removable, 0.0, 1.0))
        if removable > _MIN_REMOVABLE * floor
        else 0.0,
        "depends_on": list(dict.fromkeys(names or o.evidence.correlates)),
        "joints": np.array(samples.joints)[joints | (coloured & structured)].tolist(),
        "edges": _edge_shares(o.after, samples.tau - o.predicted, parts.report),
    }


def _edge_shares(model: Model, residual: Array, rows: Bools) -> dict[str, float]:
    """Shares of the reported error and rows within `_EDGE_S` after the command of the joint changed."""
    earlier = model.with_delays(model.delays + np.array([[_EDGE_S], [0.0]])).signals.q_des
    edge = rows & (np.abs(model.signals.q_des - earlier) > _MIN_STEP_RAD)
    error = np.where(rows, residual, 0.0) ** 2
    return {
        "rows": float(edge.sum() / max(rows.sum(), 1)),
        "error": float(np.sum(error, where=edge) / max(error.sum(), 1e-300)),
    }


def _unconfirmed_warnings(o: Outcome) -> list[str]:
    """Warnings about effects that are not significant on the reported rows."""
    return [
        f"{effect.candidate.name} is not confirmed by the reported rows (p = {evidence.p_value:.2g} there)"
        for effect, evidence in zip(o.after.effects, o.evidence.effects, strict=True)
        if evidence.p_value > SIGNIFICANCE_LEVEL
    ]


def _delay_spread_warnings(model: Model) -> list[str]:
    """Warnings about delays that differ between joints: a running model has one pair."""
    spread = 1e3 * float(np.ptp(model.delays, axis=1).max())
    if spread < _SAME_DELAY_MS:
        return []
    return [
        f"delays differ by up to {spread:.1f} ms between joints: actuator.yaml contains their median, so that a model that "
        "runs with it has a larger error than reported"
    ]


def _torque_limit_warnings(o: Outcome) -> list[str]:
    """Warnings about measured torques that the corrected model cannot produce."""
    joints, peak = o.samples.joints, np.abs(o.samples.tau).max(axis=0)
    allowed = np.broadcast_to(torque_limits(o.base, joints), peak.shape)
    return [
        f"{joint}: the measured torque reaches {torque:.1f} N m, but torque_limit in actuator.yaml, from the base, is "
        f"{limit:.1f} N m"
        for joint, torque, limit in zip(joints, peak, allowed, strict=True)
        if torque > _TORQUE_LIMIT_MARGIN * limit
    ]


def _gain_entries(o: Outcome) -> dict[str, Any]:
    """Gain deviations and delays with intervals: a number if joints share it, else a list."""
    model, widths = o.after, o.half_widths
    found: dict[str, Any] = {}
    halves = widths.gains * np.array(model.samples.reference_gains)[:, None]
    rows = {
        **dict(zip(_DELTAS, zip(gain_deviations(model), halves, strict=True), strict=True)),
        "input_delay_ms": (1e3 * model.delays[0], 1e3 * widths.delays[0]),
        "output_delay_ms": (1e3 * model.delays[1], 1e3 * widths.delays[1]),
        "total_delay_ms": (1e3 * model.delays.sum(axis=0), 1e3 * widths.total_delay),
    }
    for name, (values, half) in rows.items():
        least = -np.inf if name.startswith("delta") else 0.0
        value, ci = value_and_interval(values, half, least)
        found[name], found[f"{name}_ci95"] = value, ci
    return found


def _effect_entries(o: Outcome) -> list[dict[str, Any]]:
    """Entries of the report for all effects; the regressors of named signals share one."""
    joints = o.samples.joints
    found = [
        _effect_entry(evidence, effect, half, joints, o.half_widths.at_bound)
        for evidence, effect, half in zip(
            o.evidence.effects, o.after.effects, o.half_widths.effects, strict=True
        )
        if not isinstance(effect.candidate, RegressorCandidate)
    ]
    if o.regressors:
        found.append(_regressors_entry(o, joints))
    return found


def _effects_alone_entry(o: Outcome) -> dict[str, Any]:
    """Entry of the report for the effects that explain most without regressors of named signals."""
    model = o.effects_alone
    return {
        "names": list(dict.fromkeys(effect.candidate.name for effect in model.effects)),
        "heldout_mse": mean_square(o.samples.tau - model.predictive().predict(), o.parts.report),
    }


def _regressors_entry(o: Outcome, joints: Sequence[str]) -> dict[str, Any]:
    """Entry of the report for all regressors of named signals."""
    ranked = sorted(o.regressors, key=lambda one: -o.evidence.effects[one[0]].gain)
    acts = np.any([effect.active for _, effect, _ in ranked], axis=0)
    return {
        "name": LEARNED_RESIDUAL,
        "joints": acting_joints(acts, joints),
        "params": {},
        "indistinguishable": [],
        "heldout_gain": sum(o.evidence.effects[k].gain for k, _, _ in ranked),
        "p_value": min(o.evidence.effects[k].p_value for k, _, _ in ranked),
        "at_bound": False,
        "inputs": list(dict.fromkeys(name for _, _, one in ranked for name in one.input_signals)),
        "terms": [
            {
                "kind": one.effect.shape.kind,
                "inputs": list(one.input_signals),
                "at": one.at,
                "joints": acting_joints(effect.active, joints),
                "heldout_gain": o.evidence.effects[k].gain,
            }
            for k, effect, one in ranked
        ],
    }


def _effect_entry(
    evidence: SelectedEffect,
    effect: AppliedEffect,
    half: Array,
    joints: Sequence[str],
    at_bound: Sequence[str],
) -> dict[str, Any]:
    """Entry of the report for one effect."""
    settings = effect_settings(effect)
    entry: dict[str, Any] = {
        "name": effect.candidate.name,
        "joints": acting_joints(effect.active, joints),
        "params": parameter_entries(effect, half),
        "indistinguishable": list(evidence.indistinguishable),
        "heldout_gain": evidence.gain,
        "p_value": evidence.p_value,
        "at_bound": any(name.partition(".")[0] == effect.candidate.name for name in at_bound),
        **effect.candidate.record_statistics(),
    }
    if settings:
        entry["form"] = settings
    if evidence.indistinguishable:
        entry["separated_by"] = effect.candidate.motion
    return entry


def _traces(o: Outcome) -> dict[str, Trace]:
    """Held-out torque series of each joint."""
    samples, reported = o.samples, o.parts.report
    series = {
        "measured": samples.tau,
        "pd": o.ideal_torque,
        "before": o.before.predict(),
        "after": o.predicted,
    }
    rows = np.flatnonzero(reported.any(axis=1))[:_MAX_POINTS]
    return {
        joint: Trace(
            t=samples.t[rows],
            **{name: np.where(reported[rows, j], x[rows, j], np.nan) for name, x in series.items()},
        )
        for j, joint in enumerate(samples.joints)
    }


def _shapes(o: Outcome) -> tuple[Shape, ...]:
    """Residual over the signal that explains it, for up to three joints of each effect."""
    samples = o.samples
    before, after = samples.tau - o.before.predict(), samples.tau - o.predicted
    rows = np.flatnonzero(o.parts.report.any(axis=1))
    rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
    found = []
    for effect in o.after.effects:
        for j in np.flatnonzero(effect.active)[:3]:
            x, unit = _signal_series(o, effect.candidate.signal, int(j))
            found.append(
                Shape(
                    effect=effect.candidate.name,
                    joint=samples.joints[j],
                    signal=effect.candidate.signal,
                    unit=unit,
                    x=x[rows],
                    before=before[rows, j],
                    after=after[rows, j],
                )
            )
    return tuple(found)


def _signal_series(o: Outcome, name: str, joint: int) -> tuple[Array, str]:
    """A signal of one joint by its name in the report, and its unit."""
    s, samples = o.after.signals, o.samples
    owner, _, plain = name.rpartition("/")
    j = samples.joints.index(owner) if owner else joint
    kind = plain.partition("@")[0]
    series: dict[str, Array] = {
        "q": s.q, "dq": s.dq, "ddq": s.ddq, "q_des": s.q_des, "tau": samples.tau,
        "t": np.broadcast_to(s.t, s.q.shape),
    }  # fmt: skip
    return series[kind][:, j], _SIGNAL_UNITS[kind]
